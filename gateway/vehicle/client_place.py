"""Positions that clients send, in any MAV_FRAME that is accepted."""

import math
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

DEGE7: Final = 1e7

ABSOLUTE_FRAMES: Final = frozenset({mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT})
RELATIVE_FRAMES: Final = frozenset(
    {
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT,
        mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT,
    }
)
"""Heights above home; the terrain, which is not known here, is taken to be as high as home."""
GLOBAL_FRAMES: Final = ABSOLUTE_FRAMES | RELATIVE_FRAMES


def is_on_earth(lat_deg: float, lon_deg: float) -> bool:
    """Return whether a latitude and a longitude are valid."""
    return abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0


def height_amsl_m(height_m: float, frame: int, home_alt_m: float) -> float:
    """Convert a height in a MAV_FRAME to one above mean sea level.

    Parameters
    ----------
    height_m : float
        Height as sent; NaN if the client does not specify it.
    frame : int
        A MAV_FRAME of `GLOBAL_FRAMES`.
    home_alt_m : float
        Height of home above mean sea level, NaN while there is none.

    Returns
    -------
    float
        NaN if it cannot be known.
    """
    relative = frame in RELATIVE_FRAMES
    height = height_m + home_alt_m if relative else height_m
    return height if math.isfinite(height) else math.nan
