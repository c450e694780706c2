"""What the filter tells: its output row, standard deviations and flags."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import (
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
)
from gateway.estimation.eskf.covariance import NO_HEADING_VAR
from gateway.estimation.eskf.eskf_state import POS, TILT, VEL, EskfState
from gateway.estimation.eskf.iron import board_var, standing_field_var
from gateway.estimation.eskf.level_doubt import standing_level_var
from gateway.estimation.filtering.filter_state import sensor_flags
from gateway.estimation.filtering.hidden_pull import hidden_level_var
from gateway.estimation.flagbits import (
    ALTITUDE_VALID,
    ATTITUDE_VALID,
    FRESH_GPS_S,
    HEADING_VALID,
    HEADING_VALID_RAD,
    gps_flags,
)
from gateway.estimation.kernel_record import (
    FloatArray,
    as_quat,
    as_vec,
    fill,
    write_quat,
    write_vec,
)
from gateway.estimation.local_position import NEVER_S
from gateway.estimation.reference import NO_DECLINATION_RAD
from gateway.geometry.geodesy import offset_deg
from gateway.records import NAN
from gateway.units import STANDARD_GRAVITY_MPS2

LEVEL_VAR: Final = 0.1**2
NO_HOLD_S: Final = 1.0
WENT_WRONG_S: Final = 4.0
"""A velocity that fixes contradict may have gone wrong evenly over about this time."""


@compiled
def write_std(row: FloatArray, column: int, s: EskfState, first: int) -> None:
    """Write three standard deviations."""
    for k in range(3):
        row[column + k] = math.sqrt(max(s.P[first + k, first + k], 0.0))


@compiled
def write_output(s: EskfState, row: FloatArray) -> None:
    """Write the output row.

    Parameters
    ----------
    s : EskfState
        Unchanged.
    row : ndarray, shape (NAV_COLUMNS,)
        Filled.
    """
    write_quat(row[NAV_QUAT : NAV_QUAT + 4], as_quat(s.q_nb))
    write_vec(row[NAV_RATE : NAV_RATE + 3], as_vec(s.rate_b))
    row[NAV_FLAGS] = float(flags_of(s))
    fill(row[NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3], NAN)
    if s.started == 1:
        write_std(row, NAV_ATTITUDE_STD, s, TILT)
        for k in range(2):
            told = row[NAV_ATTITUDE_STD + k]
            lasting = standing_level_var(s) + hidden_level_var(s) + s.force_turn_var
            lasting += contradicted_level_var(s)
            row[NAV_ATTITUDE_STD + k] = math.sqrt(told * told + lasting)
        row[NAV_ATTITUDE_STD + 2] = heading_std_rad(s)
    write_place(s, row)


@compiled
def contradicted_level_var(s: EskfState) -> float:
    """Return the variance of the level where fixes contradict the velocity, rad2.

    A level that is off by an angle takes gravity times that for an acceleration. Once the velocity
    is given up, the level rests on gravity.
    """
    if s.aided == 0:
        return 0.0
    return (s.contradiction_mps / (WENT_WRONG_S * STANDARD_GRAVITY_MPS2)) ** 2


@compiled
def heading_std_rad(s: EskfState) -> float:
    """Return how sure the heading is: what iron and the declination add to the covariance, too."""
    variance = s.P[TILT + 2, TILT + 2] if s.heading_known == 1 else NO_HEADING_VAR
    variance += standing_field_var(s) + board_var(s)
    if s.heading_known == 1 and s.heading_true == 0:
        variance += NO_DECLINATION_RAD * NO_DECLINATION_RAD
    return math.sqrt(max(variance, 0.0))


@compiled
def write_place(s: EskfState, row: FloatArray) -> None:
    """Write place and velocity, and how accurate they are; NaN what is not known."""
    fill(row[NAV_VEL : NAV_VEL + 3], NAN)
    fill(row[NAV_VEL_STD : NAV_VEL_STD + 3], NAN)
    fill(row[NAV_POS_STD : NAV_POS_STD + 3], NAN)
    row[NAV_LAT] = row[NAV_LON] = NAN
    row[NAV_ALT] = -s.pos_n[2] if s.has_height == 1 or s.baro_known == 1 else NAN
    if s.has_origin == 0:
        return
    lat, lon = offset_deg(s.origin_lat, s.origin_lon, 0.0, s.pos_n[0], s.pos_n[1])
    row[NAV_LAT], row[NAV_LON] = lat, lon
    if s.aided == 1:
        write_vec(row[NAV_VEL : NAV_VEL + 3], as_vec(s.vel_n))
        write_std(row, NAV_VEL_STD, s, VEL)
        write_std(row, NAV_POS_STD, s, POS)
        off_m = math.hypot(s.contradiction_m, 0.5 * WENT_WRONG_S * s.contradiction_mps)
        for k in range(2):
            row[NAV_POS_STD + k] = math.hypot(row[NAV_POS_STD + k], off_m)
            row[NAV_VEL_STD + k] = math.hypot(row[NAV_VEL_STD + k], s.contradiction_mps)
    elif s.time_s - s.fix_s < FRESH_GPS_S:
        write_vec(row[NAV_VEL : NAV_VEL + 3], as_vec(s.fix_vel))


@compiled
def flags_of(s: EskfState) -> int:
    """Put the flags together."""
    flags = sensor_flags(s)
    if s.started == 1 and max(s.P[TILT, TILT], s.P[TILT + 1, TILT + 1]) < LEVEL_VAR:
        flags |= ATTITUDE_VALID
    known = s.heading_known == 1 and s.heading_true == 1
    if known and heading_std_rad(s) < HEADING_VALID_RAD:
        flags |= HEADING_VALID
    if s.has_height == 1 or s.baro_known == 1:
        flags |= ALTITUDE_VALID
    if s.fix_s == NEVER_S:
        return flags
    # Unaided, the place is that of the last fix and does not move on.
    hold_s = s.hold_s if s.aided == 1 else NO_HOLD_S
    return flags | gps_flags(s.time_s - s.fix_s, s.time_s - s.reject_last[0], hold_s)
