"""The attitude out of motion: from any start, by exact and noisy pairs."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.alignment.gps_velocity import WayState, velocity_of_fix
from gateway.estimation.alignment.wahba import (
    AlignmentState,
    align_by_gravity,
    align_by_velocity,
    alignment_std,
    heading_difference,
    level_difference,
    misfit,
    solve_alignment,
)
from gateway.estimation.kernel_record import new_record
from gateway.units import STANDARD_GRAVITY_MPS2

NAN = math.nan


def feed(
    state: AlignmentState,
    attitude: Rotation,
    seed: int,
    noise_mps: float = 0.0,
    pull_mps2: float = 3.0,
    lasts_s: float = 0.0,
    fixes: int = 50,
) -> None:
    """Ten seconds of accelerations, seen in a frame that lies in NED by `attitude`.

    Each lasts for 0.2 s, or is correlated over `lasts_s`.
    """
    rng = np.random.default_rng(seed)
    state.pair_s = -1e9
    force_i, vel = np.zeros(3), np.zeros(3)
    kept = math.exp(-0.2 / lasts_s) if lasts_s else 0.0
    accel = rng.normal(0.0, pull_mps2, 3)
    for k in range(fixes):
        told = vel + rng.normal(0.0, noise_mps, 3) if noise_mps else vel
        align_by_velocity(state, 0.2 * k, tuple(told), tuple(force_i), 0.2)
        accel = kept * accel + rng.normal(0.0, pull_mps2, 3) * math.sqrt(1.0 - kept * kept)
        vel = vel + 0.2 * accel
        force_n = accel - [0.0, 0.0, STANDARD_GRAVITY_MPS2]
        force_i = force_i + 0.2 * attitude.inv().apply(force_n)


@pytest.mark.parametrize("seed", range(8))
def test_any_attitude_is_found(seed: int) -> None:
    attitude = Rotation.random(rng=np.random.default_rng(seed))
    state = new_record(AlignmentState)
    feed(state, attitude, seed)
    found = Rotation.from_quat(solve_alignment(state), scalar_first=True)
    assert math.degrees((found * attitude.inv()).magnitude()) < 0.01


def test_the_standard_deviations_are_honest() -> None:
    """Of noisy velocities; pairs share their noise, so they may tell too much, never too little."""
    level, heading = [], []
    for seed in range(60):
        attitude = Rotation.random(rng=np.random.default_rng(seed))
        state = new_record(AlignmentState)
        feed(state, attitude, seed, 0.2)
        q = solve_alignment(state)
        stds = alignment_std(state, misfit(state, q), 0.0)
        true = tuple(attitude.as_quat(scalar_first=True))
        # The same vector in the body stands for the vertical of both.
        level.append(level_difference(q, true) / stds[0])
        heading.append(heading_difference(q, true) / stds[1])
    assert 0.2 < np.sqrt(np.mean(np.square(level))) < 1.2
    assert 0.2 < np.sqrt(np.mean(np.square(heading))) < 1.2


@pytest.mark.parametrize("fixes", [4, 7, 10, 16])
def test_a_level_from_a_pull_of_any_direction_is_as_unsure_as_the_pull_is_large(
    fixes: int,
) -> None:
    """Without a heading, one mean force fits a whole cone of verticals."""
    off = []
    for seed in range(60):
        attitude = Rotation.random(rng=np.random.default_rng(seed))
        state = new_record(AlignmentState)
        feed(state, attitude, seed, 0.2, pull_mps2=1.5, lasts_s=2.0, fixes=fixes)
        q = solve_alignment(state)
        level_std, _ = alignment_std(state, misfit(state, q), 0.0)
        true = tuple(attitude.as_quat(scalar_first=True))
        off.append(level_difference(q, true) / level_std)
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_doubtful_bias_makes_the_heading_doubtful_and_the_more_the_less_pulls() -> None:
    """A frame that drifts off level lets gravity pass for a pull."""
    found = []
    for pull_mps2 in (3.0, 0.3):
        state = new_record(AlignmentState)
        feed(state, Rotation.identity(), 1, pull_mps2=pull_mps2)
        known, doubtful = (alignment_std(state, 1.0, math.radians(b))[1] for b in (0.0, 0.6))
        found.append(math.sqrt(doubtful**2 - known**2))
    # Half a degree a second for ten seconds is a tilt of 1.7 deg rms, which is 0.3 m/s2.
    assert math.radians(2.0) < found[0] < math.radians(10.0)
    assert found[1] > 5.0 * found[0]


def test_gravity_tells_the_level_alone() -> None:
    attitude = Rotation.from_euler("ZYX", [1.0, 0.4, -2.5])
    state = new_record(AlignmentState)
    state.pair_s = -1e9
    force = attitude.inv().apply([0.0, 0.0, -STANDARD_GRAVITY_MPS2])
    for k in range(30):
        align_by_gravity(state, 0.1 * k, tuple(force * 0.1 * k), 0.1)
    level_std, heading_std = alignment_std(state, 1.0, 0.0)
    found = Rotation.from_quat(solve_alignment(state), scalar_first=True)
    np.testing.assert_allclose(found.apply(force), [0.0, 0.0, -STANDARD_GRAVITY_MPS2], atol=1e-6)
    assert level_std < 0.05
    assert heading_std > 1.0


@pytest.mark.parametrize(("swing_hz", "pulled"), [(1.0, False), (0.0, True)])
def test_what_swings_in_a_hand_is_no_pull_but_what_lasts_is(swing_hz: float, pulled: bool) -> None:
    """Up and down by 3 m/s2, or for good."""
    state = new_record(AlignmentState)
    state.pair_s = -1e9
    state.force_first_i[2] = state.force_mean_i[2] = -STANDARD_GRAVITY_MPS2
    down = 0.0
    largest = 0.0
    for k in range(3000):
        align_by_gravity(state, 0.01 * k, (0.0, 0.0, down), 0.1, True)
        lift = 3.0 * math.cos(2.0 * math.pi * swing_hz * 0.01 * k)
        down -= 0.01 * (STANDARD_GRAVITY_MPS2 + lift)
        largest = max(largest, state.pull_mps2)
    assert (largest > 1.0) == pulled
    assert (state.turning_mps2 > 0.5) == pulled


def test_gravity_is_found_through_any_shaking_that_gets_nowhere() -> None:
    """The pairs fit badly, and yet the mean force is right but for the change of velocity."""
    state = new_record(AlignmentState)
    state.pair_s = -1e9
    rng = np.random.default_rng(1)
    vel = rng.normal(0.0, 1.0, (60, 3))
    for k in range(60):
        force = vel[k] - [0.0, 0.0, STANDARD_GRAVITY_MPS2 * 0.1 * k]
        align_by_gravity(state, 0.1 * k, tuple(force), 0.09)
    q = solve_alignment(state)
    known, _ = alignment_std(state, misfit(state, q), 0.0)
    state.by_gps = 1
    fitted, _ = alignment_std(state, misfit(state, q), 0.0)
    off = level_difference(q, (1.0, 0.0, 0.0, 0.0))
    assert off < 2.0 * known
    assert known < 0.8 * fitted


class TestVelocityOfFix:
    def test_told_is_taken(self) -> None:
        state = new_record(WayState)
        assert velocity_of_fix(state, 5.0, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) == ((4, 5, 6), 5.0)

    def test_two_places_tell_it_half_way(self) -> None:
        state = new_record(WayState)
        state.way_s = -1e9
        unknown = (NAN, NAN, NAN)
        assert math.isnan(velocity_of_fix(state, 5.0, (0.0, 0.0, -9.0), unknown)[0][0])
        assert math.isnan(velocity_of_fix(state, 5.5, (5.0, 0.0, -9.0), unknown)[0][0])
        vel, at_s = velocity_of_fix(state, 6.0, (10.0, -3.0, -10.0), unknown)
        assert vel == pytest.approx((10.0, -3.0, -1.0))
        assert at_s == 5.5

    def test_heights_tell_the_climb_that_speed_and_course_do_not(self) -> None:
        state = new_record(WayState)
        velocity_of_fix(state, 5.0, (0.0, 0.0, -9.0), (3.0, 4.0, NAN))
        vel, at_s = velocity_of_fix(state, 6.0, (0.0, 0.0, -11.0), (3.0, 4.0, NAN))
        assert vel == pytest.approx((3.0, 4.0, -2.0))
        assert at_s == 6.0

    def test_without_heights_it_does_not_climb(self) -> None:
        state = new_record(WayState)
        velocity_of_fix(state, 5.0, (0.0, 0.0, NAN), (3.0, 4.0, NAN))
        vel, _ = velocity_of_fix(state, 6.0, (0.0, 0.0, NAN), (3.0, 4.0, NAN))
        assert vel == (3.0, 4.0, 0.0)
