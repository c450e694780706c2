"""Tracks for maps: all vehicles of a flight with their events, as KML, GPX and GeoJSON."""

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final
from xml.sax import saxutils

from gateway.aircraft import AircraftSettings
from gateway.geometry.quaternion import to_euler
from gateway.recordings.answers import HOME_POSITION_ID, is_station
from gateway.recordings.columns import TableRow
from gateway.recordings.reading import RecordedTable
from gateway.recordings.summary import GLOBAL_POSITION_INT_ID
from gateway.recordings.table import REMARK, TableMark
from gateway.recordings.tlog import HEARTBEAT_ID, TlogRecord, fields_of
from gateway.records import FusionState, GpsFix, NavFlags, Quat
from gateway.units import DEG_PER_DEGE7, M_PER_MM, US_PER_S
from gateway.vehicle.plan import is_good_enough
from gateway.wire.mavlink_splitter import frame_of, message_id_of

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


class MarkerKind(StrEnum):
    """Kind of a marker on the map."""

    HOME = "home"
    MARK = "mark"
    EVENT = "event"


@dataclass(frozen=True, slots=True)
class MapMarker:
    """Home, a mark, or where the vehicle was when something happened."""

    kind: MarkerKind
    name: str
    at: TrackPoint


@dataclass(slots=True)
class VehicleTrack:
    """One vehicle on the map."""

    name: str
    points: list[TrackPoint] = field(default_factory=list)
    markers: list[MapMarker] = field(default_factory=list)


FIRST_US: Final = 0
LAST_US: Final = 253_402_300_799 * US_PER_S
"""The ends of the calendar that other programs read: 1970 to 9999."""


def to_kml(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight as KML 2.2: a folder per vehicle, with its track, attitude and markers."""
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


def _kml_marker(marker: MapMarker) -> str:
    return (
        f"<Placemark><name>{_escaped(marker.name)}</name><description>{marker.kind}</description>"
        f"<TimeStamp><when>{iso_time(marker.at.time_us)}</when></TimeStamp>"
        "<Point><altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{_kml_coordinates(marker.at, ',')}</coordinates></Point></Placemark>\n"
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

    Markers are waypoints. GPX has no attitude: it is in the extensions of each point, in a separate
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
            f"<wpt {_gpx_position(marker.at)}{_gpx_time(marker.at)}"
            f"<name>{_escaped(marker.name)}</name><desc>{_escaped(vehicle.name)}</desc>"
            f"<type>{marker.kind}</type></wpt>\n"
            for marker in vehicle.markers
        )
    for vehicle in vehicles:
        yield f"<trk><name>{_escaped(vehicle.name)}</name><trkseg>\n"
        yield from (
            f"<trkpt {_gpx_position(p)}{_gpx_time(p)}{_gpx_attitude(p)}</trkpt>\n"
            for p in vehicle.points
        )
        yield "</trkseg></trk>\n"
    yield "</gpx>\n"


def _escaped(text: str) -> str:
    """Write a text in XML, which has no control characters at all, not even escaped ones."""
    return saxutils.escape(_NOT_IN_XML.sub("\N{REPLACEMENT CHARACTER}", text))


def _gpx_position(point: TrackPoint) -> str:
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


HALF_TURN_DEG = 180.0


def to_geojson(name: str, vehicles: Iterable[VehicleTrack]) -> Iterator[str]:
    """Write a flight: a line per vehicle with `coordTimes`; home, marks and events as points."""
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
    for marker in vehicle.markers:
        time = iso_time(marker.at.time_us)
        properties = {"name": marker.name, "kind": str(marker.kind), "vehicle": vehicle.name}
        yield _feature("Point", _position(marker.at), properties | {"time": time})


def _parts(points: list[TrackPoint]) -> list[list[TrackPoint]]:
    """Cut a track at the antimeridian, as RFC 7946 requires."""
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
    position = [round(point.lon_deg, 7), round(point.lat_deg, 7)]
    return [*position, round(point.alt_amsl_m, 2)] if math.isfinite(point.alt_amsl_m) else position


ATTITUDE_ID: Final = 30
ATTITUDE_QUATERNION_ID: Final = 31
STATUSTEXT_ID: Final = 253
_READ: Final = frozenset(
    {
        ATTITUDE_ID, ATTITUDE_QUATERNION_ID, GLOBAL_POSITION_INT_ID, HOME_POSITION_ID,
        STATUSTEXT_ID,
    }
)  # fmt: skip
INFO: Final = 6
"""MAV_SEVERITY_INFO; texts that are less severe are for programmers."""
_MARKED: Final = re.compile(r"Marked (-?\d+\.\d+), (-?\d+\.\d+)")
"""The gateway's STATUSTEXT for a marked position."""
INTERVAL_US: Final = US_PER_S // 5
"""A map shows no more than five points a second."""
MAX_MARKERS: Final = 10_000
"""Of one vehicle; a flood of texts must not fill the memory."""


@dataclass(slots=True)
class _Drawn:
    """One vehicle while its frames are read."""

    track: VehicleTrack
    attitude_deg: tuple[float, float, float] | None = None
    home: tuple[int, int] | None = None
    early: list[tuple[int, str]] = field(default_factory=list)
    """Events before the first position."""
    text_id: int = 0

    def add(self, point: TrackPoint) -> None:
        points = self.track.points
        if points and 0 <= point.time_us - points[-1].time_us < INTERVAL_US:
            return
        points.append(point)
        for time_us, text in self.early:
            self.add_event(time_us, text)
        self.early.clear()

    def add_event(self, time_us: int, text: str) -> None:
        """Put an event at the vehicle's position."""
        if not self.track.points:
            if len(self.early) < MAX_MARKERS:
                self.early.append((time_us, text))
            return
        here = self.track.points[-1]
        at = TrackPoint(time_us, here.lat_deg, here.lon_deg, here.alt_amsl_m)
        if marked := _MARKED.fullmatch(text):
            lat_deg, lon_deg = map(float, marked.groups())
            at = TrackPoint(time_us, lat_deg, lon_deg, here.alt_amsl_m)
            self.put(MarkerKind.MARK, text, at)
        else:
            is_mark = text.startswith(REMARK)
            kind = MarkerKind.MARK if is_mark else MarkerKind.EVENT
            self.put(kind, text.removeprefix(REMARK), at)

    def put(self, kind: MarkerKind, name: str, at: TrackPoint) -> None:
        if len(self.track.markers) < MAX_MARKERS:
            self.track.markers.append(MapMarker(kind, name, at))


def tracks_of_frames(records: Iterable[TlogRecord], system_id: int | None) -> list[VehicleTrack]:
    """Collect the tracks of the vehicles of a tlog."""
    drawn: dict[int, _Drawn] = {}
    stations: set[int] = set()
    for record in records:
        frame = frame_of(record.frame)
        system, component = frame.origin
        origin = system << 8 | component
        if frame.message_id == HEARTBEAT_ID and frame.is_station_heartbeat:
            stations.add(origin)
        if system_id in (None, system) and not is_station(origin, stations):
            one = drawn.setdefault(system, _Drawn(VehicleTrack(f"system {system}")))
            _take(one, record)
    return [one.track for _, one in sorted(drawn.items()) if one.track.points]


def _take(one: _Drawn, record: TlogRecord) -> None:
    message_id, time_us = message_id_of(record.frame), record.time_us
    if message_id not in _READ:
        return
    m = fields_of(record.frame)
    if message_id == ATTITUDE_ID:
        one.attitude_deg = _finite(m["roll"], m["pitch"], m["yaw"])
    elif message_id == ATTITUDE_QUATERNION_ID:
        one.attitude_deg = _angles((m["q1"], m["q2"], m["q3"], m["q4"]))
    elif message_id == GLOBAL_POSITION_INT_ID:
        if m["lat"] or m["lon"]:
            one.add(_point(time_us, m["lat"], m["lon"], m["alt"], one.attitude_deg))
    elif message_id == HOME_POSITION_ID:
        lat, lon = m["latitude"], m["longitude"]
        if (lat or lon) and one.home != (lat, lon):
            one.home = (lat, lon)
            one.put(MarkerKind.HOME, "Home", _point(time_us, lat, lon, m["altitude"], None))
    elif m["severity"] <= INFO:
        _take_text(one, m, time_us)


def _take_text(one: _Drawn, m: Mapping[str, Any], time_us: int) -> None:
    text, number = m["text"].split(b"\0", 1)[0].decode("ascii", "replace"), m["id"]
    if number and m["chunk_seq"]:
        markers = one.track.markers
        if number == one.text_id and markers and markers[-1].kind is MarkerKind.EVENT:
            last = markers.pop()
            markers.append(replace(last, name=last.name + text))
        return
    one.text_id = number
    one.add_event(time_us, text)


def tracks_of_table(table: RecordedTable, aircraft: AircraftSettings) -> list[VehicleTrack]:
    """Collect the track of a table's aircraft: fused, or its fixes if it has no states."""
    zero_us = table.header.unix_us_at_zero or 0
    one = _Drawn(VehicleTrack(f"aircraft {table.header.vehicle_id}"))
    has_home = False
    for row in table.rows:
        if isinstance(row, TableMark):
            one.add_event(zero_us + row.time_us, REMARK + row.text)
        elif isinstance(row, FusionState) and row.home is not None and not has_home:
            lat_deg, lon_deg, alt_m, since_us = row.home
            at = TrackPoint(zero_us + since_us, lat_deg, lon_deg, alt_m)
            one.put(MarkerKind.HOME, "Home", at)
            has_home = True
        elif isinstance(row, TableRow):
            if not has_home and row.gps is not None:
                limits = aircraft.vehicle
                has_home = is_good_enough(row.gps, limits.home_accuracy_m, limits.home_satellites)
                if has_home:
                    one.put(MarkerKind.HOME, "Home", _point_of_fix(row.gps, zero_us))
            if (point := _point_of(row, zero_us)) is not None:
                one.add(point)
    return [one.track] if one.track.points else []


def _point_of(row: TableRow, zero_us: int) -> TrackPoint | None:
    state, fix = row.state, row.gps
    if state is not None and NavFlags.POSITION_VALID in state.flags:
        attitude_deg = _angles(state.q_nb) if NavFlags.ATTITUDE_VALID in state.flags else None
        position = (state.lat_deg, state.lon_deg, state.alt_amsl_m)
        return TrackPoint(zero_us + row.time_us, *position, attitude_deg)
    if state is None and fix is not None and fix.fix_ok:
        return _point_of_fix(fix, zero_us)
    return None


def _point_of_fix(fix: GpsFix, zero_us: int) -> TrackPoint:
    lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
    return TrackPoint(zero_us + fix.time_us, lat_deg, lon_deg, fix.alt_amsl_m)


def _point(
    time_us: int, lat: int, lon: int, alt: int, attitude: tuple[float, float, float] | None
) -> TrackPoint:
    position = (lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, alt * M_PER_MM)
    return TrackPoint(time_us, *position, attitude)


def _angles(q_nb: Quat) -> tuple[float, float, float] | None:
    return _finite(*to_euler(q_nb)) if math.isfinite(sum(q_nb)) and any(q_nb) else None


def _finite(roll: float, pitch: float, yaw: float) -> tuple[float, float, float] | None:
    """Convert angles in rad to degrees; None if one of them is not known."""
    if not math.isfinite(roll + pitch + yaw):
        return None
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)
