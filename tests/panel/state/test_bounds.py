"""The stored data of an aircraft stop growing, however long it flies."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.fields import FUSED_SPAN_US
from gateway.panel.state.fleet import FleetState
from gateway.panel.state.history import MAX_TRACK
from gateway.units import US_PER_S
from tests.panel.messages import decoded, heartbeat, position

RATE_HZ = 5
HOUR_S = 3600


class Memory:
    """All that is kept by aircraft, fed on a manual clock."""

    def __init__(self) -> None:
        self.fleet = FleetState()

    def fly(self, begin_s: int, end_s: int) -> None:
        imu = decoded(mavlink.MAVLink_highres_imu_message(0, *[0.0] * 13, 63))
        text = decoded(mavlink.MAVLink_statustext_message(6, b"all is well"))
        attitude = decoded(mavlink.MAVLink_attitude_message(0, *[0.1] * 6))
        here = position(47.0, 8.0)
        for step in range(begin_s * RATE_HZ, end_s * RATE_HZ):
            now_us = step * US_PER_S // RATE_HZ
            slow: list[Any] = [heartbeat(), text] if step % RATE_HZ == 0 else []
            for message in (imu, attitude, here, *slow):
                self.fleet.update(message, now_us)

    @property
    def size(self) -> dict[str, int]:
        (vehicle,) = self.fleet.vehicles.values()
        return {
            "track": len(vehicle.history),
            "texts": len(vehicle.texts.all),
            "newest": len(vehicle.state.fields),
            "frames": len(vehicle.samples.frames),
            "rows": len(vehicle.received.series("ATTITUDE.roll")[0]),
        }


def test_second_hour_of_flight_needs_no_more_memory() -> None:
    memory = Memory()
    memory.fly(0, HOUR_S)
    first = memory.size
    memory.fly(HOUR_S, 2 * HOUR_S)
    second = memory.size
    assert 0 < first.pop("track") <= MAX_TRACK
    assert MAX_TRACK // 2 < second.pop("track") <= MAX_TRACK
    assert first == second
    assert second["rows"] > 0
    assert second["frames"] == pytest.approx(FUSED_SPAN_US // US_PER_S * RATE_HZ, abs=1)


def test_discarded_aircraft_leaves_no_data() -> None:
    memory = Memory()
    memory.fly(0, 5)
    memory.fleet.discard(1)
    assert memory.fleet.vehicles == {}
