"""Steady motion without GPS: as quiet as rest, and no rest."""

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
    NAV_FLAGS,
    NAV_VEL,
)
from gateway.estimation.kernel import SampleLog
from gateway.geometry.angle import wrap_pi
from gateway.records import NavFlags
from tests.estimation.samples import G, fix_rows, log_of
from tests.estimation.test_lost_samples import swinging, tilt_errors_deg
from tests.estimation.test_without_compass import FIXES_HZ, RATE_HZ, correlated, estimator_of

FIELD_N_UT = (21.0, 0.0, 43.0)
SPEED_MPS = 8.0
TURN_RADPS = math.radians(3.0)
STARTS_S, LOST_S, STOPS_S, ENDS_S = 30.0, 70.0, 80.0, 95.0
LASTS_S = 20.0
"""Later the speed may be none, for all that dead reckoning knows."""
PACE_S = 6.0
"""It starts, and stops, within this time."""
SEEDS = range(4)


def drive(seed: int, *, stops: bool) -> tuple[SampleLog, np.ndarray]:
    """Drive north on a smooth road, lose GPS, and go on or stop; also tell the speed, m/s."""
    rng, n = np.random.default_rng(seed), round(ENDS_S * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    speed = np.clip((time_s - STARTS_S) / PACE_S, 0.0, 1.0)
    if stops:
        speed -= np.clip((time_s - STOPS_S) / PACE_S, 0.0, 1.0)
    speed *= SPEED_MPS
    imu = np.full((n, IMU_COLUMNS), 0.0)
    imu[:, ACCEL : ACCEL + 3] = rng.normal(0.0, 0.06, (n, 3)) + rng.normal(0.0, 0.03, 3)
    imu[:, ACCEL] += np.gradient(speed, time_s)
    imu[:, ACCEL + 2] -= G
    imu[:, GYRO : GYRO + 3] = rng.normal(0.0, 0.003, (n, 3)) + rng.normal(0.0, 0.005, 3)
    imu[:, MAG : MAG + 3] = FIELD_N_UT + rng.normal(0.0, 0.4, (n, 3))
    at = np.arange(RATE_HZ, round(LOST_S * RATE_HZ), RATE_HZ // FIXES_HZ)
    vel_n = np.outer(speed, (1.0, 0.0, 0.0))
    place = np.cumsum(vel_n, axis=0)[at] / RATE_HZ
    fixes = fix_rows(place, vel_n[at] + rng.normal(0.0, 0.1, (len(at), 3)))
    return log_of(imu, RATE_HZ, at, fixes), speed


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_what_rolls_on_in_an_outage_does_not_rest(name: str, seed: int) -> None:
    log, speed = drive(seed, stops=False)
    out = estimator_of(name).run(log)
    lost = (log.imu_time_us > LOST_S * 1e6) & (log.imu_time_us < (LOST_S + LASTS_S) * 1e6)
    assert not (out[lost, NAV_FLAGS].astype(int) & NavFlags.AT_REST).any()
    assert np.abs(out[lost, NAV_VEL] - speed[lost]).max() < 0.5 * SPEED_MPS


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_what_stops_in_an_outage_rests(name: str, seed: int) -> None:
    log, _ = drive(seed, stops=True)
    out = estimator_of(name).run(log)
    rests = (out[:, NAV_FLAGS].astype(int) & NavFlags.AT_REST) != 0
    time_s = log.imu_time_us * 1e-6
    assert not rests[(time_s > LOST_S) & (time_s < STOPS_S)].any()
    assert rests[time_s > STOPS_S + PACE_S + 4.0].all()
    assert np.abs(out[-1, NAV_VEL : NAV_VEL + 2]).max() < 0.2


def circle(seed: int) -> tuple[SampleLog, np.ndarray]:
    """Stand, then roll round a wide circle on a smooth road without GPS; also tell the heading."""
    rng, n = np.random.default_rng(seed), round(ENDS_S * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    rolls = np.clip((time_s - STARTS_S) / PACE_S, 0.0, 1.0)
    heading_rad = np.cumsum(rolls) * TURN_RADPS / RATE_HZ
    imu = np.full((n, IMU_COLUMNS), 0.0)
    imu[:, ACCEL : ACCEL + 3] = rng.normal(0.0, 0.06, (n, 3))
    imu[:, ACCEL + 1] += rolls * SPEED_MPS * TURN_RADPS
    imu[:, ACCEL + 2] -= G
    imu[:, GYRO : GYRO + 3] = rng.normal(0.0, 0.003, (n, 3)) + rng.normal(0.0, 0.005, 3)
    imu[:, GYRO + 2] += rolls * TURN_RADPS
    back = Rotation.from_rotvec(np.outer(-heading_rad, [0.0, 0.0, 1.0]))
    imu[:, MAG : MAG + 3] = back.apply(np.tile(FIELD_N_UT, (n, 1))) + rng.normal(0.0, 0.4, (n, 3))
    return log_of(imu, RATE_HZ), heading_rad


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_slow_turn_is_no_rest_and_its_rate_no_bias(name: str, seed: int) -> None:
    """The gyroscope is as quiet as at rest, but a rest has shown that its bias is another."""
    log, heading_rad = circle(seed)
    out = estimator_of(name).run(log)
    turning = log.imu_time_us > (STARTS_S + PACE_S) * 1e6
    assert not (out[turning, NAV_FLAGS].astype(int) & NavFlags.AT_REST).any()
    found = Rotation.from_quat(out[turning, :4], scalar_first=True).as_euler("ZYX")[:, 0]
    assert np.degrees(np.abs(wrap_pi(found - heading_rad[turning]))).max() < 4.0


def waved(seed: int, jump_degps: tuple[float, float, float]) -> tuple[SampleLog, Rotation]:
    """Stand, be waved about by a hand, and be laid down, the gyroscope's bias jumping midway."""
    rng, n = np.random.default_rng(seed), round(ENDS_S * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    waves = ((time_s > STARTS_S) & (time_s < LOST_S)).astype(float)[:, None]
    rate = correlated(rng, n, RATE_HZ, 0.8, 0.6) * waves
    turns, attitude = [], Rotation.identity()
    for step in Rotation.from_rotvec(rate / RATE_HZ):
        turns.append(attitude.as_quat())
        attitude *= step
    attitudes = Rotation.from_quat(turns)
    imu = np.full((n, IMU_COLUMNS), 0.0)
    imu[:, ACCEL : ACCEL + 3] = attitudes.inv().apply(np.tile([0.0, 0.0, -G], (n, 1)))
    imu[:, ACCEL : ACCEL + 3] += rng.normal(0.0, 0.05, (n, 3))
    imu[:, ACCEL : ACCEL + 3] += correlated(rng, n, RATE_HZ, 1.0, 0.3) * waves
    jumped = time_s > 0.5 * (STARTS_S + LOST_S)
    imu[1:, GYRO : GYRO + 3] = rate[:-1]
    imu[:, GYRO : GYRO + 3] += np.outer(jumped, np.radians(jump_degps))
    imu[:, GYRO : GYRO + 3] += rng.normal(0.0, 0.003, (n, 3)) + rng.normal(0.0, 0.005, 3)
    imu[:, MAG : MAG + 3] = math.nan
    return log_of(imu, RATE_HZ), attitudes


def tilt_off(out: np.ndarray, attitudes: Rotation) -> np.ndarray:
    """Return the angle between what is told to be up and what is, rad."""
    found = Rotation.from_quat(out[:, :4], scalar_first=True)
    up = (0.0, 0.0, -1.0)
    cosine = np.sum(found.inv().apply(up) * attitudes.inv().apply(up), axis=1)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


@pytest.mark.parametrize("jump_degps", [(1.0, 1.0, 1.0), (1.0, -1.5, 0.0)])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_level_that_a_bias_has_turned_is_no_push(
    name: str, seed: int, jump_degps: tuple[float, float, float]
) -> None:
    """Laid down, the force stands still in the body, whatever the gyroscope says."""
    log, attitudes = waved(seed, jump_degps)
    out = estimator_of(name).run(log)
    laid = log.imu_time_us > (LOST_S + 15.0) * 1e6
    assert np.degrees(tilt_off(out[laid], attitudes[np.flatnonzero(laid)])).max() < 2.0


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_banked_circle_in_calm_air_is_no_rest(name: str, seed: int) -> None:
    """The force stands still in the body there too, but is as strong as the bank makes it."""
    rng, n = np.random.default_rng(seed), round(ENDS_S * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    turns = gaussian_filter1d((time_s > STARTS_S + PACE_S).astype(float), RATE_HZ)
    bank = math.radians(25.0) * turns
    yaw = np.cumsum(math.radians(5.0) * turns) / RATE_HZ
    attitudes = Rotation.from_euler("ZYX", np.column_stack([yaw, 0.0 * yaw, bank]))
    imu = np.full((n, IMU_COLUMNS), 0.0)
    imu[:, ACCEL : ACCEL + 3] = rng.normal(0.0, 0.06, (n, 3))
    imu[:, ACCEL + 2] -= G / np.cos(bank)
    imu[1:, GYRO : GYRO + 3] = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() * RATE_HZ
    imu[:, GYRO : GYRO + 3] += rng.normal(0.0, 0.003, (n, 3)) + rng.normal(0.0, 0.005, 3)
    imu[:, MAG : MAG + 3] = math.nan
    out = estimator_of(name).run(log_of(imu, RATE_HZ))
    banked = (time_s > STARTS_S + PACE_S + 2.0) & (time_s < STARTS_S + PACE_S + 6.0)
    assert not (out[banked, NAV_FLAGS].astype(int) & NavFlags.AT_REST).any()
    assert np.degrees(tilt_off(out[banked], attitudes[np.flatnonzero(banked)])).max() < 10.0


@pytest.mark.parametrize("swing_hz", [0.02, 0.05])
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_what_swings_slowly_does_not_rest(name: str, swing_hz: float) -> None:
    """From the first sample on: the force and the rate turn on, if slowly, and the bias is none."""
    log, truth = swinging(swing_hz, stands_s=0.0)
    tilt_deg, valid = tilt_errors_deg(name, log, truth)
    after = log.imu_time_us > 10e6
    assert valid[after].all()
    assert tilt_deg[after].max() < 1.0
