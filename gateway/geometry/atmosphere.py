"""The ICAO standard atmosphere in the troposphere: height by pressure, and pressure by height."""

import math
from typing import Final

SEA_LEVEL_PA: Final = 101_325.0
SCALE_M: Final = 44_330.769
"""Height at which the formula ends, 288.15 K / 0.0065 K/m: there is no pressure above it."""
EXPONENT: Final = 0.190263
"""Gas constant of air times the lapse rate, over gravity."""


def pressure_altitude_m(pressure_pa: float) -> float:
    """Convert a static pressure to the height above the 1013.25 hPa level, in m, positive up.

    NaN for a pressure of zero or less.
    """
    if not pressure_pa > 0.0:
        return math.nan
    return SCALE_M * (1.0 - float((pressure_pa / SEA_LEVEL_PA) ** EXPONENT))


def pressure_at_height(alt_m: float, zero_pa: float = SEA_LEVEL_PA) -> float:
    """Convert a height above the level of a pressure, in m, to the static pressure in Pa.

    NaN for a height outside the formula.
    """
    if not alt_m < SCALE_M:
        return math.nan
    return float(zero_pa * (1.0 - alt_m / SCALE_M) ** (1.0 / EXPONENT))
