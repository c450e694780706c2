"""Facts of one flight for the catalogue, computed from its recording in one pass."""

import math
import struct
from collections.abc import Mapping, Sequence
from hashlib import sha256
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.analysis.flight import LocalFrame
from gateway.analysis.pilot_figures import AIRBORNE_M, AIRBORNE_MPS, OUTAGE_S
from gateway.geometry.angle import wrap_180
from gateway.recordings.answers import AUTOPILOT_VERSION_ID, PARAM_VALUE_ID, is_station
from gateway.recordings.columns import (
    COLUMNS,
    GPS,
    GPS_CODEC,
    NODE_TIME,
    RAW,
    FloatArray,
    has_group,
    has_position,
)
from gateway.recordings.moment import civil_time
from gateway.recordings.summary import GLOBAL_POSITION_INT_ID, GroundDistance, TimesSpan
from gateway.recordings.table import TableBlock, TableFault, TableHeader
from gateway.recordings.tlog import DAY_US, HEARTBEAT_ID, Batch, TlogIndex, payload_of
from gateway.records import NodeStatus
from gateway.units import DEG_PER_DEGE7, M_PER_MM, US_PER_S

TOLERANCE_M: Final = 3.0
"""Less than the error of the GPS."""
MAX_POSITIONS: Final = 400
"""Of one track; a day in circles gets coarser instead of larger."""

Position = tuple[float, float, float]
"""Latitude and longitude in deg, height above mean sea level in m."""


def simplified(positions: Sequence[Position]) -> list[Position]:
    """Leave out positions that the straight lines between the others pass within a few metres."""
    if len(positions) < 3:
        return list(positions)
    lat_deg, lon_deg, _ = np.array(positions, np.float64).T
    plane, tolerance_m = LocalFrame(*positions[0]).local_m(lat_deg, lon_deg), TOLERANCE_M
    while np.count_nonzero(kept := _kept(plane, tolerance_m)) > MAX_POSITIONS:
        tolerance_m *= 2.0
    return [position for position, keep in zip(positions, kept.tolist(), strict=True) if keep]


def feature(positions: Sequence[Position], properties: Mapping[str, Any]) -> dict[str, Any]:
    """Write a track as a GeoJSON feature (RFC 7946); cut in two where it crosses 180 degrees."""
    lines: list[list[list[float]]] = [[]]
    for lat, lon, alt in positions:
        if lines[-1] and abs(lon - lines[-1][-1][0]) > 180.0:
            lines.append([])
        lines[-1].append([round(lon, 7), round(lat, 7), round(alt, 2)])
    lines = [line if len(line) > 1 else line * 2 for line in lines if line]
    return {
        "type": "Feature",
        "geometry": {"type": "MultiLineString", "coordinates": lines} if lines else None,
        "properties": dict(properties),
    }


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


POINT_US: Final = US_PER_S // 10
"""Positions nearer in time than this add nothing new of a flight."""
OUTAGE_STEPS: Final = 2.5
"""So many usual intervals without a fix are an outage, where fixes come seldom."""
EARLIEST_US: Final = 315_532_800 * US_PER_S
"""1980, when GPS began: an earlier time counts from the start of a clock."""
LOST_STEP: Final = 1.5
"""So many usual intervals between two samples are a loss."""


class FlightFacts(msgspec.Struct, frozen=True, kw_only=True):
    """One flight in the catalogue; None is unknown.

    The names are those of the columns that a query may use.
    """

    vehicle: int | None = None
    """MAVLink system id."""
    began: str | None = None
    """Begin, UTC: YYYY-MM-DD HH:MM:SS."""
    duration: float | None = None
    """From the first record to the last, s."""
    distance: float | None = None
    """Over ground, m."""
    highest: float | None = None
    """Above the first position, m."""
    fastest: float | None = None
    """Over ground, m/s."""
    lat_min: float | None = None
    """South end, deg."""
    lat_max: float | None = None
    """North end, deg."""
    lon_min: float | None = None
    """West end, deg."""
    lon_max: float | None = None
    """East end; below lon_min across 180 degrees, deg."""
    takeoff_lat: float | None = None
    """Where it left the ground, deg."""
    takeoff_lon: float | None = None
    """Where it left the ground, deg."""
    gps_outages: int | None = None
    """GPS outages."""
    gps_lost: float | None = None
    """All of them together, s."""
    faults: int | None = None
    """Bus errors and failed sensors of the nodes; texts of severity ERROR."""
    loss: float | None = None
    """Share of the samples lost on the radio, 0 to 1."""
    damaged: int | None = None
    """Damaged bytes of the file."""
    version: str | None = None
    """Of mavgate, or of the autopilot's firmware."""
    settings: str | None = None
    """Checksum of settings and calibration."""


UNITS: Final = {
    "duration": "s", "distance": "m", "highest": "m", "fastest": "m/s", "gps_lost": "s",
    **dict.fromkeys(("lat_min", "lat_max", "lon_min", "lon_max"), "deg"),
    "takeoff_lat": "deg", "takeoff_lon": "deg", "damaged": "bytes", "size": "bytes",
}  # fmt: skip
"""Of the columns that have one; `size` is that of the file."""


class FlightTally:
    """Collect the facts of one vehicle while its recording is read."""

    def __init__(self) -> None:
        self.distance = GroundDistance()
        self.points: list[tuple[int, float, float, float, float]] = []
        self._gps_us: list[int] = []
        self._fixed: list[bool] = []
        self.faults = 0

    def add_position(self, time_us: int, position: Position, speed_mps: float) -> None:
        """Take a position in: latitude and longitude in deg, height in m, ground speed in m/s."""
        self.distance.add(time_us, position[0], position[1])
        if self.points and 0 <= time_us - self.points[-1][0] < POINT_US:
            return
        self.points.append((time_us, *position, speed_mps))

    def prefer_positions_of(self, other: "FlightTally") -> None:
        """Use the positions of another tally, if it has any."""
        if other.points:
            self.points, self.distance = other.points, other.distance

    def add_gps(self, time_us: int, *, fixed: bool) -> None:
        """Note that the receiver sent something, and whether it had a fix."""
        self._gps_us.append(time_us)
        self._fixed.append(fixed)

    def facts(self, end_us: int | None) -> FlightFacts:
        """Sum up, with all that depends on positions and fixes alone."""
        outages, lost_s = self._outages(end_us)
        known = FlightFacts(gps_outages=outages, gps_lost=lost_s, faults=self.faults)
        if not self.points:
            return known
        points = np.array(self.points, np.float64)
        lat, lon, alt, speed = points[:, 1:].T
        height = alt - alt[0]
        west, east = _longitudes(lon)
        flying = np.flatnonzero((speed > AIRBORNE_MPS) & (height > AIRBORNE_M))
        takeoff = max(int(flying[0]) - 1, 0) if len(flying) else None
        return msgspec.structs.replace(
            known,
            distance=self.distance.distance_m,
            highest=_greatest(height),
            fastest=_greatest(speed),
            lat_min=float(lat.min()),
            lat_max=float(lat.max()),
            lon_min=west,
            lon_max=east,
            takeoff_lat=None if takeoff is None else float(lat[takeoff]),
            takeoff_lon=None if takeoff is None else float(lon[takeoff]),
        )

    def track(self) -> list[Position]:
        """Return the track in as few positions as show it."""
        return simplified([(lat, lon, alt) for _, lat, lon, alt, _ in self.points])

    def _outages(self, end_us: int | None) -> tuple[int | None, float | None]:
        times = np.array(self._gps_us, np.int64)
        fixed = times[np.array(self._fixed, np.bool_)]
        if not len(fixed):
            return None, None
        usual_s = float(np.median(np.diff(times))) / US_PER_S if len(times) > 1 else 0.0
        longest_s = max(OUTAGE_S, OUTAGE_STEPS * usual_s)
        last_us = max(end_us or 0, int(fixed[-1]))
        gaps_s = np.diff(np.append(fixed, last_us)) / US_PER_S
        # A clock that jumps by days is no gap.
        outages = gaps_s[(gaps_s > longest_s) & (gaps_s <= DAY_US / US_PER_S)]
        return len(outages), float(outages.sum())


def began_text(unix_us: int | None) -> str | None:
    """Write a civil time as the catalogue does; None if it can be none."""
    moment = None if unix_us is None or unix_us < EARLIEST_US else civil_time(unix_us)
    return None if moment is None else f"{moment:%Y-%m-%d %H:%M:%S}"


def lost_share(times_us: NDArray[np.int64]) -> float | None:
    """Estimate which share of samples is missing between those that came at a steady rate."""
    steps = np.diff(times_us)
    steps = steps[steps > 0]
    if not len(steps):
        return None
    counts = steps / np.median(steps)
    lost = float((np.rint(counts[counts > LOST_STEP]) - 1.0).sum())
    return lost / (lost + len(times_us))


def _greatest(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def _longitudes(lon_deg: NDArray[np.float64]) -> tuple[float, float]:
    """Return the west and the east end, the short way round."""
    turned = lon_deg[0] + wrap_180(lon_deg - lon_deg[0])
    west, east = float(turned.min()), float(turned.max())
    return (wrap_180(west), wrap_180(east))


SYS_STATUS_ID: Final = 1
GPS_RAW_INT_ID: Final = 24
STATUSTEXT_ID: Final = 253
USED_IDS: Final = np.array(
    [
        HEARTBEAT_ID, SYS_STATUS_ID, PARAM_VALUE_ID, GPS_RAW_INT_ID, GLOBAL_POSITION_INT_ID,
        AUTOPILOT_VERSION_ID, STATUSTEXT_ID,
    ]
)  # fmt: skip
ERROR: Final = 3
"""MAV_SEVERITY_ERROR; lower numbers are more severe."""
FIX_2D: Final = 2

_POSITION: Final = struct.Struct("<Iiiiihh")
_DROP_RATE: Final = struct.Struct("<18xH")
"""SYS_STATUS: hundredths of a percent."""
_FIX_TYPE: Final = struct.Struct("<28xB")
_FIRMWARE: Final = struct.Struct("<16xI")
_PARAMETER: Final = struct.Struct("<4s4x16s")
CHECKSUM_DIGITS: Final = 12

_POSITION_AND_SPEED: Final = [
    *(COLUMNS.index(name) for name in ("time_us", "nav_lat_deg", "nav_lon_deg", "nav_alt_amsl_m")),
    *(COLUMNS.index(name) for name in ("nav_vel_north_mps", "nav_vel_east_mps")),
]

Flown = tuple[FlightFacts, list[Position]]
"""The facts of a flight, and its track."""


class TableTally:
    """Sums up a table, or the rows that another format was read as."""

    def __init__(self) -> None:
        self._fixes, self._states = FlightTally(), FlightTally()
        self._span = TimesSpan()
        self._last_us = 0
        self._node_us: list[FloatArray] = []
        self._damaged = 0
        self._nodes: dict[int, NodeStatus] = {}

    def add(self, block: TableBlock) -> None:
        """Take in the next block of the file."""
        for _, comment in block.comments:
            if isinstance(comment, NodeStatus):
                self._add_status(comment)
            elif isinstance(comment, TableFault):
                self._damaged += comment.size
        cells = block.cells
        if not len(cells):
            return
        times_us = cells[:, 0].astype(np.int64)
        self._span.add_all(times_us)
        self._last_us = max(int(times_us.max()), self._last_us)
        self._node_us.append(cells[has_group(cells, RAW), NODE_TIME])
        for values in cells[has_group(cells, GPS), GPS].tolist():
            fix = GPS_CODEC.read(values)
            self._fixes.add_gps(fix.time_us, fixed=fix.fix_ok)
            if fix.fix_ok:
                position = (fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7)
                speed_mps = math.hypot(*fix.vel_n_mps[:2])
                self._fixes.add_position(fix.time_us, (*position, fix.alt_amsl_m), speed_mps)
        placed = cells[has_position(cells)]
        for time_us, *position, north, east in placed[:, _POSITION_AND_SPEED].tolist():
            self._states.add_position(int(time_us), tuple(position), math.hypot(north, east))

    def _add_status(self, status: NodeStatus) -> None:
        """Count the failures of a node since its last report."""
        before = self._nodes.get(status.node.node_id)
        errors, failed = (before.bus_errors, before.sensors_failed) if before else (0, 0)
        # A restart sets the counter back.
        self._fixes.faults += max(status.bus_errors - errors, 0)
        self._fixes.faults += (status.sensors_failed & ~failed).bit_count()
        self._nodes[status.node.node_id] = status

    def flown(self, header: TableHeader | None) -> list[Flown]:
        """Return the one flight of the table; none if it contains no row."""
        first_us = self._span.first_us
        if first_us is None:
            return []
        self._fixes.prefer_positions_of(self._states)
        head = header or TableHeader()
        zero_us = head.unix_us_at_zero
        known = msgspec.structs.replace(
            self._fixes.facts(self._last_us),
            vehicle=head.vehicle_id,
            began=began_text(None if zero_us is None else zero_us + first_us),
            duration=self._span.length_us / US_PER_S,
            loss=lost_share(np.concatenate(self._node_us).astype(np.int64)),
            damaged=self._damaged,
            version=head.mavgate_version or None,
            settings=_checksum(head),
        )
        return [(known, self._fixes.track())]


class TlogTally:
    """Sums up a tlog batch by batch, a flight a vehicle."""

    def __init__(self) -> None:
        self._index, self._span = TlogIndex(), TimesSpan()
        self._vehicles: dict[int, _Sent] = {}

    def add(self, batch: Batch) -> None:
        """Take in the next batch of the file."""
        self._index.add(batch)
        if len(batch):
            self._span.add_all(batch.time_us)
        for i in np.flatnonzero(np.isin(batch.message_ids, USED_IDS)).tolist():
            origin = int(batch.origins[i])
            if is_station(origin, self._index.stations):
                continue
            sent = self._vehicles.setdefault(origin >> 8, _Sent())
            time_us = int(batch.time_us[i])
            sent.update(int(batch.message_ids[i]), time_us, batch.frame(i))

    def flown(self) -> list[Flown]:
        """Return a flight for each vehicle; one without a vehicle where there is none."""
        index = self._index
        if not index.count:
            return []
        if not self._vehicles:
            known = FlightFacts(
                began=began_text(index.first_us),
                duration=self._span.length_us / US_PER_S,
                damaged=index.damaged_bytes,
            )
            return [(known, [])]
        return [
            sent.flown(system, index.damaged_bytes)
            for system, sent in sorted(self._vehicles.items())
        ]


class _Sent:
    """Facts of one vehicle from the messages that it sent."""

    def __init__(self) -> None:
        self._tally = FlightTally()
        self._span = TimesSpan()
        self._last_us = 0
        self._drops: list[int] = []
        self._firmware: str | None = None
        self._parameters: dict[bytes, bytes] = {}

    def update(self, message_id: int, time_us: int, frame: bytes) -> None:
        self._span.add(time_us)
        self._last_us = max(time_us, self._last_us)
        if message_id == GLOBAL_POSITION_INT_ID:
            _, lat, lon, alt, _, north, east = _POSITION.unpack(payload_of(frame, _POSITION.size))
            if lat or lon:
                position = (lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, alt * M_PER_MM)
                self._tally.add_position(time_us, position, float(np.hypot(north, east)) / 100.0)
        elif message_id == GPS_RAW_INT_ID:
            (fix_type,) = _FIX_TYPE.unpack(payload_of(frame, _FIX_TYPE.size))
            self._tally.add_gps(time_us, fixed=fix_type >= FIX_2D)
        elif message_id == SYS_STATUS_ID:
            self._drops += _DROP_RATE.unpack(payload_of(frame, _DROP_RATE.size))
        elif message_id == STATUSTEXT_ID:
            self._tally.faults += payload_of(frame, 1)[0] <= ERROR
        elif message_id == AUTOPILOT_VERSION_ID:
            (version,) = _FIRMWARE.unpack(payload_of(frame, _FIRMWARE.size))
            self._firmware = ".".join(str(version >> shift & 0xFF) for shift in (24, 16, 8))
        elif message_id == PARAM_VALUE_ID:
            value, name = _PARAMETER.unpack(payload_of(frame, _PARAMETER.size))
            self._parameters[name] = value

    def flown(self, system_id: int, damaged: int) -> Flown:
        drops = [drop for drop in self._drops if drop <= 10_000]
        sent = sorted(self._parameters.items())
        known = msgspec.structs.replace(
            self._tally.facts(self._last_us),
            vehicle=system_id,
            began=began_text(self._span.first_us),
            duration=self._span.length_us / US_PER_S,
            loss=float(np.mean(drops)) / 10_000.0 if drops else None,
            damaged=damaged,
            version=self._firmware,
            settings=_digits(b"".join(name + value for name, value in sent)) if sent else None,
        )
        return known, self._tally.track()


def _checksum(header: TableHeader) -> str | None:
    if not header.settings:
        return None
    # Sorted, so that a version that writes its sections in another order changes nothing.
    return _digits(msgspec.json.encode([header.settings, header.calibration], order="sorted"))


def _digits(data: bytes) -> str:
    return sha256(data).hexdigest()[:CHECKSUM_DIGITS]
