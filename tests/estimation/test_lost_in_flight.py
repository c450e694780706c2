"""An attitude that was lost in flight is told as unknown until it is found again."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import ACCEL, GYRO, MAG, NAV_FLAGS
from gateway.estimation.kernel import SampleLog
from gateway.records import NavFlags
from tests.estimation.test_flown_unaided import ESTIMATORS, samples
from tests.estimation.test_without_compass import RATE_HZ, estimator_of

STARTS_S, SILENT_S, HEARD_S, ENDS_S = 20.0, 40.0, 41.03, 60.0
FOUND_S = 5.0
ROLL_BEGINS_S, ROLL_RADPS = 39.5, 0.8
SEEDS = range(3)


def rolled_in_silence(seed: int) -> tuple[SampleLog, np.ndarray]:
    """Fly to and fro, begin to roll, and be silent meanwhile; also tell the true roll, rad."""
    time_s = np.arange(round(ENDS_S * RATE_HZ)) / RATE_HZ
    accel_n = np.zeros((len(time_s), 3))
    accel_n[:, 0] = 2.5 * np.sin(2.0 * math.pi * 0.3 * time_s) * (time_s > STARTS_S)
    log = samples(seed, accel_n, ENDS_S)
    roll = ROLL_RADPS * (np.clip(time_s, ROLL_BEGINS_S, HEARD_S) - ROLL_BEGINS_S)
    turn = Rotation.from_euler("X", roll[:, np.newaxis]).inv()
    for first in (ACCEL, MAG):
        log.imu[:, first : first + 3] = turn.apply(log.imu[:, first : first + 3])
    log.imu[:, GYRO] += np.gradient(roll, time_s)
    heard = (time_s < SILENT_S) | (time_s > HEARD_S)
    told = (log.gps_time_us < SILENT_S * 1e6) | (log.gps_time_us > HEARD_S * 1e6)
    return SampleLog(
        log.imu_time_us[heard],
        log.imu[heard],
        log.baro_time_us,
        log.baro_alt_m,
        log.gps_time_us[told],
        log.gps[told],
    ), roll[heard]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_no_level_is_told_before_one_is_found(name: str, seed: int) -> None:
    log, roll = rolled_in_silence(seed)
    out = estimator_of(name).run(log)
    found = Rotation.from_quat(out[:, :4], scalar_first=True).inv().apply((0.0, 0.0, 1.0))
    true = np.column_stack([0.0 * roll, np.sin(roll), np.cos(roll)])
    off = np.degrees(np.arccos(np.clip((found * true).sum(axis=1), -1.0, 1.0)))
    valid = (out[:, NAV_FLAGS].astype(int) & NavFlags.ATTITUDE_VALID) != 0
    after = log.imu_time_us > HEARD_S * 1e6
    assert off[after & valid].max() < 15.0
    assert valid[log.imu_time_us > (HEARD_S + FOUND_S) * 1e6].all()
