"""The Earth's magnetic field at a position, by the World Magnetic Model of `pygeomag`."""

import math
from functools import cache
from typing import NamedTuple

import pygeomag
from pygeomag.wmm import wmm_2025

EPOCH_YEAR = 2025.0
"""First year of the model, which is valid for five years; its error then grows by some 0.1 deg a
year."""

_US_PER_YEAR = 365.2425 * 86_400e6


class MagneticField(NamedTuple):
    """The field of the Earth at one position."""

    declination_rad: float
    """Magnetic north relative to true north, positive east."""
    inclination_rad: float
    """Dip below the horizon, positive down."""
    strength_ut: float


@cache
def _model() -> pygeomag.GeoMag:
    # The coefficients are Python data, since reading the .COF file would be I/O in a pure package.
    return pygeomag.GeoMag(coefficients_data=wmm_2025.WMM_2025)


def year_of(utc_us: int | None) -> float:
    """Convert Unix time to a decimal year; the middle of the model's span if unknown."""
    return EPOCH_YEAR + 2.5 if utc_us is None else 1970.0 + utc_us / _US_PER_YEAR


def magnetic_field(lat_deg: float, lon_deg: float, alt_m: float, year: float) -> MagneticField:
    """Return the main field; the difference of ellipsoid and geoid is negligible here."""
    found = _model().calculate(
        glat=lat_deg, glon=lon_deg, alt=alt_m * 1e-3, time=year, allow_date_outside_lifespan=True
    )
    return MagneticField(math.radians(found.d), math.radians(found.i), found.f * 1e-3)
