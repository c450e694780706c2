"""Topics of a PX4 log that are not as PX4 documents them, and times that cannot be."""

from typing import Any

import numpy as np
import pytest

from gateway.recordings.formats.ulog import Px4Log
from gateway.records import GpsFix

ROWS = 60
STEP_US = 20_000


def topics() -> dict[str, dict[str, Any]]:
    time_us = 5_000_000 + STEP_US * np.arange(ROWS, dtype=np.uint64)
    axes = [f"{name}[{axis}]" for name in ("gyro_rad", "accelerometer_m_s2") for axis in range(3)]
    attitude = [f"q[{axis}]" for axis in range(4)]
    return {
        topic: {"timestamp": time_us, **dict.fromkeys(fields, np.ones(ROWS, np.float32))}
        for topic, fields in (("sensor_combined", axes), ("vehicle_attitude", attitude))
    }


def test_documented_topics_are_read() -> None:
    flight = Px4Log(topics(), 1)
    assert flight.left_out == []
    assert len(list(flight.records())) == 2 * ROWS


@pytest.mark.parametrize("field", ["q[3]", "timestamp"])
def test_topic_without_its_fields_is_left_out(field: str) -> None:
    found = topics()
    del found["vehicle_attitude"][field]
    flight = Px4Log(found, 1)
    assert flight.left_out == ["vehicle_attitude"]
    assert len(list(flight.records())) == ROWS


def test_topic_with_fractional_times_is_left_out() -> None:
    found = topics()
    found["vehicle_attitude"]["timestamp"] = np.linspace(0.0, 1.0, ROWS)
    assert Px4Log(found, 1).left_out == ["vehicle_attitude"]


@pytest.mark.parametrize("off_us", [86_400_000_000, 31_536_000_000_000, -4_000_000, 1 << 60])
def test_damaged_times_give_no_gap(off_us: int) -> None:
    found = topics()
    time_us = found["sensor_combined"]["timestamp"].astype(np.int64)
    time_us[[9, 30]] += off_us
    found["sensor_combined"]["timestamp"] = time_us.astype(np.uint64)
    flight = Px4Log(found, 1)
    times = [record.time_us for record in flight.records()]
    assert times == sorted(times)
    assert times[-1] - times[0] <= ROWS * STEP_US + 4_000_000
    assert flight.dropped == (2 if abs(off_us) > 60_000_000 else 0)


@pytest.mark.parametrize(
    ("fix_type", "valid", "known"), [(3, 1, True), (3, 0, False), (1, 1, False)]
)
def test_velocity_is_used_with_a_fix_and_where_it_is_valid(
    fix_type: int, valid: int, known: bool
) -> None:
    found = topics()
    times = {"timestamp": found["sensor_combined"]["timestamp"][:1]}
    numbers = {"fix_type": fix_type, "vel_ned_valid": valid, "lat": 470000000, "lon": 80000000}
    speeds = dict.fromkeys(("vel_n_m_s", "vel_e_m_s", "vel_d_m_s"), np.full(1, 1.5))
    found["vehicle_gps_position"] = (
        times | {name: np.array([number]) for name, number in numbers.items()} | speeds
    )
    (fix,) = (record for record in Px4Log(found, 1).records() if isinstance(record, GpsFix))
    assert (fix.vel_n_mps == (1.5, 1.5, 1.5)) is known
