"""Motion in an outage that gravity does not show the level of."""

import math

import numpy as np
import pytest

from gateway.estimation.columns import (
    ACCEL,
    GPS_ALT,
    GPS_COLUMNS,
    GPS_DECLINATION,
    GPS_LAT,
    GPS_USABLE,
    GPS_VEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
)
from gateway.estimation.kernel import SampleLog
from gateway.geometry.geodesy import radii_m
from tests.estimation.samples import ALT_M, LAT_DEG, LON_DEG, G
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
    gps = np.full((len(at), GPS_COLUMNS), math.nan)
    gps[:, GPS_USABLE], gps[:, GPS_DECLINATION] = 1.0, 0.0
    gps[:, GPS_LAT : GPS_LAT + 2] = (LAT_DEG, LON_DEG)
    gps[:, GPS_LAT : GPS_LAT + 2] += np.degrees(pos_n[at, :2] / radii_m(LAT_DEG, ALT_M))
    gps[:, GPS_ALT] = ALT_M - pos_n[at, 2]
    gps[:, GPS_VEL : GPS_VEL + 3] = vel_n[at] + rng.normal(0.0, 0.1, (len(at), 3))
    us = np.round(np.arange(n) / RATE_HZ * 1e6).astype(np.int64)
    return SampleLog(us, imu, np.empty(0, np.int64), np.empty(0), us[at], gps)


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
