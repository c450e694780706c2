"""Uploads by a client that counts and gives up as MAVSDK does, over links that lose and delay."""

import heapq
from itertools import count as count_up
from typing import Any

import numpy as np
import pytest

from tests.vehicle.ground_station import GroundStation
from tests.vehicle.services.test_missions import ACCEPTED, count, item

STEP_S = 0.05
COUNTED_TO = 5
"""MAVSDK's `retries`."""
ITEMS = [item(seq) for seq in range(20)]


class Link:
    """A link to a station that has none of its own.

    Parameters
    ----------
    station : GroundStation
    loss : float
        Share of frames, each way.
    delay_s : tuple of float
        Shortest and longest, each way.
    """

    def __init__(self, station: GroundStation, loss: float, *delay_s: float) -> None:
        self.station, self.loss, self.delay_s = station, loss, delay_s
        self.rng = np.random.default_rng(1)
        self.now_s = 0.0
        self._number = count_up()
        self._on_the_way: list[tuple[float, int, bool, Any]] = []

    def put(self, message: Any, *, up: bool = True) -> None:
        if self.rng.random() >= self.loss:
            due_s = self.now_s + self.rng.uniform(*self.delay_s)
            heapq.heappush(self._on_the_way, (due_s, next(self._number), up, message))

    def step(self) -> list[Any]:
        """Let a step of time pass; what arrives in it."""
        self.now_s += STEP_S
        self._answered(self.station.wait(STEP_S))
        arrived = []
        while self._on_the_way and self._on_the_way[0][0] <= self.now_s:
            _, _, up, message = heapq.heappop(self._on_the_way)
            if up:
                self._answered(self.station.send(message))
            else:
                arrived.append(message)
        return arrived

    def _answered(self, messages: list[Any]) -> None:
        for message in messages:
            if message.get_type() in ("MISSION_REQUEST_INT", "MISSION_ACK"):
                self.put(message, up=False)


class Upload:
    """What MAVSDK 4 does with the answers."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.next, self.counted, self.waited = 0, 0, 0
        self.asked = False
        self.result: str | None = None

    def run(self) -> str:
        self._begin()
        while self.result is None:
            for message in self.link.step():
                if self.result is None:
                    self._hear(message)
            self._wait()
        return self.result

    def _begin(self) -> None:
        self.link.put(count(len(ITEMS)))
        self.counted += 1

    def _hear(self, message: Any) -> None:
        if message.get_type() == "MISSION_ACK":
            whole = message.type == ACCEPTED and self.next == len(ITEMS)
            self.result = "stored" if whole else f"ended by {message.type}"
            return
        self.asked = True
        if message.seq > self.next:
            return
        if message.seq == self.next:
            self.counted = 0
        elif self.counted >= COUNTED_TO:
            self.result = "asked for too often"
            return
        self.waited = 0
        self.link.put(ITEMS[message.seq])
        self.next = message.seq + 1
        self.counted += 1

    def _wait(self) -> None:
        self.waited += 1
        if self.waited * STEP_S < 0.5 or self.result is not None:
            return
        self.waited = 0
        if self.counted >= COUNTED_TO:
            self.result = "waited too long"
        elif self.asked:
            self.counted += 1
        else:
            self._begin()


@pytest.mark.parametrize(
    ("loss", "shortest_s", "longest_s", "stored"),
    [
        (0.0, 0.0, 0.0, 20),
        (0.0, 0.82, 0.82, 20),
        (0.1, 0.0, 0.05, 18),
        (0.1, 0.42, 0.42, 13),
        (0.02, 0.5, 0.6, 14),
    ],
)
def test_of_twenty_uploads_one_after_the_other(
    station: GroundStation, loss: float, shortest_s: float, longest_s: float, stored: int
) -> None:
    link = Link(station, loss, shortest_s, longest_s)
    reported = [Upload(link).run() for _ in range(20)]
    assert reported.count("stored") >= stored, reported
