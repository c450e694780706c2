"""Map tracks of all vehicles of a flight with their events, as KML, GPX and GeoJSON."""

import json
import math
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import chain, groupby
from typing import Any, Final
from xml.sax import saxutils

from gateway.aircraft import AircraftSettings
from gateway.answers.log_answers import HOME_POSITION_ID
from gateway.geometry.quaternion import to_euler
from gateway.recordings.moment import iso_time
from gateway.recordings.recorded_table import RecordedTable
from gateway.recordings.rows import TableRow
from gateway.recordings.table import NOTE, TableNote
from gateway.recordings.vehicle_reader import VehicleMessage
from gateway.records import FusionState, GpsFix, NavFlags, Quat
from gateway.units import DEG_PER_DEGE7, US_PER_S
from gateway.vehicle.plan import is_good_enough
from gateway.vehicle_state.positions import Continuity, TrackPoint, named_position

COLOURS: Final = ("ff0000ff", "ffff7000", "ff00b000", "ff00c8ff", "ffff00c8", "ffc8c800")
"""Colours of the vehicles' lines, as hexadecimal alpha, blue, green, red."""
_NOT_IN_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
HALF_TURN_DEG = 180.0
INFO: Final = 6
"""MAV_SEVERITY_INFO; less severe texts are for programmers and not drawn."""
_MARKED: Final = re.compile(r"Marked (-?\d+\.\d+), (-?\d+\.\d+)")
"""The gateway's STATUSTEXT for a marked position."""
INTERVAL_US: Final = US_PER_S // 5
"""Minimum interval between drawn points: five per second suffice on a map."""
MAX_MARKERS: Final = 10_000
"""Limit for one vehicle, so that a flood of texts cannot fill the memory."""
ATTITUDE_AGE_US: Final = US_PER_S
"""An attitude also applies to positions up to this time before it."""
DRAWN_IDS: Final = (HOME_POSITION_ID,)
"""Messages that are drawn in addition to positions, attitude and texts."""


class MarkerKind(StrEnum):
    """Kind of a marker on the map."""

    HOME = "home"
    MARK = "mark"
    NOTE = "note"
    EVENT = "event"


@dataclass(frozen=True, slots=True)
class MapMarker:
    """Home, a mark, a note, or the vehicle's position at an event."""

    kind: MarkerKind
    name: str
    at: TrackPoint


@dataclass(slots=True)
class VehicleTrack:
    """One vehicle on the map."""

    name: str
    segments: list[list[TrackPoint]] = field(default_factory=list)
    """Non-empty parts of the track, which is interrupted between them."""
    markers: list[MapMarker] = field(default_factory=list)

    @property
    def points(self) -> list[TrackPoint]:
        """All points of the track."""
        return [*chain.from_iterable(self.segments)]


def to_kml(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight as KML 2.2: one folder per vehicle, with its track, attitude and markers."""
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
        yield from map(_kml_marker, vehicle.markers)
        yield "</Folder>\n"
    yield "</Document></kml>\n"


def _kml_track(vehicle: VehicleTrack, style: str) -> Iterator[str]:
    # Either all points of a gx:Track have angles, or none.
    tracks = [
        [*points]
        for segment in vehicle.segments
        for _, points in groupby(segment, lambda point: point.attitude_deg is None)
    ]
    mode = _kml_mode(vehicle.points)
    yield f"<Placemark><name>{_escaped(vehicle.name)}</name><styleUrl>{style}</styleUrl>\n"
    yield f"<gx:MultiTrack>{mode}<gx:interpolate>0</gx:interpolate>\n" if len(tracks) > 1 else ""
    for points in tracks:
        yield f"<gx:Track>{mode}\n"
        yield from (f"<when>{iso_time(point.time_us)}</when>\n" for point in points)
        yield from (f"<gx:coord>{_kml_coordinates(p, ' ')}</gx:coord>\n" for p in points)
        for roll, pitch, yaw in (p.attitude_deg for p in points if p.attitude_deg is not None):
            # The order of gx:angles: heading, tilt, roll.
            yield f"<gx:angles>{yaw % 360.0:.1f} {pitch:.1f} {roll:.1f}</gx:angles>\n"
        yield "</gx:Track>\n"
    yield "</gx:MultiTrack>" if len(tracks) > 1 else ""
    yield "</Placemark>\n"


def _kml_mode(points: Iterable[TrackPoint]) -> str:
    """Return the altitude mode; clamped to the ground, not at sea level, if no height is known."""
    has_heights = any(math.isfinite(point.alt_amsl_m) for point in points)
    return f"<altitudeMode>{'absolute' if has_heights else 'clampToGround'}</altitudeMode>"


def _kml_marker(marker: MapMarker) -> str:
    return (
        f"<Placemark><name>{_escaped(marker.name)}</name><description>{marker.kind}</description>"
        f"<TimeStamp><when>{iso_time(marker.at.time_us)}</when></TimeStamp>"
        f"<Point>{_kml_mode([marker.at])}"
        f"<coordinates>{_kml_coordinates(marker.at, ',')}</coordinates></Point></Placemark>\n"
    )


def _kml_coordinates(point: TrackPoint, separator: str) -> str:
    height = [f"{point.alt_amsl_m:.2f}"] if math.isfinite(point.alt_amsl_m) else []
    return separator.join([f"{point.lon_deg:.7f}", f"{point.lat_deg:.7f}", *height])


def to_gpx(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight as GPX 1.1; see `to_kml`.

    Markers become waypoints. GPX has no attitude, so it is in the extensions of each point, in
    a separate namespace that other programs ignore.
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
            f"<wpt {_gpx_position(marker.at)}{_gpx_time(marker.at)}"
            f"<name>{_escaped(marker.name)}</name><desc>{_escaped(vehicle.name)}</desc>"
            f"<type>{marker.kind}</type></wpt>\n"
            for marker in vehicle.markers
        )
    for vehicle in vehicles:
        yield f"<trk><name>{_escaped(vehicle.name)}</name>"
        for points in vehicle.segments:
            yield "<trkseg>\n"
            yield from (
                f"<trkpt {_gpx_position(p)}{_gpx_time(p)}{_gpx_attitude(p)}</trkpt>\n"
                for p in points
            )
            yield "</trkseg>"
        yield "</trk>\n"
    yield "</gpx>\n"


def _escaped(text: str) -> str:
    """Escape a text for XML, without control characters, which XML cannot represent at all."""
    return saxutils.escape(_NOT_IN_XML.sub("\N{REPLACEMENT CHARACTER}", text))


def _gpx_position(point: TrackPoint) -> str:
    height = f"<ele>{point.alt_amsl_m:.2f}</ele>" if math.isfinite(point.alt_amsl_m) else ""
    # The GPX schema requires a longitude below 180.
    lon_deg = -180.0 if round(point.lon_deg, 7) >= 180.0 else point.lon_deg
    return f'lat="{point.lat_deg:.7f}" lon="{lon_deg:.7f}">{height}'


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


def to_geojson(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight: one line per vehicle with `coordTimes`; home, marks and events as points."""
    yield f'{{"type":"FeatureCollection","name":{json.dumps(name)},"features":['
    separator = "\n"
    for vehicle in vehicles:
        for feature in _features(vehicle):
            yield separator + json.dumps(feature, separators=(",", ":"), allow_nan=False)
            separator = ",\n"
    yield "\n]}\n"


def _features(vehicle: VehicleTrack) -> Iterator[dict[str, Any]]:
    begin = iso_time(vehicle.segments[0][0].time_us)
    yield track_feature(
        vehicle.segments, {"name": vehicle.name, "kind": "track", "time": begin}, with_times=True
    )
    for marker in vehicle.markers:
        time = iso_time(marker.at.time_us)
        properties = {"name": marker.name, "kind": str(marker.kind), "vehicle": vehicle.name}
        yield _feature("Point", _position(marker.at), properties | {"time": time})


def track_feature(
    segments: Iterable[list[TrackPoint]], properties: dict[str, Any], *, with_times: bool = False
) -> dict[str, Any]:
    """Convert a track to a GeoJSON feature (RFC 7946), cut where it crosses the antimeridian."""
    parts = [part for segment in segments for part in _parts(segment)]
    if with_times:
        times: list[Any] = [[iso_time(point.time_us) for point in part] for part in parts]
        properties = properties | {"coordTimes": times[0] if len(parts) == 1 else times}
    lines = [[_position(point) for point in part] for part in parts]
    if len(lines) == 1:
        if len(lines[0]) == 1:
            return _feature("Point", lines[0][0], properties)
        return _feature("LineString", lines[0], properties)
    # A line must have at least two points, so a single one is repeated.
    lines = [line if len(line) > 1 else line * 2 for line in lines]
    return _feature("MultiLineString", lines, properties)


def _parts(points: list[TrackPoint]) -> list[list[TrackPoint]]:
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
    """Find where a line between two points crosses the antimeridian, on the first one's side."""
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
    geometry = {"type": kind, "coordinates": coordinates} if coordinates else None
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _position(point: TrackPoint) -> list[float]:
    position = [round(point.lon_deg, 7), round(point.lat_deg, 7)]
    return [*position, round(point.alt_amsl_m, 2)] if math.isfinite(point.alt_amsl_m) else position


class _Drawing:
    """The track of one vehicle while its flight is read."""

    def __init__(self, name: str) -> None:
        self.track = VehicleTrack(name)
        self.homes: set[tuple[float, float]] = set()
        self._attitude_deg: tuple[float, float, float] | None = None
        self._texts: list[tuple[int, str]] = []
        self._continuity = Continuity()

    def turn(self, time_us: int, q_nb: Quat) -> None:
        """Apply an attitude to the following points; the first one also to those just before."""
        is_first, self._attitude_deg = self._attitude_deg is None, angles_deg(q_nb)
        if not is_first or not self.track.segments:
            return
        points = self.track.segments[-1]
        for k in range(len(points) - 1, -1, -1):
            if time_us - points[k].time_us > ATTITUDE_AGE_US:
                break
            points[k] = replace(points[k], attitude_deg=self._attitude_deg)

    def add(self, point: TrackPoint, boot_us: int | None = None) -> None:
        segments = self.track.segments
        newest = segments[-1][-1] if segments else None
        if newest is not None and 0 <= point.time_us - newest.time_us < INTERVAL_US:
            return
        at = (point.time_us, point.lat_deg, point.lon_deg)
        if self._continuity.is_broken_at(*at, boot_us) or newest is None:
            segments.append([])
        known = point.attitude_deg or self._attitude_deg
        segments[-1].append(replace(point, attitude_deg=known))

    def add_home(self, at: TrackPoint) -> None:
        """Mark a home position, unless it is marked already."""
        if (at.lat_deg, at.lon_deg) not in self.homes and len(self.homes) < MAX_MARKERS:
            self.homes.add((at.lat_deg, at.lon_deg))
            self.track.markers.append(MapMarker(MarkerKind.HOME, "Home", at))

    def add_text(self, time_us: int, text: str) -> None:
        if len(self._texts) < MAX_MARKERS:
            self._texts.append((time_us, text))

    def drawn(self) -> VehicleTrack | None:
        """Return the track, with texts at the vehicle's positions; None without any position."""
        points = self.track.points
        times_us = [point.time_us for point in points]
        for time_us, text in sorted(self._texts) if points else ():
            here = points[max(bisect_right(times_us, time_us) - 1, 0)]
            at = TrackPoint(time_us, here.lat_deg, here.lon_deg, here.alt_amsl_m)
            if marked := _MARKED.fullmatch(text):
                lat_deg, lon_deg = map(float, marked.groups())
                at = replace(at, lat_deg=lat_deg, lon_deg=lon_deg)
            note = text.removeprefix(NOTE)
            others = MarkerKind.NOTE if note != text else MarkerKind.EVENT
            kind = MarkerKind.MARK if marked else others
            self.track.markers.append(MapMarker(kind, note, at))
        return self.track if points else None


def tracks_of_messages(messages: Iterable[VehicleMessage]) -> list[VehicleTrack]:
    """Collect the vehicles' tracks in MAVLink; the messages must include `DRAWN_IDS`."""
    drawings: dict[int, _Drawing] = {}
    for message in messages:
        system_id, time_us = message.system_id, message.time_us
        one = drawings.get(system_id)
        if one is None:
            one = drawings[system_id] = _Drawing(f"system {system_id}")
        if (at := message.position) is not None:
            one.add(TrackPoint(time_us, at.lat_deg, at.lon_deg, at.alt_amsl_m), message.boot_us)
        elif message.q_nb is not None:
            one.turn(time_us, message.q_nb)
        elif message.text is not None and message.text.severity <= INFO:
            one.add_text(time_us, message.text.text)
        elif message.message_id == HOME_POSITION_ID and (home := named_position(message.fields)):
            one.add_home(TrackPoint(time_us, home.lat_deg, home.lon_deg, home.alt_amsl_m))
    found = (one.drawn() for _, one in sorted(drawings.items()))
    return [track for track in found if track is not None]


def tracks_of_table(table: RecordedTable, aircraft: AircraftSettings) -> list[VehicleTrack]:
    """Collect the track of a table's aircraft: fused, or its fixes if no state has a position."""
    zero_us = table.header.unix_us_at_zero or 0
    name = f"aircraft {table.header.vehicle_id}"
    one, of_fixes = _Drawing(name), _Drawing(name)
    for row in table.rows:
        if isinstance(row, TableNote):
            one.add_text(zero_us + row.time_us, NOTE + row.text)
        elif isinstance(row, FusionState) and row.home is not None and not one.homes:
            lat_deg, lon_deg, alt_m, since_us = row.home
            one.add_home(TrackPoint(zero_us + since_us, lat_deg, lon_deg, alt_m))
        elif isinstance(row, TableRow):
            _add_row(row, one, of_fixes, aircraft, zero_us)
    if not one.track.segments:
        one.track.segments = of_fixes.track.segments
    track = one.drawn()
    return [] if track is None else [track]


def _add_row(
    row: TableRow, one: _Drawing, of_fixes: _Drawing, aircraft: AircraftSettings, zero_us: int
) -> None:
    state, fix, limits = row.state, row.gps, aircraft.vehicle
    if fix is not None:
        point = point_of_fix(fix, zero_us)
        if not one.homes and is_good_enough(fix, limits.home_accuracy_m, limits.home_satellites):
            one.add_home(point)
        if fix.fix_ok and (fix.lat_dege7 or fix.lon_dege7):
            of_fixes.add(point)
    if state is None:
        return
    has_attitude = NavFlags.ATTITUDE_VALID in state.flags
    attitude_deg = angles_deg(state.q_nb) if has_attitude else None
    if NavFlags.POSITION_VALID in state.flags:
        position = (state.lat_deg, state.lon_deg, state.alt_amsl_m)
        one.add(TrackPoint(zero_us + row.time_us, *position, attitude_deg))
    elif has_attitude and math.isfinite(sum(state.q_nb)):
        of_fixes.turn(zero_us + row.time_us, state.q_nb)


def point_of_fix(fix: GpsFix, zero_us: int = 0) -> TrackPoint:
    """Return the position of a fix, given the civil time of the gateway's time zero."""
    lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
    return TrackPoint(zero_us + fix.time_us, lat_deg, lon_deg, fix.alt_amsl_m)


def angles_deg(q_nb: Quat) -> tuple[float, float, float] | None:
    """Return roll, pitch and yaw; None if the attitude is not known."""
    if not math.isfinite(sum(q_nb)) or not any(q_nb):
        return None
    roll, pitch, yaw = map(math.degrees, to_euler(q_nb))
    return roll, pitch, yaw
