"""The tree of newest messages, with its counts and times."""

from datetime import datetime
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel import rest_api
from gateway.panel.rest_api import MessageBook


class Wall:
    now_s = 1_700_000_000.0

    def __call__(self) -> float:
        return self.now_s


def attitude(roll: float, system_id: int = 1, component_id: int = 1) -> Any:
    link = mavlink.MAVLink(None, system_id, component_id)
    message = mavlink.MAVLink_attitude_message(5, roll, 0, 0, 0, 0, 0)
    return link.decode(bytearray(message.pack(link)))


@pytest.fixture
def wall() -> Wall:
    return Wall()


@pytest.fixture
def book(wall: Wall) -> MessageBook:
    book = MessageBook(wall)
    for count in range(11):
        wall.now_s = 1_700_000_000.0 + count / 10
        book.take(attitude(count / 2))
    book.take(attitude(7, 2, 5))
    return book


ATTITUDE = "vehicles/1/components/1/messages/ATTITUDE"


def test_value_is_found_by_its_path(book: MessageBook) -> None:
    assert book.look_up(f"{ATTITUDE}/message/roll") == 5.0
    assert book.look_up(f"{ATTITUDE}/message/type") == "ATTITUDE"
    assert book.look_up("vehicles/2/components/5/id") == 5
    assert book.look_up("vehicles/2/id") == 2
    everything = book.look_up("")
    assert sorted(everything["vehicles"]) == ["1", "2"]
    whole = everything["vehicles"]["1"]["components"]["1"]["messages"]["ATTITUDE"]
    assert book.look_up(ATTITUDE) == whole
    assert list(book.look_up("vehicles/2/components")) == ["5"]


def test_status_has_count_frequency_and_times(book: MessageBook) -> None:
    status = book.look_up(f"{ATTITUDE}/status/time")
    assert status["counter"] == 11
    assert status["frequency"] == pytest.approx(10)
    first, last = (datetime.fromisoformat(status[f"{end}_update"]) for end in ("first", "last"))
    assert first.timestamp() == 1_700_000_000.0
    assert (last - first).total_seconds() == 1
    once = book.look_up("vehicles/2/components/5/messages/ATTITUDE/status/time")
    assert (once["counter"], once["frequency"]) == (1, 0.0)


def test_array_element_is_found_by_its_index(book: MessageBook) -> None:
    link = mavlink.MAVLink(None, 1, 1)
    message = mavlink.MAVLink_param_value_message(b"SPEED", 1.5, 9, 1, 0)
    book.take(link.decode(bytearray(message.pack(link))))
    path = "vehicles/1/components/1/messages/PARAM_VALUE/message/param_id"
    assert book.look_up(f"{path}/1") == "P"
    for element in ("16", "-1", "01", "+1"):
        with pytest.raises(KeyError):
            book.look_up(f"{path}/{element}")


@pytest.mark.parametrize(
    "path",
    [
        "nowhere",
        "vehicles/3",
        f"{ATTITUDE}/message/rol",
        f"{ATTITUDE}/message/roll/x",
        "vehicles/x",
        f"{ATTITUDE}/",
        f"/{ATTITUDE}",
    ],
)
def test_unknown_path_raises_key_error(book: MessageBook, path: str) -> None:
    with pytest.raises(KeyError):
        book.look_up(path)


def test_number_of_forged_ids_is_bounded(
    book: MessageBook, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rest_api, "MAX_KINDS", 3)
    for system_id in range(3, 10):
        book.take(attitude(0, system_id))
    assert len(book.look_up("")["vehicles"]) == 3
    assert book.left_out == 6
    book.take(attitude(9))
    assert book.look_up(f"{ATTITUDE}/message/roll") == 9


def test_sent_message_is_listed_but_not_counted_as_received(book: MessageBook) -> None:
    assert book.has_heard(1, 1)
    book.take(attitude(3, 255, 0), is_sent=True)
    path = "vehicles/255/components/0/messages/ATTITUDE/message/roll"
    assert book.look_up(path) == 3
    assert not book.has_heard(255, 0)
    book.take(attitude(4, 255, 0))
    assert book.has_heard(255, 0)
