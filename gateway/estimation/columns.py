"""The columns of the inputs and outputs of the kernels.

A live sample is one row, a log many such rows, so both give exactly the same results.
"""

import math
from collections import namedtuple
from functools import cache
from typing import Any, Final, cast

import numpy as np

from gateway.compiled import compiled
from gateway.estimation.record import FloatArray, IntArray
from gateway.estimation.reference import EarthField, ReferenceSettings, is_usable
from gateway.records import NAN, UNKNOWN_VEC3, GpsFix, ImuFlags, ImuSample, NavFlags, NavState, Vec3
from gateway.units import DEG_PER_DEGE7

ImuRow = tuple[float, ...]
GpsRow = tuple[float, ...]

ACCEL: Final = 0
"""Specific force in body FRD, m/s2: three columns."""
GYRO: Final = 3
"""Angular rate in body FRD, rad/s: three columns."""
MAG: Final = 6
"""Magnetic field in body FRD, uT: three columns, NaN unless new."""
CLIPPED: Final = 9
"""1 where a sensor reached the end of its range, else 0."""
MAG_UNCALIBRATED: Final = 10
GYRO_UNCALIBRATED: Final = 11
ACCEL_UNCALIBRATED: Final = 12
"""1 where the sensor of each column was never calibrated, else 0."""
ACCEL_FILTERED: Final = 13
GYRO_FILTERED: Final = 14
"""1 where the node has filtered the sensor of each column, else 0."""
MEANS: Final = 15
"""1 where rate and force are means since the previous sample, else 0."""
IMU_COLUMNS: Final = 16

GPS_USABLE: Final = 0
"""1 for a fix that may be fused, else 0."""
GPS_LAT: Final = 1
GPS_LON: Final = 2
GPS_ALT: Final = 3
GPS_VEL: Final = 4
"""Velocity NED, m/s: three columns, NaN if the receiver does not report it."""
GPS_H_ACC: Final = 7
GPS_V_ACC: Final = 8
GPS_SPEED_ACC: Final = 9
"""Standard deviations reported by the receiver; NaN if it does not report them."""
GPS_DECLINATION: Final = 10
"""Declination in rad; NaN if unknown."""
GPS_DIP: Final = 11
"""Dip of the Earth's field at the position, positive down, rad; NaN if unknown."""
GPS_STRENGTH: Final = 12
"""Norm of the Earth's field, uT; NaN if unknown."""
GPS_COLUMNS: Final = 13

NAV_QUAT: Final = 0
NAV_RATE: Final = 4
NAV_LAT: Final = 7
NAV_LON: Final = 8
NAV_ALT: Final = 9
NAV_VEL: Final = 10
NAV_ATTITUDE_STD: Final = 13
NAV_VEL_STD: Final = 16
NAV_POS_STD: Final = 19
NAV_FLAGS: Final = 22
NAV_COLUMNS: Final = 23

ROW_FLAGS: Final = (
    int(ImuFlags.ACCEL_CLIPPED | ImuFlags.GYRO_CLIPPED),
    int(ImuFlags.MAG_UNCALIBRATED),
    int(ImuFlags.GYRO_UNCALIBRATED),
    int(ImuFlags.ACCEL_UNCALIBRATED),
    int(ImuFlags.ACCEL_FILTERED),
    int(ImuFlags.GYRO_FILTERED),
    int(ImuFlags.MEANS),
)
"""Names of the columns."""

_flags_of = cache(NavFlags)
"""Flags are the same for many samples; a lookup costs a tenth of creating them."""
FLAG: Final = cast(Any, namedtuple("Flag", NavFlags.__members__))(*map(int, NavFlags))
"""The bits of `NavFlags` by their names, as numbers for compiled code."""
HEADING_VALID_RAD: Final = 0.26
"""Maximum standard deviation of a valid heading."""
BARO_STALE_S: Final = 2.0
"""A barometer without readings for longer is not in use."""
FRESH_GPS_S: Final = 1.5
"""Without an accepted fix for longer than this, the estimate is dead reckoning."""


def imu_row(sample: ImuSample) -> ImuRow:
    """Return the row of an IMU sample, unfiltered, since these estimators average by themselves."""
    mag = sample.mag_b_ut or UNKNOWN_VEC3
    return (*sample.accel_b_mps2, *sample.gyro_b_radps, *mag, *_flag_columns(int(sample.flags)))


@cache
def _flag_columns(flags: int) -> tuple[float, ...]:
    """Return the columns of the flags, which are the same for many samples."""
    return tuple(1.0 if flags & bits else 0.0 for bits in ROW_FLAGS)


def imu_rows(
    accel_b_mps2: FloatArray, gyro_b_radps: FloatArray, mag_b_ut: FloatArray, flags: IntArray
) -> FloatArray:
    """Return the rows of n IMU samples like `imu_row`: vectors (n, 3), and `ImuFlags` (n,)."""
    shown = [(flags & bits) != 0 for bits in ROW_FLAGS]
    return np.column_stack([accel_b_mps2, gyro_b_radps, mag_b_ut, *shown]).astype(np.float64)


@compiled
def imu_vectors(row: FloatArray) -> tuple[Vec3, Vec3, Vec3]:
    """Read angular rate, specific force and field of an IMU sample's row."""
    return (
        (row[GYRO], row[GYRO + 1], row[GYRO + 2]),
        (row[ACCEL], row[ACCEL + 1], row[ACCEL + 2]),
        (row[MAG], row[MAG + 1], row[MAG + 2]),
    )


def gps_row(fix: GpsFix, settings: ReferenceSettings, earth: EarthField) -> GpsRow:
    """Return the row of a fix, with the Earth's magnetic field, which a usable fix updates."""
    lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
    usable = is_usable(fix, settings)
    if usable:
        alt_m = fix.alt_amsl_m if math.isfinite(fix.alt_amsl_m) else 0.0
        earth.update(lat_deg, lon_deg, alt_m, fix.utc_us)
    vel = fix.vel_n_mps
    if not all(map(math.isfinite, vel)):
        vel = (NAN, NAN, NAN)
    return (
        1.0 if usable else 0.0,
        lat_deg,
        lon_deg,
        fix.alt_amsl_m,
        *vel,
        fix.h_acc_m,
        fix.v_acc_m,
        fix.speed_acc_mps,
        earth.declination_rad,
        *((NAN, NAN) if earth.field is None else earth.field[1:]),
    )


def nav_state(time_us: int, row: FloatArray) -> NavState:
    """Read a navigation state from a kernel's output row, shape (NAV_COLUMNS,)."""
    v = row.tolist()
    return NavState(
        time_us=time_us,
        q_nb=(v[0], v[1], v[2], v[3]),
        rate_b_radps=(v[4], v[5], v[6]),
        lat_deg=v[NAV_LAT],
        lon_deg=v[NAV_LON],
        alt_amsl_m=v[NAV_ALT],
        vel_n_mps=(v[10], v[11], v[12]),
        attitude_std_rad=(v[13], v[14], v[15]),
        vel_std_mps=(v[16], v[17], v[18]),
        pos_std_m=(v[19], v[20], v[21]),
        flags=_flags_of(int(v[NAV_FLAGS])),
    )


def nav_row(state: NavState) -> list[float]:
    """Write a navigation state as a row of `NAV_COLUMNS`: the reverse of `nav_state`."""
    s = state
    return [
        *s.q_nb, *s.rate_b_radps, s.lat_deg, s.lon_deg, s.alt_amsl_m, *s.vel_n_mps,
        *s.attitude_std_rad, *s.vel_std_mps, *s.pos_std_m, float(s.flags),
    ]  # fmt: skip


@compiled
def gps_flags(since_fix_s: float, since_reject_s: float, hold_s: float) -> int:
    """Return the bits of `NavFlags` from the ages of the last accepted and the last rejected fix.

    A position is valid for `hold_s` after the last fix.
    """
    flags: int = FLAG.POSITION_VALID | FLAG.VELOCITY_VALID if since_fix_s < hold_s else 0
    flags |= FLAG.USING_GPS if since_fix_s < FRESH_GPS_S else FLAG.DEAD_RECKONING | FLAG.DEGRADED
    if since_reject_s < FRESH_GPS_S:
        flags |= FLAG.GPS_REJECTED | FLAG.DEGRADED
    return flags
