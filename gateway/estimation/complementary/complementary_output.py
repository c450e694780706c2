"""The output of the complementary estimator: its row and flags."""

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
from gateway.estimation.complementary.complementary_state import ComplementaryState
from gateway.estimation.filtering.filter_state import sensor_flags
from gateway.estimation.flagbits import (
    ALTITUDE_VALID,
    ATTITUDE_VALID,
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
from gateway.geometry.geodesy import offset_deg
from gateway.records import NAN

DEAD_RECKONING_MAX_S: Final = 60.0
"""Dead reckoning longer than this is no position any more."""
TILT_VALID_RAD: Final = 0.26
"""A tilt is valid up to this standard deviation."""


@compiled
def write_output(s: ComplementaryState, row: FloatArray) -> None:
    """Write the output row.

    Parameters
    ----------
    s : ComplementaryState
        Unchanged.
    row : ndarray, shape (NAV_COLUMNS,)
        Filled; standard deviations of height and climb are not known to this estimator.
    """
    write_quat(row[NAV_QUAT : NAV_QUAT + 4], as_quat(s.q_nb))
    write_vec(row[NAV_RATE : NAV_RATE + 3], as_vec(s.rate_b))
    fill(row[NAV_ATTITUDE_STD:NAV_FLAGS], NAN)
    if s.started == 1:
        write_vec(row[NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3], as_vec(s.told_std))
    row[NAV_ALT] = -s.pos_n[2] if s.has_height == 1 or s.baro_known == 1 else NAN
    row[NAV_FLAGS] = float(flags_of(s))
    if s.has_origin == 0:
        row[NAV_LAT] = row[NAV_LON] = NAN
        fill(row[NAV_VEL : NAV_VEL + 3], NAN)
        return
    lat, lon = offset_deg(s.origin_lat, s.origin_lon, 0.0, s.pos_n[0], s.pos_n[1])
    row[NAV_LAT], row[NAV_LON] = lat, lon
    write_vec(row[NAV_VEL : NAV_VEL + 3], as_vec(s.vel_n))
    for k in range(2):
        row[NAV_VEL_STD + k], row[NAV_POS_STD + k] = s.told_speed_mps[k], s.told_place_m[k]


@compiled
def flags_of(s: ComplementaryState) -> int:
    """Put the flags together."""
    flags = sensor_flags(s)
    north, east, heading = as_vec(s.told_std)
    if s.started == 1 and s.lost == 0 and max(north, east) < TILT_VALID_RAD:
        flags |= ATTITUDE_VALID
    if s.heading_known == 1 and s.heading_true == 1 and heading < HEADING_VALID_RAD:
        flags |= HEADING_VALID
    if s.has_height == 1 or s.baro_known == 1:
        flags |= ALTITUDE_VALID
    if s.fix_s == NEVER_S:
        return flags
    since_reject = s.time_s - s.reject_last[0]
    return flags | gps_flags(s.time_s - s.fix_s, since_reject, DEAD_RECKONING_MAX_S)
