"""Uploads by a client that counts and gives up as MAVSDK does, over links that lose and delay."""

import heapq
from itertools import count as count_up
from typing import Any

import numpy as np
import pytest

from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import RateSettings, VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, count, item, of_kind

STEP_S = 0.05
COUNTED_TO = 5
"""MAVSDK's `retries`."""
ITEMS = [item(seq) for seq in range(20)]
NO_TELEMETRY = RateSettings(**dict.fromkeys(RateSettings.__struct_fields__, 0.0))


class Uploader:
    """What MAVSDK 4 does with the answers, over a link with a loss and a range of delays in s."""

    def __init__(
        self, station: GroundStation, rng: np.random.Generator, loss: float, *delay_s: float
    ) -> None:
        self.station, self.rng, self.loss, self.delay_s = station, rng, loss, delay_s
        self.now_s = 0.0
        self.number = count_up()
        self.under_way: list[tuple[float, int, bool, Any]] = []

    def run(self) -> str:
        """Upload once; what is under way from the last upload arrives late."""
        self.next, self.counted, self.waited = 0, 0, 0
        self.asked = False
        self.result: str | None = None
        self.begin()
        while self.result is None:
            for message in self.step():
                if self.result is None:
                    self.handle(message)
            self.wait()
        return self.result

    def put(self, message: Any, *, up: bool = True) -> None:
        if self.rng.random() >= self.loss:
            due_s = self.now_s + self.rng.uniform(*self.delay_s)
            heapq.heappush(self.under_way, (due_s, next(self.number), up, message))

    def step(self) -> list[Any]:
        """Let a step of time pass; what arrives in it."""
        self.now_s += STEP_S
        answers, arrived = self.station.wait(STEP_S), []
        while self.under_way and self.under_way[0][0] <= self.now_s:
            _, _, up, message = heapq.heappop(self.under_way)
            if up:
                answers += self.station.send(message)
            else:
                arrived.append(message)
        for message in of_kind(answers, "MISSION_REQUEST_INT", "MISSION_ACK"):
            self.put(message, up=False)
        return arrived

    def begin(self) -> None:
        self.put(count(len(ITEMS)))
        self.counted += 1

    def handle(self, message: Any) -> None:
        if message.get_type() == "MISSION_ACK":
            whole = message.type == 0 and self.next == len(ITEMS)
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
        self.put(ITEMS[message.seq])
        self.next = message.seq + 1
        self.counted += 1

    def wait(self) -> None:
        self.waited += 1
        if self.waited * STEP_S < 0.5 or self.result is not None:
            return
        self.waited = 0
        if self.counted >= COUNTED_TO:
            self.result = "waited too long"
        elif self.asked:
            self.counted += 1
        else:
            self.begin()


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
def test_uploads_are_stored_over_lossy_and_slow_links(
    clock: ManualClock, loss: float, shortest_s: float, longest_s: float, stored: int
) -> None:
    station = GroundStation(Vehicle(VehicleSettings(rates=NO_TELEMETRY), 1), clock)
    client = Uploader(station, np.random.default_rng(1), loss, shortest_s, longest_s)
    reported = [client.run() for _ in range(20)]
    assert reported.count("stored") >= stored, reported
