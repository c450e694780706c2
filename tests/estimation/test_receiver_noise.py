"""A receiver that is noisier than its word, beside a compass: how noisy shows in flight."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    GPS_H_ACC,
    GPS_SPEED_ACC,
    GPS_V_ACC,
    GPS_VEL,
    MAG,
    NAV_VEL,
    NAV_VEL_STD,
)
from tests.estimation.test_without_compass import (
    FIXES_HZ,
    RATE_HZ,
    STANDS_S,
    correlated,
    estimator_of,
    flight,
)

FIELD_N_UT = (18.0, 0.0, 45.0)
SETTLED_S = STANDS_S + 15.0
SEEDS = range(6)
NAMES = ("complementary", "eskf")


@cache
def errors(name: str, seed: int, noisy: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tell error and standard deviation of the level velocity at the fixes, m/s, and the tilt, rad.

    Whatever its noise, the receiver tells 0.12 m/s.
    """
    log, heading = flight(seed, "good")
    rng = np.random.default_rng(1000 + seed)
    imu, gps = log.imu.copy(), log.gps.copy()
    turned = Rotation.from_rotvec(np.outer(-heading, [0.0, 0.0, 1.0]))
    imu[:, MAG : MAG + 3] = turned.apply(FIELD_N_UT) + rng.normal(0.0, 0.5, (len(imu), 3))
    imu[np.arange(len(imu)) % 4 != 0, MAG : MAG + 3] = math.nan
    gps[:, GPS_H_ACC], gps[:, GPS_V_ACC], gps[:, GPS_SPEED_ACC] = 1.2, 1.8, 0.12
    if noisy:
        gps[:, GPS_VEL : GPS_VEL + 3] += correlated(rng, len(gps), FIXES_HZ, 0.5, 0.7)
    out = estimator_of(name).run(replace(log, imu=imu, gps=gps))
    at = np.searchsorted(log.imu_time_us, log.gps_time_us[log.gps_time_us > SETTLED_S * 1e6])
    # The receiver was a good one before the noise was added.
    true = log.gps[-len(at) :, GPS_VEL : GPS_VEL + 2]
    found, told = out[at, NAV_VEL : NAV_VEL + 2], out[at, NAV_VEL_STD : NAV_VEL_STD + 2]
    tilt = 2.0 * np.arccos(np.hypot(out[:, 0], out[:, 3]).clip(max=1.0))
    return found - true, told, tilt[round(SETTLED_S * RATE_HZ) :]


def share_within_two_sigma(name: str, noisy: bool) -> float:
    runs = [errors(name, seed, noisy) for seed in SEEDS]
    return float(np.mean([np.abs(off) < 2.0 * told for off, told, _ in runs]))


@pytest.mark.parametrize("name", NAMES)
def test_the_velocity_is_as_good_as_it_is_told(name: str) -> None:
    assert share_within_two_sigma(name, noisy=True) > 0.8


def test_eskf_filters_more_noise_out_and_stays_level() -> None:
    runs = [errors("eskf", seed, noisy=True) for seed in SEEDS]
    speeds = [off for off, _, _ in runs]
    assert math.sqrt(np.mean(np.square(speeds))) < 0.4
    assert math.degrees(math.sqrt(np.mean([tilt**2 for *_, tilt in runs]))) < 1.0


@pytest.mark.parametrize("name", NAMES)
def test_a_good_receiver_is_believed(name: str) -> None:
    """By its word, not by what is expected of any."""
    runs = [errors(name, seed, noisy=False) for seed in SEEDS]
    assert max(float(np.median(told)) for _, told, _ in runs) < 0.2
    assert math.sqrt(np.mean([np.square(off) for off, _, _ in runs])) < 0.15
