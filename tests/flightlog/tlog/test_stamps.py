"""Stamps grow, and tell the truth as far as it is known."""

import itertools

import numpy as np
import pytest

from gateway.flightlog.tlog.stamps import JUMP_US, STEP_US, CivilClock, Stamper

UTC_US = 1_781_000_000_000_000
MINUTE_US = 60_000_000


def test_the_machine_counts_until_gps_tells_better() -> None:
    clock = CivilClock()
    assert clock.offset_us is None
    clock.hear_machine(5_000_000, 1_000_000)
    assert clock.offset_us == 4_000_000
    clock.hear_gps(UTC_US, 3_000_000)
    clock.hear_machine(9_000_000, 4_000_000)
    assert clock.offset_us == UTC_US - 3_000_000


def test_a_right_machine_keeps_its_finer_time() -> None:
    clock = CivilClock()
    clock.hear_machine(UTC_US, 0)
    clock.hear_gps(UTC_US + 800_000, 1_000_000)
    assert clock.offset_us == UTC_US


@pytest.mark.parametrize("jump_us", [-MINUTE_US, -JUMP_US - 1, JUMP_US + 1, 50 * MINUTE_US])
def test_a_jump_asks_for_a_new_file(jump_us: int) -> None:
    clock = CivilClock()
    clock.hear_machine(UTC_US, 0)
    stamper = Stamper(UTC_US)
    assert not stamper.has_jumped(clock)
    clock.hear_gps(UTC_US + jump_us, 0)
    assert stamper.has_jumped(clock)


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
