"""Output row of the filter: state, standard deviations and flags."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import (
    ALTITUDE_VALID,
    AT_REST,
    ATTITUDE_VALID,
    BARO_STALE_S,
    DEGRADED,
    FRESH_GPS_S,
    HEADING_VALID,
    HEADING_VALID_RAD,
    MAG_DISTURBED,
    MAG_MISPLACED,
    NAV_ALT,
    NAV_ATTITUDE_STD,
    NAV_FLAGS,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
    NAV_QUAT,
    NAV_RATE,
    NAV_VEL,
    NAV_VEL_STD,
    SENSOR_FAULT,
    USING_BARO,
    USING_MAG,
    gps_flags,
)
from gateway.estimation.eskf.magnetometer import STALE_MAG_S
from gateway.estimation.eskf.predict import NO_HEADING_VAR
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import ATT, NEVER_S, POS, VEL, State
from gateway.estimation.record import FloatArray, as_quat, as_vec, fill, write_quat, write_vec
from gateway.estimation.reference import NO_DECLINATION_RAD
from gateway.geometry.geodesy import offset_deg
from gateway.records import NAN
from gateway.units import RAD_PER_DEG

LEVEL_VALID_RAD: Final = 0.1
"""A level is valid up to this standard deviation."""
MOUNTING_RAD: Final = 1.0 * RAD_PER_DEG
"""Error of the declination, and of the compass axes on their board."""
NO_HOLD_S: Final = 1.0
"""A position that is not estimated is valid for this time after its fix."""


@compiled
def write_output(s: State, p: Gains, row: FloatArray) -> None:
    """Write the output row, see `columns`."""
    write_quat(row[NAV_QUAT : NAV_QUAT + 4], as_quat(s.q_nb))
    write_vec(row[NAV_RATE : NAV_RATE + 3], as_vec(s.rate_b))
    row[NAV_FLAGS] = float(flags_of(s, p))
    fill(row[NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3], NAN)
    if s.started == 1:
        write_std(row, NAV_ATTITUDE_STD, s, ATT)
        row[NAV_ATTITUDE_STD + 2] = heading_std_rad(s)
    write_position(s, row)


@compiled
def write_std(row: FloatArray, column: int, s: State, first: int) -> None:
    """Write three standard deviations."""
    for k in range(3):
        row[column + k] = math.sqrt(max(s.P[first + k, first + k], 0.0))


@compiled
def heading_std_rad(s: State) -> float:
    """Return the standard deviation of the heading with its systematic errors."""
    if s.heading_known == 0:
        return math.sqrt(NO_HEADING_VAR)
    variance = max(s.P[ATT + 2, ATT + 2], 0.0) + MOUNTING_RAD * MOUNTING_RAD
    if s.heading_true == 0:
        variance += NO_DECLINATION_RAD * NO_DECLINATION_RAD
    return math.sqrt(variance)


@compiled
def write_position(s: State, row: FloatArray) -> None:
    """Write position, velocity and their standard deviations; NaN for the unknown."""
    fill(row[NAV_VEL : NAV_VEL + 3], NAN)
    fill(row[NAV_VEL_STD : NAV_VEL_STD + 3], NAN)
    fill(row[NAV_POS_STD : NAV_POS_STD + 3], NAN)
    row[NAV_LAT] = row[NAV_LON] = NAN
    row[NAV_ALT] = -s.pos_n[2] if s.has_height == 1 or s.baro_s != NEVER_S else NAN
    if s.has_origin == 0:
        return
    lat, lon = offset_deg(s.origin[0], s.origin[1], 0.0, s.pos_n[0], s.pos_n[1])
    row[NAV_LAT], row[NAV_LON] = lat, lon
    if s.aided == 1:
        write_vec(row[NAV_VEL : NAV_VEL + 3], as_vec(s.vel_n))
        write_std(row, NAV_VEL_STD, s, VEL)
        write_std(row, NAV_POS_STD, s, POS)
    elif s.time_s - s.fix_s < FRESH_GPS_S:
        write_vec(row[NAV_VEL : NAV_VEL + 3], as_vec(s.fix_vel))


@compiled
def flags_of(s: State, p: Gains) -> int:
    """Return the flags, see `NavFlags`."""
    flags = AT_REST if s.at_rest == 1 else 0
    if s.time_s - s.mag_s < STALE_MAG_S:
        flags |= MAG_DISTURBED if s.mag_disturbed == 1 else USING_MAG
    if s.mag_misplaced == 1:
        flags |= MAG_DISTURBED | MAG_MISPLACED | DEGRADED
    if s.time_s - s.baro_s < BARO_STALE_S:
        flags |= USING_BARO
    if s.fault == 1:
        flags |= SENSOR_FAULT | DEGRADED
    if s.started == 1 and max(s.P[ATT, ATT], s.P[ATT + 1, ATT + 1]) < LEVEL_VALID_RAD**2:
        flags |= ATTITUDE_VALID
    if s.heading_known == 1 and s.heading_true == 1 and heading_std_rad(s) < HEADING_VALID_RAD:
        flags |= HEADING_VALID
    if s.has_height == 1 or s.baro_s != NEVER_S:
        flags |= ALTITUDE_VALID
    if s.fix_s == NEVER_S:
        return flags
    hold_s = p.dead_reckoning_s if s.aided == 1 else NO_HOLD_S
    return flags | gps_flags(s.time_s - s.fix_s, s.time_s - s.reject_last[0], hold_s)
