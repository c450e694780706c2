"""Locations on the earth: home, and the coordinates that clients send in any MAV_FRAME."""

import math
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from geographiclib.geodesic import Geodesic
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import GpsFix, GpsFixType
from gateway.settings import Settings, setting

DEGE7: Final = 1e7
MAX_LAT_DEG: Final = 90.0
MAX_LON_DEG: Final = 180.0

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
    return abs(lat_deg) <= MAX_LAT_DEG and abs(lon_deg) <= MAX_LON_DEG


def describe_location_fault(location: "Location") -> str:
    """Return what is wrong with the coordinates of a location that is not on earth."""
    if not abs(location.lat_deg) <= MAX_LAT_DEG:
        return f"latitude must be between -90 and 90, not {location.lat_deg}"
    return f"longitude must be between -180 and 180, not {location.lon_deg}"


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


WANTED: Final = Geodesic.DISTANCE | Geodesic.AZIMUTH

HomeSource = Literal["none", "gps", "operator"]


@dataclass(frozen=True, slots=True)
class Location:
    """A location on the earth."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True, slots=True)
class Home:
    """The location that heights and distances refer to."""

    location: Location
    set_time_us: int
    source: HomeSource = "gps"


class HomeParameters(Settings, frozen=True):
    """Home as ground stations see and set it among the parameters; all zero while there is none."""

    source: Annotated[
        HomeSource,
        setting(
            "Who set home: none yet, the GPS, or an operator. Set 2 to keep a home of the GPS as "
            "the operator's; set 0 to clear home and let the GPS measure it again."
        ),
    ] = "none"
    lat_deg: Annotated[
        float,
        setting(
            "Latitude of home. While there is no home, one begins when latitude, longitude and "
            "height have all been set.",
            "deg",
            ge=-90.0,
            le=90.0,
        ),
    ] = 0.0
    lon_deg: Annotated[float, setting("Longitude of home.", "deg", ge=-180.0, le=180.0)] = 0.0
    alt_m: Annotated[
        float, setting("Height of home above mean sea level.", "m", ge=-1000.0, le=50000.0)
    ] = 0.0


LOCATED_FIXES = frozenset({GpsFixType.FIX_3D, GpsFixType.GNSS_AND_DEAD_RECKONING})
"""Fix types whose latitude, longitude and height all come from satellites."""


def is_3d(fix: GpsFix) -> bool:
    """Return whether the receiver reports a three-dimensional fix."""
    return fix.fix_ok and fix.fix_type in LOCATED_FIXES


def is_good_enough(fix: GpsFix, accuracy_m: float, satellites: int) -> bool:
    """Return whether a fix may set home; an accuracy that is not known does not forbid it."""
    # Some receivers report latitude 0, longitude 0 as valid before the first fix.
    somewhere = (fix.lat_dege7, fix.lon_dege7) != (0, 0) and math.isfinite(fix.alt_amsl_m)
    accurate = fix.satellites >= satellites and not fix.h_acc_m > accuracy_m
    return is_3d(fix) and somewhere and accurate


def location_of(fix: GpsFix) -> Location:
    """Return the location of a fix."""
    return Location(fix.lat_dege7 * 1e-7, fix.lon_dege7 * 1e-7, fix.alt_amsl_m)


def distance_and_bearing(here: Location, there: Location) -> tuple[float, float]:
    """Measure distance and bearing between two locations.

    Returns
    -------
    tuple of 2 floats
        Distance along the ellipsoid in metres, and bearing at `here` in rad from north, -pi to pi.
    """
    found = Geodesic.WGS84.Inverse(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg, WANTED)
    return (found["s12"], math.radians(found["azi1"]))
