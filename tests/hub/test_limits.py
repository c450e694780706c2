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


def asked(client_id: int, number: int = 0, *, trusted: bool = True) -> Incoming:
    return Incoming(client_id, bytes((number,)), trusted)


def test_clients_are_served_in_turns_and_each_in_its_order() -> None:
    queue = RequestQueue()
    for number in range(3):
        queue.offer(asked(1, number), 0)
    queue.offer(asked(2), 0)
    queue.offer(asked(3, trusted=False), 0)
    taken = [queue.take(0) for _ in range(6)]
    assert [(i.client_id, i.frame[0]) for i in taken if i] == [
        (1, 0), (2, 0), (3, 0), (1, 1), (1, 2)
    ]  # fmt: skip
    assert taken[-1] is None
    assert queue.wait_us(0) is None


def test_flooding_client_delays_only_itself() -> None:
    queue = RequestQueue()
    assert [queue.offer(asked(1), 0) for _ in range(MAX_WAITING + 1)][-2:] == [True, False]
    assert queue.offer(asked(2), 0)
    assert queue.take(0) == asked(1)
    assert queue.take(0) == asked(2)


def test_next_request_waits_until_the_bucket_has_refilled() -> None:
    queue = RequestQueue()
    queue.offer(asked(1), 0)
    queue.offer(asked(1), 0)
    queue.take(0)
    queue.charge(1, CLIENT_BURST)
    assert queue.take(0) is None
    wait_us = queue.wait_us(0)
    assert wait_us
    assert abs(wait_us - REQUEST_COST * US_PER_S / CLIENT_RATE) < 100
    assert queue.take(wait_us) == asked(1)


def test_client_beyond_its_quota_delays_no_other() -> None:
    queue = RequestQueue()
    for client_id in (1, 2):
        queue.offer(asked(client_id), 0)
    queue.charge(1, 2 * CLIENT_BURST)
    assert queue.take(0) == asked(2)
    assert queue.take(0) is None


def test_untrusted_clients_share_one_bucket_that_a_new_client_does_not_refill() -> None:
    queue = RequestQueue()
    queue.offer(asked(1, trusted=False), 0)
    queue.take(0)
    queue.charge(1, UNTRUSTED_BURST)
    queue.remove(1)
    for client_id in (2, 3):
        queue.offer(asked(client_id, trusted=False), 0)
    queue.offer(asked(4), 0)
    assert queue.take(0) == asked(4), "a trusted client is served all the same"
    assert queue.take(0) is None
    assert queue.take(US_PER_S) == asked(2, trusted=False)


def test_untrusted_clients_cause_a_bounded_number_of_bytes_in_a_minute() -> None:
    queue = RequestQueue()
    answered = 0
    for now_us in range(0, 60 * US_PER_S, 10_000):
        for client_id in range(32):
            queue.offer(asked(client_id, trusted=False), now_us)
        if taken := queue.take(now_us):
            queue.charge(taken.client_id, 300)
            answered += 1
    assert answered <= (UNTRUSTED_BURST + 60 * UNTRUSTED_RATE) / (REQUEST_COST + 300) + 1


def test_client_no_longer_trusted_uses_the_shared_bucket() -> None:
    queue = RequestQueue()
    queue.offer(asked(9, trusted=False), 0)
    queue.charge(9, 2 * UNTRUSTED_BURST)
    queue.offer(asked(1), 0)
    assert queue.take(0) == asked(1)
    queue.offer(asked(1, trusted=False), 0)
    assert queue.take(0) is None


def test_removed_client_leaves_neither_requests_nor_a_quota() -> None:
    queue = RequestQueue()
    queue.offer(asked(1), 0)
    queue.charge(1, 2 * CLIENT_BURST)
    queue.remove(1)
    assert (queue.take(0), queue.wait_us(0)) == (None, None)
    queue.offer(asked(1), 0)
    assert queue.take(0) == asked(1)


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
