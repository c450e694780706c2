"""A track for a map: KML and GPX, written piece by piece so that any length fits the memory."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final
from xml.sax.saxutils import escape

from gateway.units import US_PER_S

INTERVAL_US: Final = US_PER_S // 5
"""A map shows no more than five points a second."""


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """One point of a track."""

    time_us: int
    """µs since 1970, or since the start where civil time is not known."""
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


def thin_out(points: Iterable[TrackPoint], interval_us: int = INTERVAL_US) -> Iterator[TrackPoint]:
    """Leave out points that follow the last one sooner than an interval."""
    last_us: int | None = None
    for point in points:
        if last_us is None or not 0 <= point.time_us - last_us < interval_us:
            last_us = point.time_us
            yield point


def to_kml(name: str, points: Iterable[TrackPoint]) -> Iterator[str]:
    """Write a track as KML 2.2: a line with times, at its height above the sea.

    Parameters
    ----------
    name : str
        What the map calls it.
    points : iterable of TrackPoint
        In the order of their times.

    Yields
    ------
    str
        Pieces of the file.
    """
    yield (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2">\n'
        f"<Document><name>{escape(name)}</name>\n"
        '<Style id="track"><LineStyle><color>ff0000ff</color><width>3</width></LineStyle></Style>\n'
        f"<Placemark><name>{escape(name)}</name><styleUrl>#track</styleUrl>\n"
        "<gx:Track><altitudeMode>absolute</altitudeMode>\n"
    )
    for point in points:
        yield (
            f"<when>{_iso(point.time_us)}</when>"
            f"<gx:coord>{point.lon_deg:.7f} {point.lat_deg:.7f} {point.alt_amsl_m:.2f}</gx:coord>\n"
        )
    yield "</gx:Track></Placemark></Document></kml>\n"


def to_gpx(name: str, points: Iterable[TrackPoint]) -> Iterator[str]:
    """Write a track as GPX 1.1; see `to_kml`."""
    yield (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="mavgate" xmlns="http://www.topografix.com/GPX/1/1">\n'
        f"<trk><name>{escape(name)}</name><trkseg>\n"
    )
    for point in points:
        yield (
            f'<trkpt lat="{point.lat_deg:.7f}" lon="{point.lon_deg:.7f}">'
            f"<ele>{point.alt_amsl_m:.2f}</ele><time>{_iso(point.time_us)}</time></trkpt>\n"
        )
    yield "</trkseg></trk></gpx>\n"


def _iso(unix_us: int) -> str:
    seconds, fraction_us = divmod(unix_us, US_PER_S)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction_us // 1000:03d}Z"
