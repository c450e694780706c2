"""Motion in an outage that gravity does not show the level of."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    NAV_ATTITUDE_STD,
    NAV_FLAGS,
)
from gateway.estimation.eskf.eskf_settings import EskfSettings, make_gains
from gateway.estimation.eskf.eskf_state import VEL, EskfState
from gateway.estimation.eskf.recovery import begin_attitude, found_level_var
from gateway.estimation.filtering.hidden_pull import (
    HIDDEN_MPS2,
    SHOWN_S,
    hidden_level_var,
    watch_hidden_pull,
)
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import new_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.records import NavFlags
from tests.estimation.samples import G, fix_rows, log_of
from tests.estimation.test_carried_iron import driven
from tests.estimation.test_without_compass import FIXES_HZ, RATE_HZ, estimator_of

ESTIMATORS = ("complementary", "eskf")
FIELD_N_UT = (21.0, 0.0, 43.0)
STARTS_S, LOST_S, ENDS_S = 20.0, 50.0, 75.0
BEGINS_S, LASTS_S = 53.0, 8.0
WING_OVER_MPS2 = (-6.0, 0.0, 3.5)
"""It climbs, falls back and goes home as fast as it came: a light force that points elsewhere."""
SEEDS = range(3)


def samples(seed: int, accel_n_mps2: np.ndarray, fixes_until_s: float) -> SampleLog:
    """Move level, nose to the north, by accelerations of shape (n, 3)."""
    rng, n = np.random.default_rng(seed), len(accel_n_mps2)
    imu = np.zeros((n, IMU_COLUMNS))
    imu[:, ACCEL : ACCEL + 3] = accel_n_mps2 - (0.0, 0.0, G) + rng.normal(0.0, 0.1, (n, 3))
    imu[:, GYRO : GYRO + 3] = rng.normal(0.0, 0.003, (n, 3)) + rng.normal(0.0, 0.003, 3)
    imu[:, MAG : MAG + 3] = FIELD_N_UT + rng.normal(0.0, 0.4, (n, 3))
    vel_n = np.cumsum(accel_n_mps2, axis=0) / RATE_HZ
    pos_n = np.cumsum(vel_n, axis=0) / RATE_HZ
    at = np.arange(RATE_HZ, round(fixes_until_s * RATE_HZ), RATE_HZ // FIXES_HZ)
    fixes = fix_rows(pos_n[at], vel_n[at] + rng.normal(0.0, 0.1, (len(at), 3)))
    return log_of(imu, RATE_HZ, at, fixes)


def tilt_rad(out: np.ndarray) -> np.ndarray:
    """Tell how far the level is off, where all is level in truth."""
    up = 1.0 - 2.0 * (out[:, 1] ** 2 + out[:, 2] ** 2)
    return np.arccos(np.clip(up, -1.0, 1.0))


def wing_over() -> np.ndarray:
    """Stand, fly north, climb, and fly a wing-over; its acceleration, shape (n, 3)."""
    time_s = np.arange(round(ENDS_S * RATE_HZ)) / RATE_HZ
    accel_n = np.zeros((len(time_s), 3))
    accel_n[(time_s > STARTS_S) & (time_s < STARTS_S + 5.0)] = (5.0, 0.0, -2.8)
    accel_n[(time_s > BEGINS_S) & (time_s < BEGINS_S + LASTS_S)] = WING_OVER_MPS2
    return accel_n


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_what_a_flight_pulls_in_an_outage_is_not_taken_for_gravity(name: str, seed: int) -> None:
    """Its mean force lies 43 deg from gravity for eight seconds, and is no stronger."""
    log = samples(seed, wing_over(), LOST_S)
    out = estimator_of(name).run(log)
    lost = log.imu_time_us > LOST_S * 1e6
    assert np.degrees(tilt_rad(out)[lost].max()) < 5.0


def hovering(seed: int, seconds: float) -> tuple[SampleLog, Rotation]:
    """Hover to and fro without GPS from the first sample on: the thrust points along the body.

    The gyroscope reads up to 1 deg/s too much, and no rest has shown it.
    """
    rng, n = np.random.default_rng(seed), round(seconds * RATE_HZ)
    accel_n = gaussian_filter1d(rng.normal(0.0, 1.0, (n, 3)), 0.7 * RATE_HZ, axis=0)
    accel_n *= np.array((1.0, 1.0, 0.3)) / accel_n.std(axis=0)
    down = np.array((0.0, 0.0, G)) - accel_n
    down /= np.linalg.norm(down, axis=1)[:, None]
    right = np.cross(down, (1.0, 0.0, 0.0))
    right /= np.linalg.norm(right, axis=1)[:, None]
    R_nb = Rotation.from_matrix(np.stack([np.cross(right, down), right, down], axis=2))
    turn = (R_nb[:-1].inv() * R_nb[1:]).as_rotvec(), np.zeros((1, 3))
    imu = np.zeros((n, IMU_COLUMNS))
    imu[:, GYRO : GYRO + 3] = RATE_HZ * np.concatenate(turn) + np.radians(rng.uniform(-1, 1, 3))
    imu[:, GYRO : GYRO + 3] += rng.normal(0.0, 0.01, (n, 3))
    imu[:, ACCEL : ACCEL + 3] = R_nb.inv().apply(accel_n - (0.0, 0.0, G))
    imu[:, ACCEL : ACCEL + 3] += rng.normal(0.0, 0.3, (n, 3))
    imu[:, MAG : MAG + 3] = R_nb.inv().apply(FIELD_N_UT) + rng.normal(0.0, 0.4, (n, 3))
    return log_of(imu, RATE_HZ), R_nb


def test_a_hover_that_was_taken_for_a_hand_leaves_no_false_bias() -> None:
    """A speed of about zero teaches a bias that is none, until the way shows that it is flown."""
    off, told = [], []
    for seed in range(8):
        log, R_nb = hovering(seed, 60.0)
        out = estimator_of("eskf").run(log)[30 * RATE_HZ :]
        found = Rotation.from_quat(out[:, :4], scalar_first=True)
        off.append((R_nb[30 * RATE_HZ :] * found.inv()).as_rotvec()[:, :2])
        told.append(out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 2])
    assert np.degrees(np.sqrt(np.mean(np.square(off)))) < 12.0
    assert np.mean(np.abs(off) < 2.0 * np.array(told)) > 0.6


def test_an_attitude_found_in_flight_knows_of_the_speed_that_has_shown_itself() -> None:
    """Not of a hand's: neither the velocity, nor the level that the mean force has told."""
    s, gains = (
        new_record(EskfState),
        make_gains(EskfSettings(), ReferenceSettings(), RestSettings(), CompassSettings()),
    )
    s.q_nb[0] = 1.0
    s.unaided_sq, s.level_std, s.gathered_s = 12.0**2, 0.02, 10.0
    leans = math.sqrt(2.0) * 12.0 / (G * 10.0)
    assert found_level_var(s) == pytest.approx(leans**2)
    s.by_gps = 1
    assert found_level_var(s) == pytest.approx(0.02**2)
    begin_attitude(s, gains, 0.01, 1.0)
    assert np.diag(s.P)[VEL : VEL + 3].tolist() == [12.0**2] * 3


@pytest.mark.parametrize("name", ESTIMATORS)
def test_where_no_rest_was_seen_what_may_pull_unseen_is_told(name: str) -> None:
    """A gateway started in a drive, without GPS: what the car pulls passes for its level."""
    off, told = [], []
    for seed in range(6):
        log, _ = driven(seed)
        begins = round(40.0 * RATE_HZ)
        out = estimator_of(name).run(log_of(log.imu[begins:], RATE_HZ))
        valid = (out[:, NAV_FLAGS].astype(int) & NavFlags.ATTITUDE_VALID) != 0
        off.append(tilt_rad(out)[valid])
        told.append(np.hypot(*out[valid, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 2].T))
    assert np.mean(np.concatenate(off) < 2.0 * np.concatenate(told)) > 0.9


@pytest.mark.parametrize("tilts", [False, True], ids=["a vehicle", "a hand"])
def test_what_tilts_and_does_not_pull_hides_no_pull(tilts: bool) -> None:
    s, upright = new_record(EskfState), (1.0, 0.0, 0.0, 0.0)
    rate_b = (0.0, 1.0, 0.0) if tilts else (0.0, 0.0, 1.0)
    for _ in range(300):
        watch_hidden_pull(s, upright, rate_b, False, 0.1)
    hidden = math.sqrt(hidden_level_var(s))
    assert hidden == pytest.approx(0.0 if tilts else HIDDEN_MPS2 / G, abs=1e-3)
    watch_hidden_pull(s, upright, rate_b, True, 0.1)
    assert math.sqrt(hidden_level_var(s)) == pytest.approx(HIDDEN_MPS2 / G)
    s.rest_s = SHOWN_S + 0.1
    watch_hidden_pull(s, upright, rate_b, False, 0.1)
    assert hidden_level_var(s) == 0.0
