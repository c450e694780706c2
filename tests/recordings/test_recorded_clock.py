"""The clocks of recordings: damaged times are left out, a clock that leaps is followed."""

import pytest

from gateway.recordings.recorded_clock import (
    DAY_US,
    JUMP_US,
    LATE_US,
    LogClock,
    VehicleClock,
    civil_shift_us,
    is_step,
)

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


@pytest.mark.parametrize(
    ("step_us", "expected"),
    [(-LATE_US - 1, True), (-LATE_US, False), (0, False), (DAY_US, False), (DAY_US + 1, True)],
)
def test_late_record_and_gap_of_a_day_are_no_step_of_the_clock(
    step_us: int, expected: bool
) -> None:
    assert is_step(step_us) == expected


@pytest.mark.parametrize("zero_us", [None, 0, JUMP_US, JUMP_US + 1, -DAY_US])
def test_clocks_differ_by_more_than_the_error_of_civil_time(zero_us: int | None) -> None:
    expected = {JUMP_US + 1: JUMP_US + 1, -DAY_US: -DAY_US, None: None}.get(zero_us, 0)
    assert civil_shift_us(zero_us, 0) == expected
    assert civil_shift_us(zero_us, None) is None


def test_times_of_a_kind_of_message_do_not_decrease() -> None:
    clock = VehicleClock()
    sent = [(None, 100), (1, 300), (1, 200), (None, 400), (None, 350), (1, 500)]
    found = [clock.time_us(kind, own_us, own_us) for kind, own_us in sent]
    assert found == [0, 200, 200, 300, 300, 400]
