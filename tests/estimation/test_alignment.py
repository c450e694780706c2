"""The attitude out of motion: from any start, by exact and noisy pairs."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.alignment.gps_velocity import WayState, velocity_of_fix
from gateway.estimation.alignment.heading_evidence import heading_evidence
from gateway.estimation.alignment.review import turned
from gateway.estimation.alignment.wahba import (
    AlignmentState,
    align_by_gravity,
    align_by_velocity,
    alignment_level_std,
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
    drift_radps: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Ten seconds of accelerations, seen in a frame that lies in NED by `attitude`.

    Each lasts for 0.2 s, or is correlated over `lasts_s`. The frame drifts about north and east.
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
        tilted = Rotation.from_rotvec([0.2 * k * drift_radps[0], 0.2 * k * drift_radps[1], 0.0])
        force_i = force_i + 0.2 * attitude.inv().apply(tilted.apply(force_n))


def heading_off(
    state: AlignmentState, attitude: Rotation, bias_radps: float = 0.0
) -> tuple[float, float]:
    """Tell the error of the heading that the pairs tell, and its standard deviation, rad."""
    q = solve_alignment(state)
    turn_rad, std_rad = heading_evidence(state, q, bias_radps)
    true = tuple(attitude.as_quat(scalar_first=True))
    return heading_difference(turned(q, turn_rad), true), std_rad


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
        level_std = alignment_level_std(state, misfit(state, q))
        true = tuple(attitude.as_quat(scalar_first=True))
        # The same vector in the body stands for the vertical of both.
        level.append(level_difference(q, true) / level_std)
        off_rad, std_rad = heading_off(state, attitude)
        heading.append(off_rad / std_rad)
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
        level_std = alignment_level_std(state, misfit(state, q))
        true = tuple(attitude.as_quat(scalar_first=True))
        off.append(level_difference(q, true) / level_std)
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.3


@pytest.mark.parametrize("noise_mps", [0.05, 0.2, 0.8])
@pytest.mark.parametrize("seed", range(6))
def test_noise_alone_tells_no_heading(noise_mps: float, seed: int) -> None:
    """The force does not share it, however long it adds up."""
    state = new_record(AlignmentState)
    feed(state, Rotation.identity(), seed, noise_mps, pull_mps2=0.02, fixes=300)
    assert heading_off(state, Rotation.identity())[1] > 0.6


@pytest.mark.parametrize("noise_mps", [0.1, 0.4, 0.8])
def test_a_heading_told_by_little_is_as_unsure_as_the_noise_makes_it(noise_mps: float) -> None:
    """Also that of a receiver which is worse than the weights of the pairs say."""
    ratios = []
    for seed in range(80):
        attitude = Rotation.from_rotvec([0.0, 0.0, 0.1 * seed])
        state = new_record(AlignmentState)
        feed(state, attitude, seed, noise_mps, 4.0 * noise_mps, lasts_s=1.0, fixes=60)
        off_rad, std_rad = heading_off(state, attitude)
        ratios.append(off_rad / std_rad)
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.1
    assert np.mean(np.abs(ratios) < 2.0) >= 0.93


@pytest.mark.parametrize("pull_mps2", [0.0, 0.5])
def test_the_noise_of_a_receiver_is_learned(pull_mps2: float) -> None:
    """Of 0.8 m/s where 0.2 is taken for granted, standing or not."""
    state = new_record(AlignmentState)
    feed(state, Rotation.identity(), 1, 0.8, pull_mps2, fixes=200)
    heading_off(state, Rotation.identity())
    assert 0.2**2 * state.noise_excess == pytest.approx(0.8**2, rel=0.35)


def test_a_drift_within_what_the_bias_may_be_is_no_pull() -> None:
    """A frame that drifts off level lets gravity pass for a pull."""
    bias_radps, ratios, naive, aware = math.radians(1.0), [], [], []
    for seed in range(40):
        drift = tuple(np.random.default_rng(100 + seed).normal(0.0, bias_radps, 2))
        state = new_record(AlignmentState)
        feed(state, Rotation.identity(), seed, 0.05, 0.5, 2.0, drift_radps=drift)
        naive.append(heading_off(state, Rotation.identity())[0])
        off_rad, std_rad = heading_off(state, Rotation.identity(), bias_radps)
        aware.append(off_rad)
        ratios.append(off_rad / std_rad)
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    assert np.std(aware) < 0.7 * np.std(naive)


def test_gravity_tells_the_level_alone() -> None:
    attitude = Rotation.from_euler("ZYX", [1.0, 0.4, -2.5])
    state = new_record(AlignmentState)
    state.pair_s = -1e9
    force = attitude.inv().apply([0.0, 0.0, -STANDARD_GRAVITY_MPS2])
    for k in range(30):
        align_by_gravity(state, 0.1 * k, tuple(force * 0.1 * k), 0.1)
    level_std = alignment_level_std(state, 1.0)
    found = Rotation.from_quat(solve_alignment(state), scalar_first=True)
    np.testing.assert_allclose(found.apply(force), [0.0, 0.0, -STANDARD_GRAVITY_MPS2], atol=1e-6)
    assert level_std < 0.05


@pytest.mark.parametrize(("swing_hz", "pulled"), [(1.0, False), (0.0, True)])
def test_what_swings_in_a_hand_is_no_pull_but_what_lasts_is(swing_hz: float, pulled: bool) -> None:
    """Up and down by 3 m/s2, or for good; it takes some swings to tell."""
    state = new_record(AlignmentState)
    state.pair_s = -1e9
    state.force_first_i[2] = state.force_mean_i[2] = -STANDARD_GRAVITY_MPS2
    down = 0.0
    largest = 0.0
    for k in range(3000):
        align_by_gravity(state, 0.01 * k, (0.0, 0.0, down), 0.1, True)
        lift = 3.0 * math.cos(2.0 * math.pi * swing_hz * 0.01 * k)
        down -= 0.01 * (STANDARD_GRAVITY_MPS2 + lift)
        if k > 300:
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
    known = alignment_level_std(state, misfit(state, q))
    state.by_gps = 1
    fitted = alignment_level_std(state, misfit(state, q))
    off = level_difference(q, (1.0, 0.0, 0.0, 0.0))
    assert off < 2.0 * known
    assert known < 0.8 * fitted


@pytest.mark.parametrize("swings", [False, True])
def test_a_turn_that_a_flight_begins_in_is_not_taken_for_level(swings: bool) -> None:
    """A bank of 27 deg: at first it pulls one way, and only its strength tells it from gravity."""
    state = new_record(AlignmentState)
    state.pair_s = -1e9
    force_i = np.zeros(3)
    for k in range(61):
        align_by_gravity(state, 0.1 * k, tuple(force_i), 0.09, swings)
        turned = 0.3 * 0.1 * k
        pull = 5.0 * np.array([math.cos(turned), math.sin(turned), 0.0])
        force_i = force_i + 0.1 * (pull - [0.0, 0.0, STANDARD_GRAVITY_MPS2])
        if k in {5, 10, 20, 40, 60}:
            q = solve_alignment(state)
            off = level_difference(q, (1.0, 0.0, 0.0, 0.0))
            assert off < 2.0 * alignment_level_std(state, misfit(state, q))
            assert state.pull_mps2 > 2.0


def test_what_no_manoeuvre_does_is_no_pair() -> None:
    """A first height of zero, and the true one a second later, say 500 m/s."""
    state = new_record(AlignmentState)
    feed(state, Rotation.from_euler("ZYX", [1.0, 0.1, 0.2]), 1)
    before = solve_alignment(state)
    at_s = state.pair_s
    for late_s, climb_mps in ((1.0, -500.0), (2.0, 0.0)):
        vel = (state.pair_vel[0], state.pair_vel[1], climb_mps)
        x, y, z = state.pair_force
        force_i = (x, y, z - STANDARD_GRAVITY_MPS2)
        assert align_by_velocity(state, at_s + late_s, vel, force_i, 0.6) == 0.0
    assert level_difference(solve_alignment(state), before) < 1e-6


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
