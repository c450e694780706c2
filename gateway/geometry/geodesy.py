"""The WGS 84 ellipsoid near one position: metres north and east against degrees.

`pymap3d` does the exact conversions in tools and analysis; the two radii here are for the
per-sample kernels, which only move some metres from a known latitude.
"""

import math

from gateway.compiled import compiled
from gateway.geometry.angle import wrap_180

SEMI_MAJOR_M = 6_378_137.0
ECCENTRICITY_SQ = 6.694_379_990_141_317e-3


@compiled
def radii_m(lat_deg: float, alt_m: float) -> tuple[float, float]:
    """Compute metres per radian of latitude and of longitude, at a height above the ellipsoid.

    See P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems",
    2nd ed., 2013, eq. 2.105 and 2.106; the second radius contains the cosine of the latitude.
    """
    sin_lat = math.sin(math.radians(lat_deg))
    w_sq = 1.0 - ECCENTRICITY_SQ * sin_lat * sin_lat
    w = math.sqrt(w_sq)
    meridian = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQ) / (w_sq * w)
    transverse = SEMI_MAJOR_M / w
    return (meridian + alt_m, (transverse + alt_m) * math.cos(math.radians(lat_deg)))


@compiled
def offset_deg(
    lat_deg: float, lon_deg: float, alt_m: float, north_m: float, east_m: float
) -> tuple[float, float]:
    """Return latitude and longitude after a step north and east.

    It is a first-order approximation, for steps well below a kilometre. Longitude is in
    [-180, 180).
    """
    meridian, parallel = radii_m(lat_deg, alt_m)
    lat = lat_deg + math.degrees(north_m / meridian)
    lon = lon_deg + math.degrees(east_m / max(parallel, 1.0))
    return (lat, wrap_180(lon))


@compiled
def displacement_m(
    from_lat_deg: float, from_lon_deg: float, to_lat_deg: float, to_lon_deg: float, alt_m: float
) -> tuple[float, float]:
    """Return a short distance as metres north and east, with the radii at its start."""
    meridian, parallel = radii_m(from_lat_deg, alt_m)
    delta_lon = wrap_180(to_lon_deg - from_lon_deg)
    return (math.radians(to_lat_deg - from_lat_deg) * meridian, math.radians(delta_lon) * parallel)
