"""The tree of newest messages, with its counts and times."""

import asyncio
import json
from datetime import datetime
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel import rest_api
from gateway.panel.rest_api import MessageBook
from tests.conftest import ManualClock
from tests.panel.messages import decoded

BEGIN_S = 1_700_000_000
ATTITUDE = "vehicles/1/components/1/messages/ATTITUDE"


def attitude(roll: float, system_id: int = 1, component_id: int = 1) -> Any:
    message = mavlink.MAVLink_attitude_message(5, roll, 0, 0, 0, 0, 0)
    return decoded(message, system_id, component_id)


@pytest.fixture
def book(clock: ManualClock) -> MessageBook:
    book = MessageBook(lambda: BEGIN_S + clock.now_us / 1e6)
    for count in range(11):
        clock.now_us = count * 100_000
        book.add(attitude(count / 2))
    book.add(attitude(7, 2, 5))
    return book


def test_value_is_found_by_its_path(book: MessageBook) -> None:
    assert book.look_up(f"{ATTITUDE}/message/roll") == 5.0
    assert book.look_up(f"{ATTITUDE}/message/type") == "ATTITUDE"
    assert book.look_up("vehicles/2/components/5/id") == 5
    assert book.look_up("vehicles/2/id") == 2
    everything = book.look_up("")
    assert sorted(everything["vehicles"]) == ["1", "2"]
    whole = everything["vehicles"]["1"]["components"]["1"]["messages"]["ATTITUDE"]
    assert book.look_up(ATTITUDE) == whole.as_json()
    assert list(book.look_up("vehicles/2/components")) == ["5"]


def test_status_has_count_frequency_and_times(book: MessageBook) -> None:
    status = book.look_up(f"{ATTITUDE}/status/time")
    assert status["counter"] == 11
    assert status["frequency"] == pytest.approx(10)
    first, last = (datetime.fromisoformat(status[f"{end}_update"]) for end in ("first", "last"))
    assert first.timestamp() == BEGIN_S
    assert (last - first).total_seconds() == 1
    once = book.look_up("vehicles/2/components/5/messages/ATTITUDE/status/time")
    assert (once["counter"], once["frequency"]) == (1, 0.0)


def test_array_element_is_found_by_its_index(book: MessageBook) -> None:
    book.add(decoded(mavlink.MAVLink_param_value_message(b"SPEED", 1.5, 9, 1, 0)))
    path = ATTITUDE.replace("ATTITUDE", "PARAM_VALUE/message/param_id")
    assert book.look_up(f"{path}/1") == "P"
    for element in ("16", "-1", "01", "+1"):
        with pytest.raises(KeyError):
            book.look_up(f"{path}/{element}")


@pytest.mark.parametrize(
    "path",
    [
        *("nowhere", "vehicles/3", "vehicles/x", f"/{ATTITUDE}"),
        *(f"{ATTITUDE}/{rest}" for rest in ("", "message/rol", "message/roll/x")),
    ],
)
def test_unknown_path_raises_key_error(book: MessageBook, path: str) -> None:
    with pytest.raises(KeyError):
        book.look_up(path)


@pytest.mark.parametrize("bound", ["MAX_KINDS", "MAX_KINDS_OF_SYSTEM"])
def test_forged_ids_are_dropped_before_entries_that_are_updated(
    book: MessageBook, clock: ManualClock, monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    monkeypatch.setattr(rest_api, bound, 3)
    for number in range(3, 10):
        clock.advance(1)
        book.add(attitude(9))
        of_system = bound == "MAX_KINDS_OF_SYSTEM"
        book.add(attitude(0, 1, number) if of_system else attitude(0, number))
    assert book.look_up(f"{ATTITUDE}/message/roll") == 9
    everything = book.look_up("")["vehicles"]
    kept = everything["1"]["components"] if of_system else everything
    assert len(kept) == 3


async def test_pieces_of_a_tree_are_as_one(
    book: MessageBook, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(20):
        book.add(attitude(0, number + 3))
    monkeypatch.setattr(rest_api, "PIECE", 100)
    tree, turn = book.look_up(""), asyncio.Lock()
    pieces = [piece async for piece in rest_api.encode_in_pieces(tree, turn)]
    assert max(map(len, pieces)) < 1000
    text = b"".join(pieces).decode()
    assert text == rest_api.pretty(tree) == json.dumps(json.loads(text), indent=2)
    assert len(json.loads(text)["vehicles"]) == 22


def test_sent_message_is_listed_but_not_counted_as_received(book: MessageBook) -> None:
    assert book.has_heard(1, 1)
    book.add(attitude(3, 255, 0), is_sent=True)
    path = "vehicles/255/components/0/messages/ATTITUDE/message/roll"
    assert book.look_up(path) == 3
    assert not book.has_heard(255, 0)
    book.add(attitude(4, 255, 0))
    assert book.has_heard(255, 0)
