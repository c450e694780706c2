"""The first fixes of a receiver: no way leads to them, and their height may be nonsense."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import GPS_ALT, GPS_VEL, NAV_ALT
from gateway.estimation.kernel import SampleLog
from tests.estimation.samples import ALT_M
from tests.estimation.test_steady_motion import LOST_S, drive
from tests.estimation.test_without_compass import STANDS_S, estimator_of, flight

SEEDS = range(3)
MOST_RAD = math.radians(3.0)


def without_velocity(seed: int, first_s: float) -> SampleLog:
    """Let the fixes begin at `first_s` and tell no velocity."""
    log, _ = flight(seed, "good")
    told = log.gps_time_us >= first_s * 1e6
    gps = log.gps[told]
    gps[:, GPS_VEL : GPS_VEL + 3] = math.nan
    return replace(log, gps=gps, gps_time_us=log.gps_time_us[told])


def tilt_rad(name: str, log: SampleLog) -> np.ndarray:
    """Tell the tilt while it stands."""
    out = estimator_of(name).run(log)
    stands = (log.imu_time_us > 3e6) & (log.imu_time_us < STANDS_S * 1e6)
    up = Rotation.from_quat(out[stands, :4], scalar_first=True).apply([0.0, 0.0, 1.0])[:, 2]
    return np.arccos(np.clip(up, -1.0, 1.0))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("first_s", [0.3, 1.2, 2.0, 5.0])
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_the_first_fix_was_not_reached_from_anywhere(name: str, first_s: float, seed: int) -> None:
    assert tilt_rad(name, without_velocity(seed, first_s)).max() < MOST_RAD


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("off_m", [-500.0, 60.0])
def test_first_heights_that_are_wrong_are_given_up(off_m: float, seed: int) -> None:
    log, _ = drive(seed, stops=False)
    gps, at = log.gps.copy(), np.arange(0, len(log.imu_time_us), 4)
    gps[:5, GPS_ALT] += off_m
    told = ALT_M + np.random.default_rng(seed).normal(0.0, 0.25, len(at))
    baro_us = log.imu_time_us[at]
    spoilt = replace(log, gps=gps, baro_time_us=baro_us, baro_alt_m=told)
    out = estimator_of("eskf").run(spoilt)
    late = (log.imu_time_us > 20e6) & (log.imu_time_us < LOST_S * 1e6)
    assert np.abs(out[late, NAV_ALT] - ALT_M).max() < 3.0
