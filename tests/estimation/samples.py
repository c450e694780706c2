"""Small exact motions for the estimators' tests."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from gateway.estimation import columns as col
from gateway.estimation.kernel import SampleLog
from gateway.records import GpsFix, GpsFixType, ImuSample, Vec3
from tests.kit.records import fix_at, sample_at

G = 9.80665
LAT_DEG, LON_DEG, ALT_M = 47.0, 8.0, 500.0
ACCELS, GYROS, MAGS = (slice(at, at + 3) for at in (col.ACCEL, col.GYRO, col.MAG))
GPS_VELS, NAV_VELS = slice(col.GPS_VEL, col.GPS_VEL + 3), slice(col.NAV_VEL, col.NAV_VEL + 3)
"""Columns of vectors."""


def imu(
    time_us: int,
    accel: Vec3 = (0.0, 0.0, -G),
    gyro: Vec3 = (0.0, 0.0, 0.0),
    mag: Vec3 | None = None,
) -> ImuSample:
    return sample_at(
        time_us, accel_b_mps2=accel, gyro_b_radps=gyro, mag_b_ut=mag, temperature_degc=25.0
    )


def fix(
    time_us: int,
    north_m: float = 0.0,
    east_m: float = 0.0,
    vel: Vec3 = (0.0, 0.0, 0.0),
    alt_m: float = ALT_M,
    fix_type: GpsFixType = GpsFixType.FIX_3D,
) -> GpsFix:
    lat_deg = LAT_DEG + math.degrees(north_m / 6_367_800.0)
    lon_deg = LON_DEG + math.degrees(east_m / (6_389_700.0 * math.cos(math.radians(LAT_DEG))))
    return fix_at(
        time_us,
        node_time_us=time_us,
        fix_type=fix_type,
        fix_ok=fix_type >= GpsFixType.FIX_2D,
        lat_dege7=round(lat_deg * 1e7),
        lon_dege7=round(lon_deg * 1e7),
        alt_amsl_m=alt_m,
        vel_n_mps=vel,
        alt_ellipsoid_m=alt_m + 47.0,
        utc_us=1_780_000_000_000_000 + time_us,
    )


def times(seconds: float, rate_hz: int = 100) -> Iterator[int]:
    yield from range(0, round(seconds * 1e6), 1_000_000 // rate_hz)


def selected(
    log: SampleLog, which: Callable[[np.ndarray], np.ndarray]
) -> tuple[SampleLog, np.ndarray]:
    """Copy the samples at the times, us, that `which` chooses; also return which IMU samples."""
    imu, baro, gps = map(which, (log.imu_time_us, log.baro_time_us, log.gps_time_us))
    return SampleLog(
        log.imu_time_us[imu], log.imu[imu], log.baro_time_us[baro], log.baro_alt_m[baro],
        log.gps_time_us[gps], log.gps[gps],
    ), imu  # fmt: skip


def log_of(imu: np.ndarray, rate_hz: int) -> SampleLog:
    """Make a log of IMU rows alone."""
    us = np.round(np.arange(len(imu)) / rate_hz * 1e6).astype(np.int64)
    none = np.empty(0, np.int64)
    return SampleLog(us, imu, none, np.empty(0), none, np.empty((0, col.GPS_COLUMNS)))
