"""Where home is: the first good fix of a flight, unless somebody sets it."""

import math
from dataclasses import dataclass

from gateway.records import GpsFix, GpsFixType


@dataclass(frozen=True, slots=True)
class Place:
    """A point on the earth."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True, slots=True)
class Home:
    """The place that heights and distances refer to."""

    place: Place
    set_time_us: int


HAS_PLACE = frozenset({GpsFixType.FIX_3D, GpsFixType.GNSS_AND_DEAD_RECKONING})
"""Fix types whose latitude, longitude and height all come from satellites."""


def is_3d(fix: GpsFix) -> bool:
    """Tell whether the receiver vouches for a three-dimensional fix."""
    return fix.fix_ok and fix.fix_type in HAS_PLACE


def is_good_enough(fix: GpsFix, accuracy_m: float, satellites: int) -> bool:
    """Tell whether a fix may set home; an accuracy that is not known does not forbid it."""
    # Some receivers vouch for latitude 0, longitude 0 before they know better.
    somewhere = (fix.lat_dege7, fix.lon_dege7) != (0, 0) and math.isfinite(fix.alt_amsl_m)
    accurate = fix.satellites >= satellites and not fix.h_acc_m > accuracy_m
    return is_3d(fix) and somewhere and accurate


def place_of(fix: GpsFix) -> Place:
    """Take the place out of a fix."""
    return Place(fix.lat_dege7 * 1e-7, fix.lon_dege7 * 1e-7, fix.alt_amsl_m)
