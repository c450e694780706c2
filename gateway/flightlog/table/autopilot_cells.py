"""An autopilot's messages as cells of the table, many at once.

Each function takes the fields of some messages of one kind, as `columns_of` reads them, with their
times on the table's clock, and returns a row of cells for each.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.compiled.entry_point import dispatched
from gateway.flightlog.table.cells import BoolArray, FloatArray
from gateway.flightlog.table.row import LARGEST_WHOLE
from gateway.flightlog.tlog.tlog_scan import IntArray
from gateway.geometry.quaternion import from_euler
from gateway.records import NAN, GpsFixType, ImuFlags, NavFlags
from gateway.units import DEG_PER_DEGE7, PA_PER_HPA, STANDARD_GRAVITY_MPS2, US_PER_S

UT_PER_GAUSS: Final = 100.0
MILLI: Final = 1e-3
CENTI: Final = 1e-2
DEG_PER_HDG_ACC: Final = 1e-5
UNKNOWN_U16: Final = 65535
UNKNOWN_U8: Final = 255
MAG_FIELDS: Final = 0b111 << 6
"""HIGHRES_IMU's bits of what is new."""
UNIX_YEAR_2000_US: Final = 946_684_800 * US_PER_S
"""Later times are civil time, earlier ones count from the start of the autopilot."""
FIX_2D, FIX_3D = 2, 3
GPS_NODE: Final = 1

Fields = NDArray[np.void]

_ATTITUDE_FLAGS: Final = int(NavFlags.ATTITUDE_VALID | NavFlags.HEADING_VALID)
_PLACE_FLAGS: Final = int(
    NavFlags.POSITION_VALID | NavFlags.VELOCITY_VALID | NavFlags.ALTITUDE_VALID
)


def imu_cells(message_id: int, values: Fields, time_us: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the cells of `HEAD_COLUMNS` and of `SI_COLUMNS` of any of the three IMU messages."""
    if message_id == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU:
        accel, gyro, mag = _vectors(values, 1.0, 1.0, UT_PER_GAUSS)
        temperature_degc = values["temperature"].astype(np.float64)
        may_be_new = (values["fields_updated"] & MAG_FIELDS) != 0
    else:
        g, mgauss = STANDARD_GRAVITY_MPS2 * MILLI, UT_PER_GAUSS * MILLI
        accel, gyro, mag = _vectors(values, g, MILLI, mgauss)
        temperature_degc = _unless_zero(values["temperature"], CENTI)
        may_be_new = np.ones(len(values), bool)
    is_new = may_be_new & (mag != 0.0).any(axis=1)
    mag[~is_new] = np.nan
    flags = np.where(is_new, float(ImuFlags.MAG_NEW), 0.0)
    nothing = np.full(len(values), np.nan)
    head = np.column_stack([time_us, np.zeros(len(values)), nothing, flags])
    return head, np.column_stack([accel, gyro, mag, temperature_degc])


def baro_cells(values: Fields, time_us: IntArray) -> FloatArray:
    """Return the cells of `BARO_COLUMNS` of SCALED_PRESSURE."""
    pressure_pa = values["press_abs"].astype(np.float64) * PA_PER_HPA
    temperature_degc = values["temperature"] * CENTI
    node = np.zeros(len(values))
    return np.column_stack([time_us, node, time_us, pressure_pa, temperature_degc])


def gps_cells(values: Fields, time_us: IntArray, places: Fields, place_at: IntArray) -> FloatArray:
    """Return the cells of `GPS_COLUMNS` of GPS_RAW_INT.

    Parameters
    ----------
    values, time_us :
        As for the others.
    places : ndarray
        Fields of GLOBAL_POSITION_INT.
    place_at : ndarray of int, shape (n,)
        Which of them was known at each fix; -1 for none.
    """
    told = np.minimum(values["fix_type"], FIX_3D)
    fix_type = np.select(
        [told == FIX_2D, told == FIX_3D],
        [int(GpsFixType.FIX_2D), int(GpsFixType.FIX_3D)],
        int(GpsFixType.NONE),
    )
    has_fix = fix_type != int(GpsFixType.NONE)
    satellites = values["satellites_visible"]
    utc_us = values["time_usec"]
    is_civil = (utc_us > UNIX_YEAR_2000_US) & (utc_us <= LARGEST_WHOLE)
    down_mps = _of_place(places, np.where(told == FIX_3D, place_at, -1), "vz", CENTI)
    north_mps, east_mps = _velocity(values, has_fix)
    return np.column_stack(
        [
            time_us,
            np.full(len(values), GPS_NODE),
            time_us,
            np.zeros(len(values)),
            fix_type,
            has_fix,
            np.where(satellites == UNKNOWN_U8, 0, satellites),
            values["lat"],
            values["lon"],
            values["alt"] * MILLI,
            *(north_mps, east_mps, down_mps),
            _unless_zero(values["alt_ellipsoid"], MILLI),
            _unless_zero(values["h_acc"], MILLI),
            _unless_zero(values["v_acc"], MILLI),
            _unless_zero(values["vel_acc"], MILLI),
            _unless_zero(values["hdg_acc"], DEG_PER_HDG_ACC),
            _known(values["eph"], CENTI),
            np.where(is_civil, utc_us.astype(np.float64), np.nan),
        ]
    )


def nav_cells(values: Fields, time_us: IntArray, places: Fields, place_at: IntArray) -> FloatArray:
    """Return the cells of `NAV_COLUMNS` of ATTITUDE; the places are as for `gps_cells`."""
    angles = [values[name].astype(np.float64) for name in ("roll", "pitch", "yaw")]
    rates = [values[name] for name in ("rollspeed", "pitchspeed", "yawspeed")]
    flags = np.where(place_at >= 0, _ATTITUDE_FLAGS | _PLACE_FLAGS, _ATTITUDE_FLAGS)
    return np.column_stack(
        [
            time_us,
            _quaternions(np.column_stack(angles)),
            *rates,
            _of_place(places, place_at, "lat", DEG_PER_DEGE7),
            _of_place(places, place_at, "lon", DEG_PER_DEGE7),
            _of_place(places, place_at, "alt", MILLI),
            *(_of_place(places, place_at, name, CENTI) for name in ("vx", "vy", "vz")),
            np.full((len(values), 9), np.nan),
            flags,
        ]
    )


def _vectors(values: Fields, *scales: float) -> list[FloatArray]:
    """Return acceleration, rate and field, each by its scale."""
    return [
        np.column_stack([values[axis + name].astype(np.float64) for axis in "xyz"]) * scale
        for name, scale in zip(("acc", "gyro", "mag"), scales, strict=True)
    ]


def _velocity(values: Fields, has_fix: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Make the level part of the velocity of speed and course; NaN without a fix."""
    speed_mps = np.where(has_fix, _known(values["vel"], CENTI), np.nan)
    # Not numpy's sine: its last digit is another one on some processors.
    course_rad = [*map(math.radians, _known(values["cog"], CENTI).tolist())]
    north = np.array([*map(math.cos, course_rad)])
    east = np.array([*map(math.sin, course_rad)])
    return speed_mps * north, speed_mps * east


def _known(values: NDArray[np.uint16], scale: float) -> FloatArray:
    return np.where(values == UNKNOWN_U16, NAN, values * scale)


def _unless_zero(values: NDArray[np.int32], scale: float) -> FloatArray:
    return np.where(values == 0, NAN, values * scale)


def _of_place(places: Fields, place_at: IntArray, name: str, scale: float) -> FloatArray:
    """Return a field of the place that was known at each time; NaN where none was."""
    found = np.full(len(place_at), np.nan)
    known = place_at >= 0
    found[known] = places[name][place_at[known]] * scale
    return found


@dispatched
def _quaternions(angles: FloatArray) -> FloatArray:
    """Apply `from_euler` to roll, pitch and yaw of shape (n, 3)."""
    found = np.empty((len(angles), 4))
    for i in range(len(angles)):
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = from_euler(
            angles[i, 0], angles[i, 1], angles[i, 2]
        )
    return found
