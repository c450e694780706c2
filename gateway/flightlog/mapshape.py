"""Tracks for maps: all vehicles of a flight with their events, as KML and GPX."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from typing import Final
from xml.sax import saxutils

from gateway.units import US_PER_S

COLOURS: Final = ("ff0000ff", "ffff7000", "ff00b000", "ff00c8ff", "ffff00c8", "ffc8c800")
"""Of the vehicles' lines: alpha, blue, green, red."""
_NOT_IN_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """One point of a track."""

    time_us: int
    """µs since 1970, or since the start where civil time is not known."""
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    attitude_deg: tuple[float, float, float] | None = None
    """Roll, pitch and yaw, where they are known."""


class PlaceKind(StrEnum):
    """Kind of a single place on the map."""

    HOME = "home"
    MARK = "mark"
    EVENT = "event"


@dataclass(frozen=True, slots=True)
class MapPlace:
    """Home, a mark, or where the vehicle was when something happened."""

    kind: PlaceKind
    name: str
    at: TrackPoint


@dataclass(slots=True)
class VehicleTrack:
    """One vehicle on the map."""

    name: str
    points: list[TrackPoint] = field(default_factory=list)
    places: list[MapPlace] = field(default_factory=list)


FIRST_US: Final = 0
LAST_US: Final = 253_402_300_799 * US_PER_S
"""The ends of the calendar that other programs read: 1970 to 9999."""


def to_kml(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight as KML 2.2: a folder per vehicle, with its track, attitude and places.

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
    yield (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2">\n'
        f"<Document><name>{_escaped(name)}</name>\n"
    )
    yield from (
        f'<Style id="track{number}"><LineStyle><color>{colour}</color><width>3</width></LineStyle>'
        "</Style>\n"
        for number, colour in enumerate(COLOURS)
    )
    for number, vehicle in enumerate(vehicles):
        yield f"<Folder><name>{_escaped(vehicle.name)}</name>\n"
        yield from _kml_track(vehicle, f"#track{number % len(COLOURS)}")
        yield from map(_kml_place, vehicle.places)
        yield "</Folder>\n"
    yield "</Document></kml>\n"


def _kml_track(vehicle: VehicleTrack, style: str) -> Iterator[str]:
    yield (
        f"<Placemark><name>{_escaped(vehicle.name)}</name><styleUrl>{style}</styleUrl>\n"
        "<gx:Track><altitudeMode>absolute</altitudeMode>\n"
    )
    yield from (f"<when>{iso_time(point.time_us)}</when>\n" for point in vehicle.points)
    yield from (f"<gx:coord>{_kml_coordinates(p, ' ')}</gx:coord>\n" for p in vehicle.points)
    if any(point.attitude_deg is not None for point in vehicle.points):
        # Heading, tilt, roll; an empty element means "not known here".
        yield from (f"<gx:angles>{_kml_angles(p)}</gx:angles>\n" for p in vehicle.points)
    yield "</gx:Track></Placemark>\n"


def _kml_place(place: MapPlace) -> str:
    return (
        f"<Placemark><name>{_escaped(place.name)}</name><description>{place.kind}</description>"
        f"<TimeStamp><when>{iso_time(place.at.time_us)}</when></TimeStamp>"
        "<Point><altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{_kml_coordinates(place.at, ',')}</coordinates></Point></Placemark>\n"
    )


def _kml_coordinates(point: TrackPoint, separator: str) -> str:
    figures = (f"{point.lon_deg:.7f}", f"{point.lat_deg:.7f}", f"{point.alt_amsl_m:.2f}")
    return separator.join(figures)


def _kml_angles(point: TrackPoint) -> str:
    if point.attitude_deg is None:
        return ""
    roll, pitch, yaw = point.attitude_deg
    return f"{yaw % 360.0:.1f} {pitch:.1f} {roll:.1f}"


def to_gpx(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight as GPX 1.1; see `to_kml`.

    Places are waypoints. GPX has no attitude: it is in the extensions of each point, in a separate
    namespace, which other programs ignore.
    """
    vehicles = list(vehicles)
    yield (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="mavgate" xmlns="http://www.topografix.com/GPX/1/1" '
        'xmlns:mavgate="urn:mavgate:attitude:1">\n'
        f"<metadata><name>{_escaped(name)}</name></metadata>\n"
    )
    for vehicle in vehicles:
        yield from (
            f"<wpt {_gpx_place(place.at)}{_gpx_time(place.at)}<name>{_escaped(place.name)}</name>"
            f"<desc>{_escaped(vehicle.name)}</desc><type>{place.kind}</type></wpt>\n"
            for place in vehicle.places
        )
    for vehicle in vehicles:
        yield f"<trk><name>{_escaped(vehicle.name)}</name><trkseg>\n"
        yield from (
            f"<trkpt {_gpx_place(p)}{_gpx_time(p)}{_gpx_attitude(p)}</trkpt>\n"
            for p in vehicle.points
        )
        yield "</trkseg></trk>\n"
    yield "</gpx>\n"


def _escaped(text: str) -> str:
    """Write a text in XML, which has no control characters at all, not even escaped ones."""
    return saxutils.escape(_NOT_IN_XML.sub("\N{REPLACEMENT CHARACTER}", text))


def _gpx_place(point: TrackPoint) -> str:
    return f'lat="{point.lat_deg:.7f}" lon="{point.lon_deg:.7f}"><ele>{point.alt_amsl_m:.2f}</ele>'


def _gpx_time(point: TrackPoint) -> str:
    return f"<time>{iso_time(point.time_us)}</time>"


def _gpx_attitude(point: TrackPoint) -> str:
    if point.attitude_deg is None:
        return ""
    roll, pitch, yaw = point.attitude_deg
    return (
        f'<extensions><mavgate:attitude roll="{roll:.1f}" pitch="{pitch:.1f}" '
        f'yaw="{yaw % 360.0:.1f}"/></extensions>'
    )


def iso_time(unix_us: int) -> str:
    """Write a time as ISO 8601; one beyond the calendar as its nearest end."""
    seconds, fraction_us = divmod(min(max(unix_us, FIRST_US), LAST_US), US_PER_S)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction_us // 1000:03d}Z"
