"""Displayed units; everything behind the page is SI."""

import math
from dataclasses import dataclass
from typing import Final, Literal

UnitSystem = Literal["metric", "imperial", "aviation"]

FT: Final = 0.3048
KT: Final = 1852 / 3600
MPH: Final = 1609.344 / 3600
FAR_M: Final = 1000.0
"""Beyond it a distance is shown in kilometres, miles or nautical miles."""
UNKNOWN: Final = "—"

FACTORS: Final[dict[UnitSystem, dict[str, tuple[float, str]]]] = {
    "metric": {
        "speed": (1.0, "m/s"), "altitude": (1.0, "m"), "climb": (1.0, "m/s"),
        "length": (1.0, "m"), "distance": (1000.0, "km"),
    },
    "imperial": {
        "speed": (MPH, "mph"), "altitude": (FT, "ft"), "climb": (FT, "ft/s"),
        "length": (FT, "ft"), "distance": (1609.344, "mi"),
    },
    "aviation": {
        "speed": (KT, "kt"), "altitude": (FT, "ft"), "climb": (FT / 60, "ft/min"),
        "length": (FT, "ft"), "distance": (1852.0, "NM"),
    },
}  # fmt: skip
"""Divisor of the SI value, and the unit's name."""


@dataclass(slots=True)
class ShownUnits:
    """The units of one page."""

    system: UnitSystem = "metric"

    def text(self, quantity: str, value: float, digits: int = 1) -> str:
        """Format an SI value with its unit.

        Parameters
        ----------
        quantity : str
            `speed`, `altitude`, `climb`, `length`, or `distance`, which is shown as a length while
            it is short.
        value : float
            In m or m/s; NaN is a dash.
        digits : int
            After the decimal point.

        Returns
        -------
        str
        """
        if not math.isfinite(value):
            return UNKNOWN
        if quantity == "distance" and abs(value) < FAR_M:
            quantity, digits = "length", 0
        factor, unit = FACTORS[self.system][quantity]
        return f"{value / factor:.{digits}f} {unit}"
