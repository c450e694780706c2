"""Samples of the IMU that a radio loses: what turned meanwhile is told by both ends."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    CLIPPED,
    GPS_ALT,
    GPS_COLUMNS,
    GPS_DECLINATION,
    GPS_LAT,
    GPS_LON,
    GPS_USABLE,
    GPS_VEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    NAV_FLAGS,
)
from gateway.estimation.kernel import SampleLog
from gateway.records import NavFlags
from tests.estimation.samples import G
from tests.estimation.test_without_compass import estimator_of

RATE_HZ = 100
SECONDS, STANDS_S = 60.0, 5.0
SWING_HZ, SWING_RAD = 0.4, 1.2
LOST_EVERY_S = [(0.1, 0.7), (0.4, 4.7)]
LONG_S, LONG_EVERY_S = 0.6, 6.7
GPS_LOST_S, GPS_EVERY_S = 0.7, 7.7
FIXES_HZ = 5
SLOW_HZ = 0.2
GENTLE_HZ = 0.02


def swinging(swing_hz: float = SWING_HZ, stands_s: float = STANDS_S) -> tuple[SampleLog, Rotation]:
    """Swing about the forward axis to and fro, after a rest; each sample tells its own instant."""
    t = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    phase = 2.0 * math.pi * swing_hz * np.clip(t - stands_s, 0.0, None)
    roll = SWING_RAD * (1.0 - np.cos(phase)) / 2.0
    truth = Rotation.from_rotvec(np.outer(roll, [1.0, 0.0, 0.0]))
    imu = np.full((len(t), IMU_COLUMNS), math.nan)
    imu[:, ACCEL : ACCEL + 3] = truth.inv().apply([0.0, 0.0, -G])
    imu[:, GYRO : GYRO + 3] = 0.0
    imu[:, GYRO] = math.pi * swing_hz * SWING_RAD * np.sin(phase)
    imu[:, : GYRO + 3] += np.random.default_rng(3).normal(0.0, 1e-3, (len(t), 6))
    imu[:, MAG : MAG + 3] = truth.inv().apply([21.0, 0.0, 43.0])
    imu[:, CLIPPED] = 0.0
    no_us = np.empty(0, np.int64)
    log = SampleLog(
        np.round(t * 1e6).astype(np.int64), imu, no_us, np.empty(0), no_us,
        np.empty((0, GPS_COLUMNS)),
    )  # fmt: skip
    return log, truth


def with_gps(log: SampleLog) -> SampleLog:
    """Add fixes of a receiver that stands where it swings."""
    time_us = np.arange(0, round(SECONDS * 1e6), round(1e6 / FIXES_HZ))
    gps = np.full((len(time_us), GPS_COLUMNS), math.nan)
    rng = np.random.default_rng(4)
    gps[:, GPS_USABLE], gps[:, GPS_DECLINATION] = 1.0, 0.0
    gps[:, GPS_LAT], gps[:, GPS_LON], gps[:, GPS_ALT] = 47.0, 8.0, 500.0
    gps[:, GPS_VEL : GPS_VEL + 3] = rng.normal(0.0, 0.1, (len(time_us), 3))
    return replace(log, gps_time_us=time_us, gps=gps)


def tilt_errors_deg(name: str, log: SampleLog, truth: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Run an estimator; tell how far its tilt is off, and whether it says that it knows it."""
    out = estimator_of(name).run(log)
    off = Rotation.from_quat(out[:, :4], scalar_first=True) * truth.inv()
    w, z = off.as_quat(scalar_first=True)[:, [0, 3]].T
    valid = (out[:, NAV_FLAGS].astype(int) & NavFlags.ATTITUDE_VALID) != 0
    return np.degrees(2.0 * np.arccos(np.hypot(w, z).clip(max=1.0))), valid


def without(log: SampleLog, keep: np.ndarray) -> SampleLog:
    return SampleLog(
        log.imu_time_us[keep], log.imu[keep], log.baro_time_us, log.baro_alt_m, log.gps_time_us,
        log.gps,
    )  # fmt: skip


@pytest.mark.parametrize(("lost_s", "every_s"), LOST_EVERY_S)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_what_turned_while_samples_were_lost_is_told_by_both_ends(
    name: str, lost_s: float, every_s: float
) -> None:
    log, truth = swinging()
    keep = (log.imu_time_us * 1e-6) % every_s >= lost_s
    log = without(log, keep)
    tilt_deg, valid = tilt_errors_deg(name, log, truth[keep])
    after = log.imu_time_us > 2e6 * STANDS_S
    assert np.sqrt(np.mean(tilt_deg[after] ** 2)) < 0.8
    assert tilt_deg[after & valid].max() < 3.0


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_silence_beyond_half_a_second_is_bridged_by_both_ends_too(name: str) -> None:
    """Nor is a tilt told as known that is not."""
    log, truth = swinging(SLOW_HZ)
    keep = ((log.imu_time_us * 1e-6) % LONG_EVERY_S >= LONG_S) | (log.imu_time_us < 2e6 * STANDS_S)
    log = without(log, keep)
    tilt_deg, valid = tilt_errors_deg(name, log, truth[keep])
    after = log.imu_time_us > 2e6 * STANDS_S
    assert np.sqrt(np.mean(tilt_deg[after] ** 2)) < 3.0
    assert tilt_deg[after & valid].max() < 10.0


def test_gps_brings_back_what_a_silence_left_unsure() -> None:
    """It is not given up: to find an attitude anew takes far longer."""
    log, truth = swinging()
    log = with_gps(log)
    seconds = log.imu_time_us * 1e-6
    keep = (seconds % GPS_EVERY_S >= GPS_LOST_S) | (seconds < 4.0 * STANDS_S)
    log = without(log, keep)
    tilt_deg, valid = tilt_errors_deg("eskf", log, truth[keep])
    after = log.imu_time_us > 2e6 * STANDS_S
    assert np.sqrt(np.mean(tilt_deg[after] ** 2)) < 3.0
    assert tilt_deg[after & valid].max() < 6.0


def test_after_a_silence_no_single_sample_is_taken_for_gravity() -> None:
    log, truth = swinging(GENTLE_HZ)
    log.imu[:, ACCEL : ACCEL + 3] += np.random.default_rng(5).normal(0.0, 1.0, (len(log.imu), 3))
    seconds = log.imu_time_us * 1e-6
    keep = (seconds % LONG_EVERY_S >= LONG_S) | (seconds < 4.0 * STANDS_S)
    tilt_deg, _ = tilt_errors_deg("complementary", without(log, keep), truth[keep])
    assert tilt_deg[seconds[keep] > 2.0 * STANDS_S].max() < 2.0
