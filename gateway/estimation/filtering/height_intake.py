"""A height of the barometer or of a fix as it arrives: whether it is one."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.filtering.filter_state import FilterState
from gateway.estimation.kernel_record import FloatArray
from gateway.estimation.local_position import BARO_STALE_S

FASTEST_RISE_M: Final = 20.0
FASTEST_CLIMB_MPS: Final = 100.0
"""What a gust of wind on the barometer, and a dive, change at most."""


@compiled
def is_height_told(s: FilterState, alt_m: float) -> bool:
    """Return whether a height may be used; to be asked at each one.

    One that is far from all before it is left out. The next one that agrees with it makes it a new
    height to begin at: `baro_known` is 0 then.

    Parameters
    ----------
    s : FilterState
        Changed in place.
    alt_m : float
        Pressure altitude, positive up.
    """
    if s.started == 0 or not math.isfinite(alt_m):
        return False
    told, agrees = compare_height(s.baro_heights, alt_m, s.time_s - s.baro_s)
    if s.baro_known == 0:
        s.baro_heights[1] = alt_m
        return True
    if told and not agrees:
        s.baro_known = 0
    return told


@compiled
def compare_height(heights: FloatArray, alt_m: float, since_s: float) -> tuple[bool, bool]:
    """Compare a height with those before it.

    Parameters
    ----------
    heights : ndarray, shape (2,)
        The newest height, and the newest that was believed, m; changed in place.
    alt_m : float
        Positive up.
    since_s : float
        Time since the height that was believed.

    Returns
    -------
    tuple of 2 bools
        Whether it may be used, as the one or the other is near, and whether the one is that was
        believed.
    """
    most_m = FASTEST_RISE_M + FASTEST_CLIMB_MPS * min(since_s, BARO_STALE_S)
    agrees = abs(alt_m - heights[1]) <= most_m
    told = agrees or abs(alt_m - heights[0]) <= most_m
    heights[0] = alt_m
    if told:
        heights[1] = alt_m
    return told, agrees
