"""Tracks as GeoJSON (RFC 7946), with times as in togeojson."""

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from gateway.flightlog.mapshape import TrackPoint, VehicleTrack, iso_time

HALF_TURN_DEG = 180.0


def to_geojson(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight: a line per vehicle with `coordTimes`, its home, marks and events as points.

    Parameters
    ----------
    name : str
        Name of the flight on the map.
    vehicles : iterable of VehicleTrack
        Each with its points in the order of their times.

    Yields
    ------
    str
        Pieces of the file.
    """
    yield f'{{"type":"FeatureCollection","name":{json.dumps(name)},"features":['
    separator = "\n"
    for vehicle in vehicles:
        for feature in _features(vehicle):
            yield separator + json.dumps(feature, separators=(",", ":"), allow_nan=False)
            separator = ",\n"
    yield "\n]}\n"


def _features(vehicle: VehicleTrack) -> Iterator[dict[str, Any]]:
    parts = _parts(vehicle.points)
    lines = [[_position(point) for point in part] for part in parts]
    times = [[iso_time(point.time_us) for point in part] for part in parts]
    kind = "MultiLineString"
    coordinates: Any = lines
    coord_times: Any = times
    if len(parts) == 1:
        # A line must have two points, even a track of one.
        single = len(parts[0]) == 1
        kind, coordinates = ("Point", lines[0][0]) if single else ("LineString", lines[0])
        coord_times = times[0]
    properties: dict[str, Any] = {"name": vehicle.name, "kind": "track", "time": times[0][0]}
    yield _feature(kind, coordinates, properties | {"coordTimes": coord_times})
    for place in vehicle.places:
        time = iso_time(place.at.time_us)
        properties = {"name": place.name, "kind": str(place.kind), "vehicle": vehicle.name}
        yield _feature("Point", _position(place.at), properties | {"time": time})


def _parts(points: list[TrackPoint]) -> list[list[TrackPoint]]:
    """Cut a track at the antimeridian, as the standard asks."""
    parts: list[list[TrackPoint]] = [[]]
    before: TrackPoint | None = None
    for point in points:
        if before is not None and abs(point.lon_deg - before.lon_deg) > HALF_TURN_DEG:
            edge = _crossing(before, point)
            parts[-1].append(edge)
            parts.append([replace(edge, lon_deg=-edge.lon_deg)])
        parts[-1].append(point)
        before = point
    return parts


def _crossing(before: TrackPoint, after: TrackPoint) -> TrackPoint:
    """Find where the line between two points crosses the antimeridian, on the side of the first."""
    edge_deg = math.copysign(HALF_TURN_DEG, before.lon_deg)
    way_deg = (after.lon_deg - before.lon_deg) % (2.0 * HALF_TURN_DEG)
    east_deg = way_deg - 2.0 * HALF_TURN_DEG if way_deg > HALF_TURN_DEG else way_deg
    share = (edge_deg - before.lon_deg) / east_deg
    return TrackPoint(
        round(before.time_us + share * (after.time_us - before.time_us)),
        before.lat_deg + share * (after.lat_deg - before.lat_deg),
        edge_deg,
        before.alt_amsl_m + share * (after.alt_amsl_m - before.alt_amsl_m),
    )


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _position(point: TrackPoint) -> list[float]:
    place = [round(point.lon_deg, 7), round(point.lat_deg, 7)]
    return [*place, round(point.alt_amsl_m, 2)] if math.isfinite(point.alt_amsl_m) else place
