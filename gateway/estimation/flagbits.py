"""The navigation flags as plain integers, which is what compiled code can use."""

from typing import Final

from gateway.compiled import compiled
from gateway.records import NavFlags

ATTITUDE_VALID: Final = int(NavFlags.ATTITUDE_VALID)
HEADING_VALID: Final = int(NavFlags.HEADING_VALID)
POSITION_VALID: Final = int(NavFlags.POSITION_VALID)
VELOCITY_VALID: Final = int(NavFlags.VELOCITY_VALID)
ALTITUDE_VALID: Final = int(NavFlags.ALTITUDE_VALID)
AT_REST: Final = int(NavFlags.AT_REST)
USING_GPS: Final = int(NavFlags.USING_GPS)
USING_MAG: Final = int(NavFlags.USING_MAG)
USING_BARO: Final = int(NavFlags.USING_BARO)
MAG_DISTURBED: Final = int(NavFlags.MAG_DISTURBED)
GPS_REJECTED: Final = int(NavFlags.GPS_REJECTED)
DEAD_RECKONING: Final = int(NavFlags.DEAD_RECKONING)
SENSOR_FAULT: Final = int(NavFlags.SENSOR_FAULT)
DEGRADED: Final = int(NavFlags.DEGRADED)
MAG_MISPLACED: Final = int(NavFlags.MAG_MISPLACED)

HEADING_VALID_RAD: Final = 0.26
"""A heading is valid up to this standard deviation."""
FRESH_GPS_S: Final = 1.5
"""Without an accepted fix for longer than this, the estimate is dead reckoning."""


@compiled
def gps_flags(since_fix_s: float, since_reject_s: float, hold_s: float) -> int:
    """Return the flags that follow from the age of the last accepted and rejected fix.

    Parameters
    ----------
    since_fix_s, since_reject_s : float
        Ages in s.
    hold_s : float
        Dead reckoning longer than this is no position any more.

    Returns
    -------
    int
        Bits of `NavFlags`.
    """
    flags = POSITION_VALID | VELOCITY_VALID if since_fix_s < hold_s else 0
    flags |= USING_GPS if since_fix_s < FRESH_GPS_S else DEAD_RECKONING | DEGRADED
    if since_reject_s < FRESH_GPS_S:
        flags |= GPS_REJECTED | DEGRADED
    return flags
