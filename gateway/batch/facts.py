"""Facts of one flight for the catalogue, computed from its recording in one pass."""

import math
import struct
from collections.abc import Iterable, Sequence
from hashlib import sha256
from itertools import chain
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.analysis.flight import LocalFrame
from gateway.analysis.pilot_figures import AIRBORNE_M, AIRBORNE_MPS
from gateway.answers.log_answers import AUTOPILOT_VERSION_ID, PARAM_VALUE_ID
from gateway.geometry.angle import wrap_180
from gateway.recordings.columns import (
    COLUMNS,
    GPS,
    GPS_CODEC,
    NODE_TIME,
    RAW,
    FloatArray,
    has_fix,
    has_group,
    has_position,
)
from gateway.recordings.figures import gps_outages_us, lost_share
from gateway.recordings.formats.maps import point_of_fix
from gateway.recordings.moment import civil_time
from gateway.recordings.summary import TimesSpan
from gateway.recordings.table import TableBlock, TableFault, TableHeader
from gateway.recordings.tlog_index import TlogIndex
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.records import NodeStatus
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import FIX_2D, GPS_IDS, Continuity, GroundDistance, TrackPoint
from gateway.vehicle_state.senders import RecordedSender, Senders
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.recorded_frames import Batch

TOLERANCE_M: Final = 3.0
"""Tolerance of a simplified track, less than the error of GPS."""
MAX_POSITIONS: Final = 400
"""Maximum positions of a track: a day of circling gets a coarser track, not a larger one."""

Segments = list[list[TrackPoint]]
"""The uninterrupted parts of a track."""
POINT_US: Final = US_PER_S // 10
"""Minimum interval of positions; closer ones add no information on a flight."""
EARLIEST_US: Final = 315_532_800 * US_PER_S
"""1980, the start of GPS time; an earlier time counts from the start of a clock."""
SYS_STATUS_ID: Final = MESSAGE_IDS["SYS_STATUS"]
USED_IDS: Final = frozenset({SYS_STATUS_ID, PARAM_VALUE_ID, AUTOPILOT_VERSION_ID, *GPS_IDS})
ERROR: Final = 3
"""MAV_SEVERITY_ERROR; lower numbers are more severe."""
CHECKSUM_DIGITS: Final = 12
_POSITION_AND_SPEED: Final = [
    *(COLUMNS.index(name) for name in ("time_us", "nav_lat_deg", "nav_lon_deg", "nav_alt_amsl_m")),
    *(COLUMNS.index(name) for name in ("nav_vel_north_mps", "nav_vel_east_mps")),
]


def simplified(points: Sequence[TrackPoint]) -> list[TrackPoint]:
    """Leave out points that are within a tolerance of the straight lines between the others."""
    if len(points) < 3:
        return list(points)
    lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points]).T
    frame = LocalFrame(points[0].lat_deg, points[0].lon_deg, 0.0)
    plane, tolerance_m = frame.local_m(lat_deg, lon_deg), TOLERANCE_M
    while np.count_nonzero(kept := _kept(plane, tolerance_m)) > MAX_POSITIONS:
        tolerance_m *= 2.0
    return [point for point, keep in zip(points, kept.tolist(), strict=True) if keep]


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
    """Return the distances from the line segment between two points."""
    line = end - begin
    length2 = float(line @ line)
    share = ((points - begin) @ line / length2).clip(0.0, 1.0) if length2 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - begin - share[:, np.newaxis] * line, axis=1))


class FlightFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts of one flight in the catalogue; None is unknown.

    The names are also the names of columns that a query can use.
    """

    vehicle: int | None = None
    """MAVLink system id."""
    began: str | None = None
    """Start in UTC, as YYYY-MM-DD HH:MM:SS."""
    duration: float | None = None
    """Time from the first record to the last, s."""
    distance: float | None = None
    """Distance over ground, m."""
    highest: float | None = None
    """Greatest height above the first position, m."""
    fastest: float | None = None
    """Greatest speed over ground, m/s."""
    lat_min: float | None = None
    """Southern limit, deg."""
    lat_max: float | None = None
    """Northern limit, deg."""
    lon_min: float | None = None
    """Western limit, deg."""
    lon_max: float | None = None
    """Eastern limit, deg; less than lon_min across the date line."""
    takeoff_lat: float | None = None
    """Latitude of the take-off, deg."""
    takeoff_lon: float | None = None
    """Longitude of the take-off, deg."""
    gps_outages: int | None = None
    """Number of GPS outages."""
    gps_lost: float | None = None
    """Total duration of the GPS outages, s."""
    faults: int | None = None
    """Number of bus errors and failed sensors of nodes, and of texts of severity ERROR or worse."""
    loss: float | None = None
    """Proportion of samples lost on the radio link, 0 to 1."""
    damaged: int | None = None
    """Number of damaged bytes in the file."""
    version: str | None = None
    """Version of mavgate, or of the autopilot's firmware."""
    settings: str | None = None
    """Checksum of settings and calibration."""


class FlightTally:
    """Collect the facts of one vehicle while its recording is read."""

    def __init__(self) -> None:
        self.distance = GroundDistance()
        self.segments: Segments = []
        self.speeds_mps: list[float] = []
        self._continuity = Continuity()
        self._newest_us = -POINT_US
        self._gps_us: list[int] = []
        self._fixed: list[bool] = []
        self.faults = 0

    def add_position(self, point: TrackPoint, speed_mps: float, boot_us: int | None = None) -> None:
        """Add a position with the speed over ground; see `Continuity`."""
        at = (point.time_us, point.lat_deg, point.lon_deg)
        self.distance.update(*at, boot_us)
        if self.segments and 0 <= point.time_us - self._newest_us < POINT_US:
            return
        self._newest_us = point.time_us
        if self._continuity.is_broken_at(*at, boot_us) or not self.segments:
            self.segments.append([])
        self.segments[-1].append(point)
        self.speeds_mps.append(speed_mps)

    def prefer_positions_of(self, other: "FlightTally") -> None:
        """Use the positions of another tally, if it has any."""
        if other.segments:
            self.segments, self.speeds_mps = other.segments, other.speeds_mps
            self.distance = other.distance

    def add_gps(self, time_us: int, *, fixed: bool) -> None:
        """Add a report of the receiver, and whether it has a fix."""
        self._gps_us.append(time_us)
        self._fixed.append(fixed)

    def facts(self, end_us: int | None) -> FlightFacts:
        """Return the facts that depend only on positions and fixes."""
        outages = gps_outages_us(np.array(self._gps_us), np.array(self._fixed, bool), end_us or 0)
        known = FlightFacts(faults=self.faults)
        if outages is not None:
            lost_s = sum(end - begin for begin, end in outages) / US_PER_S
            known = msgspec.structs.replace(known, gps_outages=len(outages), gps_lost=lost_s)
        if not self.segments:
            return known
        points = chain.from_iterable(self.segments)
        lat, lon, alt = np.array([(p.lat_deg, p.lon_deg, p.alt_amsl_m) for p in points]).T
        speed = np.array(self.speeds_mps)
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

    def track(self) -> Segments:
        """Return the simplified track."""
        return [*map(simplified, self.segments)]


def began_text(unix_us: int | None) -> str | None:
    """Return a civil time in the form of the catalogue; None if it is out of range."""
    moment = None if unix_us is None or unix_us < EARLIEST_US else civil_time(unix_us)
    return None if moment is None else f"{moment:%Y-%m-%d %H:%M:%S}"


def _greatest(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def _longitudes(lon_deg: NDArray[np.float64]) -> tuple[float, float]:
    """Return the western and the eastern limit, in the shorter direction."""
    turned = lon_deg[0] + wrap_180(lon_deg - lon_deg[0])
    west, east = float(turned.min()), float(turned.max())
    return (wrap_180(west), wrap_180(east))


Flown = tuple[FlightFacts, Segments]
"""The facts of a flight, and its track."""


class TableTally:
    """Sum up a table, or rows that were read from another format."""

    def __init__(self) -> None:
        self._fixes, self._states = FlightTally(), FlightTally()
        self._span = TimesSpan()
        self._last_us = 0
        self._node_us: list[FloatArray] = []
        self._damaged = 0
        self._nodes: dict[int, NodeStatus] = {}

    def add(self, block: TableBlock) -> None:
        """Add the next block of the file."""
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
        for fix in map(GPS_CODEC.read, cells[has_fix(cells), GPS].tolist()):
            self._fixes.add_position(point_of_fix(fix), math.hypot(*fix.vel_n_mps[:2]))
        placed = cells[has_position(cells)]
        for time_us, *position, north, east in placed[:, _POSITION_AND_SPEED].tolist():
            point = TrackPoint(int(time_us), *position)
            self._states.add_position(point, math.hypot(north, east))

    def _add_status(self, status: NodeStatus) -> None:
        """Count the failures of a node since its last report."""
        before = self._nodes.get(status.node.node_id)
        errors, failed = (before.bus_errors, before.sensors_failed) if before else (0, 0)
        # A restart of the node resets the counter.
        self._fixes.faults += max(status.bus_errors - errors, 0)
        self._fixes.faults += (status.sensors_failed & ~failed).bit_count()
        self._nodes[status.node.node_id] = status

    def flown(self, header: TableHeader | None) -> list[Flown]:
        """Return the table's only flight; empty if it contains no row."""
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
    """Sum up a tlog batch by batch, with one flight per vehicle."""

    def __init__(self, senders: Senders) -> None:
        self._index, self._span = TlogIndex(), TimesSpan()
        self._reader = VehicleReader(senders, USED_IDS, with_attitude=False)
        self._senders = senders
        self._vehicles = {system: _Sent(senders.vehicle(system)) for system in senders.systems()}

    def add(self, batch: Batch) -> None:
        """Add the next batch of the file."""
        self._index.add(batch)
        if not len(batch):
            return
        self._span.add_all(batch.time_us)
        for system, sent in self._vehicles.items():
            own = batch.time_us[batch.origins >> 8 == system]
            if len(own):
                sent.span.add_all(own)
        self._update(self._reader.feed_batch(batch))

    def _update(self, messages: Iterable[VehicleMessage]) -> None:
        for message in messages:
            if (sent := self._vehicles.get(message.system_id)) is not None:
                sent.update(message)

    def flown(self) -> list[Flown]:
        """Return a flight for each vehicle, or one without a vehicle if there is none."""
        index = self._index
        self._update(self._reader.flush())
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
    """Facts of one vehicle from its messages."""

    def __init__(self, vehicle: RecordedSender) -> None:
        self.span = TimesSpan()
        self._tally = FlightTally()
        first, _ = GPS_IDS
        self._gps_id = vehicle.position_id if vehicle.position_id in GPS_IDS else first
        self._drops: list[int] = []
        self._firmware: str | None = None
        self._parameters: dict[bytes, bytes] = {}

    def update(self, message: VehicleMessage) -> None:
        m, at = message.fields, message.position
        if at is not None:
            point = TrackPoint(message.time_us, at.lat_deg, at.lon_deg, at.alt_amsl_m)
            self._tally.add_position(point, at.groundspeed_mps, message.boot_us)
        if message.text is not None:
            self._tally.faults += message.text.severity <= ERROR
        elif message.message_id == self._gps_id:
            self._tally.add_gps(message.time_us, fixed=m["fix_type"] >= FIX_2D)
        elif message.message_id == SYS_STATUS_ID:
            self._drops.append(m["drop_rate_comm"])
        elif message.message_id == AUTOPILOT_VERSION_ID:
            version = m["flight_sw_version"]
            self._firmware = ".".join(str(version >> shift & 0xFF) for shift in (24, 16, 8))
        elif message.message_id == PARAM_VALUE_ID:
            self._parameters[m["param_id"].ljust(16, b"\0")] = struct.pack("<f", m["param_value"])

    def flown(self, system_id: int, damaged: int) -> Flown:
        drops = [drop for drop in self._drops if drop <= 10_000]
        sent = sorted(self._parameters.items())
        known = msgspec.structs.replace(
            self._tally.facts(self.span.last_us),
            vehicle=system_id,
            began=began_text(self.span.first_us),
            duration=self.span.length_us / US_PER_S,
            loss=float(np.mean(drops)) / 10_000.0 if drops else None,
            damaged=damaged,
            version=self._firmware,
            settings=_digits(b"".join(name + value for name, value in sent)) if sent else None,
        )
        return known, self._tally.track()


def _checksum(header: TableHeader) -> str | None:
    if not header.settings:
        return None
    # Sorted, so that the order of the sections has no effect.
    return _digits(msgspec.json.encode([header.settings, header.calibration], order="sorted"))


def _digits(data: bytes) -> str:
    return sha256(data).hexdigest()[:CHECKSUM_DIGITS]
