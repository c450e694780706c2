"""Requests in turns, answers within quotas, and room in full ports; on the manual clock."""

from dataclasses import dataclass
from typing import Any

import pytest

from gateway.hub.limits import (
    CLIENT_BURST,
    CLIENT_RATE,
    MAX_WAITING,
    REQUEST_COST,
    UNTRUSTED_BURST,
    UNTRUSTED_RATE,
    RequestQueue,
)
from gateway.hub.transports.base import STALE_AFTER_US
from gateway.hub.transports.datagram import UNPROVEN_IDLE_US, gone_clients
from gateway.hub.transports.listener import client_to_remove
from gateway.records import Incoming
from gateway.units import US_PER_S

TRANSCRIPTS = {
    "each client in its turn and order": "+1a +1b +1c +2a +3a? =1a =2a =3a? =1b =1c =-",
    "client beyond its quota delays no other": "+1a +2a !1 =2a =-",
    "new untrusted client does not refill the bucket of all":
        "+1a? =1a? !1? x1 +2a? +3a? +4a =4a =- >1 =2a?",
    "client no longer trusted uses the shared bucket": "+9a? !9? +1a =1a +1b? =-",
    "client that loses trust loses its waiting requests": "+9a? !9? +1a +1b? =-",
    "removed client leaves neither requests nor a quota": "+1a !1 x1 =- +1b =1b",
    "flooding client delays only itself": "+1a " * MAX_WAITING + "-1a +2a =1a =2a",
}  # fmt: skip
"""Requests of clients, untrusted ones with a question mark: offered (+) or not accepted (-), taken
(=), or none; a quota is used up (!), a client removed (x), seconds pass (>)."""


@pytest.mark.parametrize("name", TRANSCRIPTS)
def test_requests_are_served_in_turns_within_quotas(name: str) -> None:
    queue, now_us = RequestQueue(), 0
    for number, word in enumerate(TRANSCRIPTS[name].split()):
        client_id, is_trusted = int("0" + word[1:2].strip("-")), not word.endswith("?")
        asked = Incoming(client_id, word[2:3].encode(), is_trusted)
        match word[0]:
            case "+" | "-":
                assert queue.offer(asked, now_us) == (word[0] == "+"), number
            case "=":
                assert queue.take(now_us) == (None if word == "=-" else asked), number
            case "!":
                queue.charge(client_id, 2 * CLIENT_BURST if is_trusted else UNTRUSTED_BURST)
            case "x":
                queue.remove(client_id)
                assert queue.wait_us(now_us) != 0, "none of it waits"
            case _:
                now_us += US_PER_S


def test_next_request_waits_until_the_bucket_has_refilled() -> None:
    queue, asked = RequestQueue(), Incoming(1, b"", True)
    assert queue.wait_us(0) is None
    queue.offer(asked, 0)
    queue.offer(asked, 0)
    queue.take(0)
    queue.charge(1, CLIENT_BURST)
    wait_us = queue.wait_us(0)
    assert wait_us
    assert abs(wait_us - REQUEST_COST * US_PER_S / CLIENT_RATE) < 100
    assert (queue.take(0), queue.take(wait_us)) == (None, asked)


def test_untrusted_clients_cause_a_bounded_number_of_bytes_in_a_minute() -> None:
    queue, answered = RequestQueue(), 0
    for now_us in range(0, 60 * US_PER_S, 10_000):
        for client_id in range(32):
            queue.offer(Incoming(client_id, b"", trusted=False), now_us)
        if taken := queue.take(now_us):
            queue.charge(taken.client_id, 300)
            answered += 1
    assert answered <= (UNTRUSTED_BURST + 60 * UNTRUSTED_RATE) / (REQUEST_COST + 300) + 1


S = US_PER_S
GCS = (255, 190)
UNPROVEN_CLIENT = [("a", 0, GCS), ("b", 0, GCS, False)]
"""The second has not proven that it receives."""


@dataclass
class Present:
    """A client of a listening port."""

    host: str
    last_us: int = 0
    identity: tuple[int, int] = GCS
    is_proven: bool = True


@pytest.mark.parametrize(
    ("clients", "now_us", "gone"),
    [
        pytest.param([("a", 0, GCS)], 30 * S - 1, [], id="before the timeout"),
        pytest.param([("a", 0, GCS)], 30 * S, [0], id="timeout"),
        pytest.param([("a", 0, GCS), ("a", S, GCS)], STALE_AFTER_US, [0], id="another port"),
        pytest.param([("a", 0, GCS), ("a", S, GCS)], STALE_AFTER_US - 1, [], id="both alive"),
        pytest.param([("a", 0, GCS), ("a", S, (254, 190))], 6 * S, [], id="another system"),
        pytest.param([("a", 0, GCS), ("b", S, GCS)], 6 * S, [], id="another host"),
        pytest.param(UNPROVEN_CLIENT, UNPROVEN_IDLE_US - 1, [], id="before it must be proven"),
        pytest.param(UNPROVEN_CLIENT, UNPROVEN_IDLE_US, [1], id="not proven"),
    ],
)
def test_clients_go_after_a_timeout_or_when_they_return_on_another_port(
    clients: list[tuple[Any, ...]], now_us: int, gone: list[int]
) -> None:
    present = [Present(*each) for each in clients]
    assert gone_clients(present, 30 * S, now_us) == [present[number] for number in gone]


def removed(hosts: list[str], newcomer: str) -> int | None:
    present = [Present(host) for host in hosts]
    found = client_to_remove(present, newcomer, len(present), 1)
    return None if found is None else next(i for i, each in enumerate(present) if each is found)


def test_full_port_gives_up_the_client_that_sent_nothing_for_longest() -> None:
    present = [Present("a", S), Present("a", 0), Present("a", S)]
    assert client_to_remove(present, "b", 3, STALE_AFTER_US) is present[1]
    assert client_to_remove(present, "b", 3, STALE_AFTER_US - 1) is None


def test_host_with_all_of_a_port_makes_room_down_to_its_share() -> None:
    hosts, admitted = ["a"] * 32, 0
    for number in range(30):
        assert removed(hosts, "a") is None
        if (index := removed(hosts, f"b{number}")) is not None:
            assert index > 0, "the first client stays"
            hosts[index:] = [*hosts[index + 1 :], f"b{number}"]
            admitted += 1
    assert admitted == 24


def test_client_within_the_share_of_its_host_is_not_removed_for_a_new_one() -> None:
    assert removed(["a", "a", *(f"b{number}" for number in range(6))], "c") is None
