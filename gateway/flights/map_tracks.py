"""A recording for maps: track, home, marks and events of each vehicle."""

import math
import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from gateway.aircraft import AircraftSettings
from gateway.flightlog.mapshape import MapPlace, PlaceKind, TrackPoint, VehicleTrack
from gateway.flightlog.summary import payload_of
from gateway.flightlog.table.row import TableRow
from gateway.flightlog.table.table import REMARK, TableMark
from gateway.flightlog.tlog.recorded_commands import is_station
from gateway.flightlog.tlog.tlog import TlogRecord
from gateway.flights.reading import RecordedTable
from gateway.geometry.quaternion import to_euler
from gateway.records import FusionState, NavFlags, Quat
from gateway.units import DEG_PER_DEGE7, M_PER_MM, US_PER_S
from gateway.vehicle.home import is_good_enough, place_of
from gateway.wire.mavlink_splitter import is_station_heartbeat, message_id_of, origin_of

HEARTBEAT_ID: Final = 0
ATTITUDE_ID: Final = 30
ATTITUDE_QUATERNION_ID: Final = 31
GLOBAL_POSITION_INT_ID: Final = 33
HOME_POSITION_ID: Final = 242
STATUSTEXT_ID: Final = 253

_ATTITUDE: Final = struct.Struct("<Ifff")
_QUATERNION: Final = struct.Struct("<Iffff")
_POSITION: Final = struct.Struct("<Iiii")
_HOME: Final = struct.Struct("<iii")
_TEXT: Final = struct.Struct("<B50sHB")
"""STATUSTEXT: severity, text, and of a long one its number and which chunk of it."""
INFO: Final = 6
"""MAV_SEVERITY_INFO; what is less is for programmers."""
_MARKED: Final = re.compile(r"Marked (-?\d+\.\d+), (-?\d+\.\d+)")
"""The gateway's STATUSTEXT for a marked place."""
INTERVAL_US: Final = US_PER_S // 5
"""A map shows no more than five points a second."""
MAX_PLACES: Final = 10_000
"""Of one vehicle; a flood of texts must not fill the memory."""


@dataclass(slots=True)
class _Drawn:
    """One vehicle while its frames are read."""

    track: VehicleTrack
    attitude_deg: tuple[float, float, float] | None = None
    home: tuple[int, int] | None = None
    early: list[tuple[int, str]] = field(default_factory=list)
    """What happened before the first position."""
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
        """Place an event at the vehicle's position."""
        if not self.track.points:
            if len(self.early) < MAX_PLACES:
                self.early.append((time_us, text))
            return
        here = self.track.points[-1]
        at = TrackPoint(time_us, here.lat_deg, here.lon_deg, here.alt_amsl_m)
        if marked := _MARKED.fullmatch(text):
            lat_deg, lon_deg = map(float, marked.groups())
            at = TrackPoint(time_us, lat_deg, lon_deg, here.alt_amsl_m)
            self.put(PlaceKind.MARK, text, at)
        else:
            is_mark = text.startswith(REMARK)
            kind = PlaceKind.MARK if is_mark else PlaceKind.EVENT
            self.put(kind, text.removeprefix(REMARK), at)

    def put(self, kind: PlaceKind, name: str, at: TrackPoint) -> None:
        if len(self.track.places) < MAX_PLACES:
            self.track.places.append(MapPlace(kind, name, at))


def tracks_of_frames(records: Iterable[TlogRecord], system_id: int | None) -> list[VehicleTrack]:
    """Collect the tracks of the vehicles of a tlog.

    Parameters
    ----------
    records : iterable of TlogRecord
        In the order of their times.
    system_id : int or None
        The one vehicle to take; all by default.

    Returns
    -------
    list of VehicleTrack
        Of those that reported a position, by their ids.
    """
    drawn: dict[int, _Drawn] = {}
    stations: set[int] = set()
    for record in records:
        system, component = origin_of(record.frame)
        origin = system << 8 | component
        if message_id_of(record.frame) == HEARTBEAT_ID and is_station_heartbeat(record.frame):
            stations.add(origin)
        if system_id in (None, system) and not is_station(origin, stations):
            one = drawn.setdefault(system, _Drawn(VehicleTrack(f"system {system}")))
            _take(one, record)
    return [one.track for _, one in sorted(drawn.items()) if one.track.points]


def _take(one: _Drawn, record: TlogRecord) -> None:
    frame, time_us = record.frame, record.time_us
    message_id = message_id_of(frame)
    if message_id == ATTITUDE_ID:
        _, roll, pitch, yaw = _ATTITUDE.unpack(payload_of(frame, _ATTITUDE.size))
        one.attitude_deg = _finite(roll, pitch, yaw)
    elif message_id == ATTITUDE_QUATERNION_ID:
        _, w, x, y, z = _QUATERNION.unpack(payload_of(frame, _QUATERNION.size))
        one.attitude_deg = _angles((w, x, y, z))
    elif message_id == GLOBAL_POSITION_INT_ID:
        _, lat, lon, alt = _POSITION.unpack(payload_of(frame, _POSITION.size))
        if lat or lon:
            one.add(_point(time_us, lat, lon, alt, one.attitude_deg))
    elif message_id == HOME_POSITION_ID:
        lat, lon, alt = _HOME.unpack(payload_of(frame, _HOME.size))
        if (lat or lon) and one.home != (lat, lon):
            one.home = (lat, lon)
            one.put(PlaceKind.HOME, "Home", _point(time_us, lat, lon, alt, None))
    elif message_id == STATUSTEXT_ID:
        _take_text(one, frame, time_us)


def _take_text(one: _Drawn, frame: bytes, time_us: int) -> None:
    severity, raw, number, chunk = _TEXT.unpack(payload_of(frame, _TEXT.size))
    text = raw.split(b"\0", 1)[0].decode("ascii", "replace")
    if severity > INFO:
        return
    if number and chunk:
        places = one.track.places
        if number == one.text_id and places and places[-1].kind is PlaceKind.EVENT:
            last = places.pop()
            places.append(MapPlace(last.kind, last.name + text, last.at))
        return
    one.text_id = number
    one.add_event(time_us, text)


def tracks_of_table(table: RecordedTable, aircraft: AircraftSettings) -> list[VehicleTrack]:
    """Collect the track of a table's aircraft: fused, or its fixes if it has no states.

    Parameters
    ----------
    table : RecordedTable
        Its rows are used up.
    aircraft : AircraftSettings
        Settings of the fix that sets home if the table has no home.
    """
    zero_us = table.header.unix_us_at_zero or 0
    one = _Drawn(VehicleTrack(f"aircraft {table.header.vehicle_id}"))
    has_home = False
    for row in table.rows:
        if isinstance(row, TableMark):
            one.add_event(zero_us + row.time_us, REMARK + row.text)
        elif isinstance(row, FusionState) and row.home is not None and not has_home:
            lat_deg, lon_deg, alt_m, since_us = row.home
            at = TrackPoint(zero_us + since_us, lat_deg, lon_deg, alt_m)
            one.put(PlaceKind.HOME, "Home", at)
            has_home = True
        elif isinstance(row, TableRow):
            if not has_home and row.gps is not None:
                limits = aircraft.vehicle
                has_home = is_good_enough(row.gps, limits.home_accuracy_m, limits.home_satellites)
                if has_home:
                    place = place_of(row.gps)
                    at = TrackPoint(
                        zero_us + row.gps.time_us, place.lat_deg, place.lon_deg, place.alt_amsl_m
                    )
                    one.put(PlaceKind.HOME, "Home", at)
            if (point := _point_of(row, zero_us)) is not None:
                one.add(point)
    return [one.track] if one.track.points else []


def _point_of(row: TableRow, zero_us: int) -> TrackPoint | None:
    state, fix = row.state, row.gps
    if state is not None and NavFlags.POSITION_VALID in state.flags:
        attitude_deg = _angles(state.q_nb) if NavFlags.ATTITUDE_VALID in state.flags else None
        place = (state.lat_deg, state.lon_deg, state.alt_amsl_m)
        return TrackPoint(zero_us + row.time_us, *place, attitude_deg)
    if state is None and fix is not None and fix.fix_ok:
        lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
        return TrackPoint(zero_us + fix.time_us, lat_deg, lon_deg, fix.alt_amsl_m)
    return None


def _point(
    time_us: int, lat: int, lon: int, alt: int, attitude: tuple[float, float, float] | None
) -> TrackPoint:
    place = (lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, alt * M_PER_MM)
    return TrackPoint(time_us, *place, attitude)


def _angles(q_nb: Quat) -> tuple[float, float, float] | None:
    return _finite(*to_euler(q_nb)) if math.isfinite(sum(q_nb)) and any(q_nb) else None


def _finite(roll: float, pitch: float, yaw: float) -> tuple[float, float, float] | None:
    """Convert angles in rad to degrees; None if one of them is not known."""
    if not math.isfinite(roll + pitch + yaw):
        return None
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)
