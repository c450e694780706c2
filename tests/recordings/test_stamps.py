"""Stamps grow, and tell the truth as far as it is known."""

import itertools
import time

import numpy as np
import pytest

from gateway.clock import GatewayClock
from gateway.recordings.tlog import JUMP_US, STEP_US, CivilClock, Stamper
from gateway.wire.gps_time import ENOUGH

UTC_US = 1_781_000_000_000_000
MINUTE_US = 60_000_000


def test_the_machine_counts_until_gps_tells_better() -> None:
    clock = CivilClock()
    assert clock.offset_us is None
    clock.hear_machine(5_000_000, 1_000_000)
    assert clock.offset_us == 4_000_000
    for second in range(ENOUGH):
        assert clock.offset_us == 4_000_000
        clock.hear_gps(1, UTC_US + second * 1_000_000, (3 + second) * 1_000_000)
    clock.hear_machine(9_000_000, 4_000_000)
    assert clock.offset_us == UTC_US - 3_000_000


def test_a_right_machine_keeps_its_finer_time() -> None:
    clock = CivilClock()
    clock.hear_machine(UTC_US, 0)
    for _ in range(ENOUGH):
        clock.hear_gps(1, UTC_US + 800_000, 1_000_000)
    assert clock.offset_us == UTC_US


@pytest.mark.parametrize("jump_us", [-MINUTE_US, -JUMP_US - 1, JUMP_US + 1, 50 * MINUTE_US])
def test_a_jump_asks_for_a_new_file(jump_us: int) -> None:
    clock = CivilClock()
    clock.hear_machine(UTC_US, 0)
    stamper = Stamper(UTC_US)
    assert not stamper.has_jumped(clock)
    for _ in range(ENOUGH):
        clock.hear_gps(1, UTC_US + jump_us, 0)
    assert stamper.has_jumped(clock)


def test_one_aircraft_among_three_that_errs_by_an_hour_changes_nothing() -> None:
    clock = CivilClock()
    clock.hear_machine(UTC_US, 0)
    for n in range(30):
        for vehicle_id, error_us in ((1, 3_600_000_000), (2, 0), (3, 100_000)):
            clock.hear_gps(vehicle_id, UTC_US + n * 200_000 + error_us, n * 200_000)
        assert clock.offset_us == UTC_US


def test_single_fixes_that_err_change_nothing() -> None:
    clock = CivilClock()
    clock.hear_machine(UTC_US, 0)
    for n in range(60):
        clock.hear_gps(1, UTC_US + n * 200_000 + 7_000_000 * (n % 3 == 2), n * 200_000)
        assert clock.offset_us == UTC_US


def sleepless(monkeypatch: pytest.MonkeyPatch) -> dict[int, int]:
    """Put the kernel's clocks under the test's control."""
    clocks = {time.CLOCK_BOOTTIME: 10**12, time.CLOCK_MONOTONIC: 10**12}
    monkeypatch.setattr(time, "clock_gettime_ns", clocks.__getitem__)
    monkeypatch.setattr(time, "monotonic_ns", lambda: clocks[time.CLOCK_MONOTONIC])
    return clocks


@pytest.mark.parametrize("set_by_us", [0, 3_600_000_000])
def test_a_machine_that_slept_is_distinguished_from_one_whose_clock_was_set(
    monkeypatch: pytest.MonkeyPatch, set_by_us: int
) -> None:
    clocks = sleepless(monkeypatch)
    now_us, clock = GatewayClock(), CivilClock()
    clock.hear_machine(UTC_US, now_us())
    stamper = Stamper(UTC_US)
    clocks[time.CLOCK_BOOTTIME] += 3_600 * 10**9
    clock.hear_machine(UTC_US + 3_600_000_000 + set_by_us, now_us())
    assert stamper.has_jumped(clock) == bool(set_by_us)


@pytest.mark.parametrize("seed", range(5))
def test_stamps_grow_whatever_the_order_of_calls(seed: int) -> None:
    times = np.random.default_rng(seed).integers(0, 1000, 300).tolist()
    stamper = Stamper(UTC_US)
    stamps = [stamper.stamp(time) for time in times]
    assert all(b - a >= STEP_US for a, b in itertools.pairwise(stamps))
    assert all(stamp % STEP_US == 0 for stamp in stamps)


def test_a_stamp_is_never_later_than_its_moment() -> None:
    stamper = Stamper(UTC_US)
    for now_us in range(0, 100_000, 997):
        assert 0 <= now_us + UTC_US - stamper.stamp(now_us) < STEP_US


def test_a_clock_before_1970_gives_zero_and_grows() -> None:
    stamper = Stamper(-1_000_000)
    assert [stamper.stamp(0), stamper.stamp(1)] == [STEP_US, 2 * STEP_US]
