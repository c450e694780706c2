"""The times of an autopilot's log: damaged ones are left out, a clock that leaps is followed."""

import pytest

from gateway.recordings.recorded_clock import LogClock

STEP_US = 20_000
SECOND = [number * STEP_US for number in range(100)]


def times_at(*times_us: int) -> tuple[list[int], LogClock[int]]:
    clock = LogClock[int]()
    found = [timed for time_us in times_us for timed in clock.feed(time_us, time_us)]
    return [time_us for time_us, _ in (*found, *clock.flush())], clock


@pytest.mark.parametrize("off_us", [86_400_000_000, -31_536_000_000_000, (1 << 63) - 1])
def test_damaged_time_drops_only_its_message(off_us: int) -> None:
    found, clock = times_at(*SECOND[:50], off_us, *SECOND[50:])
    assert found == SECOND
    assert (clock.dropped, clock.leaps) == (1, 0)


@pytest.mark.parametrize("leap_us", [7_200_000_000, -5_000_000_000])
def test_jump_of_the_clock_is_followed(leap_us: int) -> None:
    begin_us = 6_000_000_000
    found, clock = times_at(
        *(begin_us + t for t in SECOND), *(begin_us + leap_us + t for t in SECOND)
    )
    assert (clock.leaps, clock.restarts, clock.dropped) == (leap_us > 0, leap_us < 0, 0)
    assert len(found) == 2 * len(SECOND)
    assert found == sorted(found)
    assert found[-1] - found[len(SECOND)] == SECOND[-1] - SECOND[0]
