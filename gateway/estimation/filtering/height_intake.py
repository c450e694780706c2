"""A height of the barometer as it arrives: whether it is one."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.filtering.filter_state import FilterState
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
    since_s = min(s.time_s - s.baro_s, BARO_STALE_S)
    most_m = FASTEST_RISE_M + FASTEST_CLIMB_MPS * since_s
    last_m, s.baro_last_m = s.baro_last_m, alt_m
    if s.baro_known == 1 and abs(alt_m - s.baro_held_m) > most_m:
        if abs(alt_m - last_m) > most_m:
            return False
        s.baro_known = 0
    s.baro_held_m = alt_m
    return True
