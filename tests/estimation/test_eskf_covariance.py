"""The filter's hand-written matrix products against the matrices themselves."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.eskf.covariance import (
    NO_HEADING_VAR,
    clear,
    consider,
    innovation_variance,
    propagate,
    update_scalar,
)
from gateway.estimation.eskf.eskf_settings import EskfSettings, make_gains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    GYRO_SCALE,
    MAG_BIAS,
    POS,
    STATES,
    TILT,
    VEL,
    WANDER,
    EskfState,
)
from gateway.estimation.eskf.iron import (
    dip_by_tilt,
    doubt_iron,
    spread_heading,
    update_by_dip,
)
from gateway.estimation.eskf.late_fix import position_row, velocity_row
from gateway.estimation.eskf.measure import (
    compass_row,
    take_back,
    update_by_compass,
    update_by_velocity,
)
from gateway.estimation.filtering.iron_evidence import dip_by_iron
from gateway.estimation.filtering.roughness import collect_roughness
from gateway.estimation.kernel_record import new_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings

GAINS = make_gains(EskfSettings(), ReferenceSettings(), RestSettings(), CompassSettings())


def cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@pytest.fixture
def state(rng: np.random.Generator) -> EskfState:
    s = new_record(EskfState)
    root = rng.normal(size=(STATES, STATES))
    s.P[:] = root @ root.T
    s.q_nb[:] = [1.0, 0.0, 0.0, 0.0]
    return s


def transition(
    force: np.ndarray, turn: np.ndarray, dt: float, scaled: np.ndarray | None = None
) -> np.ndarray:
    F = np.eye(STATES)
    if scaled is not None:
        F[TILT : TILT + 3, GYRO_SCALE : GYRO_SCALE + 3] = -scaled
    F[TILT : TILT + 3, GYRO_BIAS : GYRO_BIAS + 3] = -turn
    F[VEL : VEL + 3, TILT : TILT + 3] = -cross(force)
    F[VEL : VEL + 3, ACCEL_BIAS : ACCEL_BIAS + 3] = -turn
    F[POS : POS + 3, VEL : VEL + 3] = dt * np.eye(3)
    return F


@pytest.mark.parametrize("aided", [1, 0])
def test_propagation_is_the_matrix_product(
    state: EskfState, rng: np.random.Generator, aided: int
) -> None:
    force, turn, dt = rng.normal(size=3), rng.normal(size=(3, 3)), 0.02
    scaled = rng.normal(size=(3, 3))
    state.P *= 0.01
    before = state.P.copy()
    state.pending_s, state.aided = dt, aided
    state.pending_force_n[:], state.pending_turn[:] = force, turn
    state.pending_scaled[:] = scaled
    propagate(state, GAINS)
    F = transition(force, turn, dt, scaled)
    F[VEL : VEL + 3, TILT + 2] *= aided
    kept = [k for k in range(STATES) if not WANDER <= k < WANDER + 3]
    expected = F @ before @ F.T
    added = state.P - expected
    block = added[np.ix_(kept, kept)]
    np.testing.assert_allclose(block - np.diag(np.diag(block)), 0.0, atol=1e-9)
    diagonal = np.diag(block)
    assert (diagonal[: TILT + 2] >= 0).all()
    assert diagonal[VEL] == pytest.approx(GAINS.accel_density * dt, rel=1e-6)
    np.testing.assert_allclose(state.P, state.P.T, atol=1e-9)
    assert state.pending_s == 0.0


def test_a_turn_makes_every_axis_less_sure() -> None:
    variances = []
    for turned_rad in (0.0, 0.3):
        s = new_record(EskfState)
        s.pending_s, s.pending_rad = 0.02, turned_rad
        propagate(s, GAINS)
        assert s.pending_rad == 0.0
        variances.append(np.diag(s.P)[TILT : TILT + 3])
    expected = np.full(3, 0.3 * GAINS.gyro_turn_var)
    np.testing.assert_allclose(variances[1] - variances[0], expected, rtol=1e-9)


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_noise_is_told_from_a_rate_that_grows(gain: float, rng: np.random.Generator) -> None:
    s, dt, noise, count = new_record(EskfState), 0.01, 0.03, 4000
    steady = np.arange(count)[:, None] * gain * dt + np.zeros(3)
    gyro, accel = (steady + noise * rng.standard_normal((count, 3)) for _ in range(2))
    samples = [(tuple(g), tuple(a)) for g, a in zip(gyro.tolist(), accel.tolist(), strict=True)]
    for before, now in pairwise(samples):
        collect_roughness(s, *now, *before, dt)
    expected = pytest.approx(count * (noise * dt) ** 2, rel=0.1)
    assert s.rough_gyro == expected
    assert s.rough_accel == expected


def test_a_sample_that_is_no_number_is_forgotten() -> None:
    s = new_record(EskfState)
    for before, rate in pairwise((0.0, math.nan, 0.0, 0.0)):
        one, other = (before, 0.0, 0.0), (0.0, 0.0, before)
        collect_roughness(s, (rate, 0.0, 0.0), (0.0, 0.0, rate), one, other, 0.01)
    assert s.rough_gyro == s.rough_accel == 0.0
    assert s.gyro_change.tolist() == s.accel_change.tolist() == [0.0, 0.0, 0.0]


def test_a_heading_of_which_nothing_is_known_keeps_its_correlations(
    state: EskfState, rng: np.random.Generator
) -> None:
    """A smaller variance alone would make them greater than one, and updates run away."""
    state.P[TILT + 2] *= 100.0
    state.P[:, TILT + 2] *= 100.0
    assert state.P[TILT + 2, TILT + 2] > NO_HEADING_VAR
    state.pending_s = 1e-9
    propagate(state, GAINS)
    assert state.P[TILT + 2, TILT + 2] == pytest.approx(NO_HEADING_VAR)
    assert np.linalg.eigvalsh(state.P).min() > -1e-9


def test_update_is_the_kalman_update(state: EskfState, rng: np.random.Generator) -> None:
    before, h = state.P.copy(), rng.normal(size=STATES)
    state.aided = 1
    clear(state)
    state.h[:] = h
    update_scalar(state, 2.0, 3.0, 1e12)
    gain = before @ h / (h @ before @ h + 3.0)
    np.testing.assert_allclose(state.dx, gain * 2.0, atol=1e-9)
    np.testing.assert_allclose(state.P, before - np.outer(gain, h @ before), atol=1e-8)


def test_held_states_are_considered_but_not_changed(
    state: EskfState, rng: np.random.Generator
) -> None:
    before, h = state.P.copy(), rng.normal(size=STATES)
    clear(state)
    state.h[:] = h
    consider(state, ACCEL_BIAS, 3)
    update_scalar(state, 2.0, 3.0, 1e12)
    held = slice(ACCEL_BIAS, ACCEL_BIAS + 3)
    np.testing.assert_array_equal(state.dx[held], 0.0)
    np.testing.assert_allclose(state.P[held, held], before[held, held])
    assert np.linalg.eigvalsh(state.P).min() > -1e-8


def test_without_gps_gravity_tells_the_scale_and_the_compass_does_not(state: EskfState) -> None:
    held = slice(GYRO_SCALE, GYRO_SCALE + 3)
    before = state.P[held, held].copy()
    update_by_compass(state, GAINS, (20.0, 3.0, 40.0), 0.0, 1.0, 0.1)
    np.testing.assert_array_equal(state.gyro_scale_b, 0.0)
    np.testing.assert_allclose(state.P[held, held], before)
    state.vel_n[:] = 0.3, -0.2, 0.1
    update_by_velocity(state, GAINS, 1.0)
    assert np.all(state.gyro_scale_b != 0.0)
    assert np.all(np.diag(state.P[held, held]) < np.diag(before))
    np.testing.assert_array_equal(state.gyro_scale_b, state.assumed_scale)
    take_back(state)
    np.testing.assert_array_equal(state.gyro_scale_b, 0.0)


def test_an_outlier_moves_little_and_is_never_ignored(state: EskfState) -> None:
    moves = []
    for innovation in (1.0, 10.0, 1000.0):
        s = state.copy()
        clear(s)
        s.h[POS] = 1.0
        s.P[:] = np.eye(STATES)
        update_scalar(s, innovation, 1.0, 25.0)
        moves.append(float(s.dx[POS]))
    assert moves[0] == pytest.approx(0.5)
    assert 0.0 < moves[2] < moves[1] < 5.1


def test_a_late_row_is_the_present_error_carried_back(rng: np.random.Generator) -> None:
    s = new_record(EskfState)
    s.q_nb[:] = [1.0, 0.0, 0.0, 0.0]
    lag, steps = 0.3, 3000
    dt = lag / steps
    forces = np.array([3.0, -2.0, -9.0]) + np.outer(np.linspace(0, 1, steps), [1.0, 2.0, 0.5])
    F, once, twice = np.eye(STATES), np.zeros(3), np.zeros(3)
    for force in forces:
        F = transition(force * dt, np.eye(3) * dt, dt) @ F
        twice += once * dt + 0.5 * force * dt * dt
        once += force * dt
    back = np.linalg.inv(F)
    for k in range(3):
        velocity_row(s, k, tuple(once), lag)
        expected = back[VEL + k].copy()
        expected[GYRO_BIAS : GYRO_BIAS + 3] = 0.0
        np.testing.assert_allclose(s.h, expected, atol=2e-3)
        position_row(s, k, tuple(once), tuple(twice), lag)
        expected = back[POS + k].copy()
        expected[GYRO_BIAS : GYRO_BIAS + 3] = 0.0
        expected[WANDER + k] = 1.0
        np.testing.assert_allclose(s.h, expected, atol=2e-3)


def test_the_compass_row_tells_what_iron_does_to_the_heading(rng: np.random.Generator) -> None:
    s = new_record(EskfState)
    q = rng.normal(size=4)
    s.q_nb[:] = q / np.linalg.norm(q)
    attitude = Rotation.from_quat(s.q_nb, scalar_first=True)
    field_n = np.array([20.0, 6.0, 40.0])

    def heading(field: np.ndarray) -> float:
        return -math.atan2(field[1], field[0])

    clear(s)
    compass_row(s, tuple(field_n))
    for k in range(3):
        # What is measured is the iron that the estimate lacks, turned to NED.
        bent = field_n + attitude.apply(1e-6 * np.eye(3)[k])
        slope = (heading(bent) - heading(field_n)) / 1e-6
        assert s.h[MAG_BIAS + k] == pytest.approx(slope, rel=1e-4)


def dip_of(field: np.ndarray) -> float:
    return math.atan2(field[2], math.hypot(field[0], field[1]))


def test_the_row_of_the_dip_tells_what_tilt_does_to_it(rng: np.random.Generator) -> None:
    s = new_record(EskfState)
    attitude = Rotation.from_quat(rng.normal(size=4), scalar_first=True)
    s.q_nb[:] = attitude.as_quat(scalar_first=True)
    field_n = np.array([20.0, 6.0, 40.0])
    dip_by_tilt(s, tuple(field_n))
    for k in range(3):
        tilted = Rotation.from_rotvec(1e-6 * np.eye(3)[k]).apply(field_n)
        slope = (dip_of(tilted) - dip_of(field_n)) / 1e-6
        assert s.h[TILT + k] == pytest.approx(slope, abs=1e-5)


def test_the_dip_tells_iron_no_better_than_the_dip_itself_is_known() -> None:
    s = new_record(EskfState)
    s.q_nb[0] = 1.0
    s.aided = s.iron_search_started = 1
    earth_n = np.array([20.0, 6.0, 40.0])
    s.earth_dip_rad = dip_of(earth_n)
    for k in range(3):
        s.P[TILT + k, TILT + k], s.P[MAG_BIAS + k, MAG_BIAS + k] = 0.01**2, 15.0**2
    iron = np.array([0.0, 0.0, -12.0])
    for _ in range(500):
        update_by_dip(s, GAINS, tuple(earth_n + iron - s.mag_bias_b), 0.05)
    left = dip_of(earth_n + iron - s.mag_bias_b) - s.earth_dip_rad
    assert abs(left) < math.radians(2.0)
    clear(s)
    s.h[MAG_BIAS : MAG_BIAS + 3] = dip_by_iron(tuple(s.q_nb), tuple(earth_n))
    assert math.radians(2.0) < math.sqrt(s.h @ s.P @ s.h) < math.radians(3.5)
    assert list(s.q_nb) == [1.0, 0.0, 0.0, 0.0]


def test_a_field_that_proves_less_level_is_no_evidence_of_iron_across_it() -> None:
    """A heading that followed the compass agrees with it, whatever the iron is."""
    s = new_record(EskfState)
    s.q_nb[0] = 1.0
    s.field_n[:] = (31.0, 5.0, 28.0)
    s.heading_known, s.compass_share = 1, 1.0
    doubt_iron(s, 3.0**2)
    spread_heading(s, tuple(s.field_n), 0.5)
    clear(s)
    compass_row(s, tuple(s.field_n / 1.5))
    assert math.sqrt(innovation_variance(s, 0.0)) < 1e-9
    assert math.sqrt(s.P[TILT + 2, TILT + 2]) == pytest.approx(1.5 * 3.0 / math.hypot(31.0, 5.0))
