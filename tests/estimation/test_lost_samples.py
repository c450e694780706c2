"""Samples of the IMU that a radio loses: what turned meanwhile is told by both ends."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import ACCEL, CLIPPED, GPS_COLUMNS, GYRO, IMU_COLUMNS, MAG
from gateway.estimation.kernel import SampleLog
from tests.estimation.samples import G
from tests.estimation.test_without_compass import estimator_of

RATE_HZ = 100
SECONDS, STANDS_S = 60.0, 5.0
SWING_HZ, SWING_RAD = 0.4, 1.2
LOST_S, EVERY_S = 0.1, 0.7


def swinging() -> tuple[SampleLog, Rotation]:
    """Swing about the forward axis to and fro, after a rest; each sample tells its own instant."""
    t = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    phase = 2.0 * math.pi * SWING_HZ * np.clip(t - STANDS_S, 0.0, None)
    roll = SWING_RAD * (1.0 - np.cos(phase)) / 2.0
    truth = Rotation.from_rotvec(np.outer(roll, [1.0, 0.0, 0.0]))
    imu = np.full((len(t), IMU_COLUMNS), math.nan)
    imu[:, ACCEL : ACCEL + 3] = truth.inv().apply([0.0, 0.0, -G])
    imu[:, GYRO : GYRO + 3] = 0.0
    imu[:, GYRO] = math.pi * SWING_HZ * SWING_RAD * np.sin(phase)
    imu[:, : GYRO + 3] += np.random.default_rng(3).normal(0.0, 1e-3, (len(t), 6))
    imu[:, MAG : MAG + 3] = truth.inv().apply([21.0, 0.0, 43.0])
    imu[:, CLIPPED] = 0.0
    no_us = np.empty(0, np.int64)
    log = SampleLog(
        np.round(t * 1e6).astype(np.int64), imu, no_us, np.empty(0), no_us,
        np.empty((0, GPS_COLUMNS)),
    )  # fmt: skip
    return log, truth


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_what_turned_while_samples_were_lost_is_told_by_both_ends(name: str) -> None:
    log, truth = swinging()
    keep = (log.imu_time_us * 1e-6) % EVERY_S >= LOST_S
    log = SampleLog(
        log.imu_time_us[keep], log.imu[keep], log.baro_time_us, log.baro_alt_m, log.gps_time_us,
        log.gps,
    )  # fmt: skip
    out = estimator_of(name).run(log)
    off = Rotation.from_quat(out[:, :4], scalar_first=True) * truth[keep].inv()
    w, z = off.as_quat(scalar_first=True)[:, [0, 3]].T
    tilt = np.degrees(2.0 * np.arccos(np.hypot(w, z).clip(max=1.0)))
    assert np.sqrt(np.mean(tilt[log.imu_time_us > 2e6 * STANDS_S] ** 2)) < 0.5
