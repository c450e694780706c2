"""The times of an ArduPilot log: damaged ones are left out, a clock that leaps is followed."""

from types import SimpleNamespace

import pytest

from gateway.recordings.formats.dataflash import ArdupilotReader
from gateway.records import ImuCalibrated

STEP_US = 20_000
SECOND = [number * STEP_US for number in range(100)]
AXES = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")


def records_at(*times_us: int) -> tuple[list[int], ArdupilotReader]:
    reader = ArdupilotReader(1)
    found = []
    for time_us in times_us:
        known = SimpleNamespace(instance_field="I", columns=["TimeUS", "I"])
        axes = dict.fromkeys(AXES, 0.0)
        message = SimpleNamespace(TimeUS=time_us, I=0, T=20.0, fmt=known, **axes)
        found += [r.time_us for r in reader.feed("IMU", message) if isinstance(r, ImuCalibrated)]
    return found, reader


@pytest.mark.parametrize("off_us", [86_400_000_000, -31_536_000_000_000, (1 << 63) - 1])
def test_damaged_time_drops_only_its_message(off_us: int) -> None:
    found, reader = records_at(*SECOND[:50], off_us, *SECOND[50:])
    assert found == SECOND
    assert (reader.clock.dropped, reader.clock.leaps) == (1, 0)


@pytest.mark.parametrize("leap_us", [7_200_000_000, -5_000_000_000])
def test_jump_of_the_clock_is_followed(leap_us: int) -> None:
    begin_us = 6_000_000_000
    found, reader = records_at(
        *(begin_us + t for t in SECOND), *(begin_us + leap_us + t for t in SECOND)
    )
    assert (reader.clock.leaps, reader.clock.restarts) == ((1, 0) if leap_us > 0 else (0, 1))
    assert reader.clock.dropped == 0
    assert len(found) == 2 * len(SECOND)
    assert found == sorted(found)
    assert found[-1] - found[len(SECOND)] == SECOND[-1] - SECOND[0]
