"""Tracks with as few places as still show them, and as GeoJSON."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import radii_m

TOLERANCE_M: Final = 3.0
"""Less than the error of the GPS."""
MAX_PLACES: Final = 400
"""Of one track; a day in circles gets coarser instead of larger."""

Place = tuple[float, float, float]
"""Latitude and longitude in deg, height above mean sea level in m."""


def simplified(places: Sequence[Place]) -> list[Place]:
    """Leave out places that the straight lines between the others pass within a few metres.

    The method of Ramer, Douglas and Peucker [1]_, with a greater tolerance where too many are left.

    Parameters
    ----------
    places : sequence of Place
        In the order of their times.

    References
    ----------
    .. [1] D. Douglas, T. Peucker, "Algorithms for the reduction of the number of points required to
       represent a digitized line or its caricature", Cartographica 10(2), 1973.
    """
    if len(places) < 3:
        return list(places)
    plane, tolerance_m = _in_metres(places), TOLERANCE_M
    while np.count_nonzero(kept := _kept(plane, tolerance_m)) > MAX_PLACES:
        tolerance_m *= 2.0
    return [place for place, keep in zip(places, kept.tolist(), strict=True) if keep]


def feature(places: Sequence[Place], properties: Mapping[str, Any]) -> dict[str, Any]:
    """Write a track as a GeoJSON feature (RFC 7946); cut in two where it crosses 180 degrees."""
    lines: list[list[list[float]]] = [[]]
    for lat, lon, alt in places:
        if lines[-1] and abs(lon - lines[-1][-1][0]) > 180.0:
            lines.append([])
        lines[-1].append([round(lon, 7), round(lat, 7), round(alt, 2)])
    lines = [line if len(line) > 1 else line * 2 for line in lines if line]
    return {
        "type": "Feature",
        "geometry": {"type": "MultiLineString", "coordinates": lines} if lines else None,
        "properties": dict(properties),
    }


def feature_collection(features: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Put features together as one GeoJSON document."""
    return {"type": "FeatureCollection", "features": list(features)}


def _in_metres(places: Sequence[Place]) -> NDArray[np.float64]:
    lat, lon, alt = np.array(places, np.float64).T
    meridian, parallel = radii_m(float(lat[0]), float(alt[0]))
    east_deg = wrap_180(lon - lon[0])
    return np.column_stack([np.radians(lat - lat[0]) * meridian, np.radians(east_deg) * parallel])


def _kept(plane: NDArray[np.float64], tolerance_m: float) -> NDArray[np.bool_]:
    kept = np.zeros(len(plane), np.bool_)
    kept[[0, -1]] = True
    stretches = [(0, len(plane) - 1)]
    while stretches:
        begin, end = stretches.pop()
        if end - begin < 2:
            continue
        away = _distances_m(plane[begin + 1 : end], plane[begin], plane[end])
        farthest = int(np.argmax(away))
        if away[farthest] > tolerance_m:
            middle = begin + 1 + farthest
            kept[middle] = True
            stretches += [(begin, middle), (middle, end)]
    return kept


def _distances_m(
    points: NDArray[np.float64], begin: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances from the line between two points: it ends there."""
    line = end - begin
    length2 = float(line @ line)
    share = ((points - begin) @ line / length2).clip(0.0, 1.0) if length2 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - begin - share[:, np.newaxis] * line, axis=1))
