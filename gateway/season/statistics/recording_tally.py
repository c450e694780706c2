"""The flights of one recording, computed from its bytes without reading all of them."""

import struct
from collections.abc import Iterable
from hashlib import sha256
from typing import Final

import msgspec
import numpy as np

from gateway.recordings.answers import is_station
from gateway.recordings.columns import TableRow
from gateway.recordings.summary import (
    GLOBAL_POSITION_INT_ID,
    HEARTBEAT_ID,
    STEP_US,
    TimesSpan,
)
from gateway.recordings.table import TableEvent, TableFault, TableHeader, TableReader
from gateway.recordings.tlog import Batch, TlogIndex, payload_of
from gateway.records import NavFlags, NodeStatus
from gateway.season.statistics.flight_facts import FlightFacts, FlightTally, began_text, lost_share
from gateway.season.statistics.track_shape import Place
from gateway.units import DEG_PER_DEGE7, M_PER_MM, US_PER_S

SYS_STATUS_ID: Final = 1
PARAM_VALUE_ID: Final = 22
GPS_RAW_INT_ID: Final = 24
AUTOPILOT_VERSION_ID: Final = 148
STATUSTEXT_ID: Final = 253
LOOKED_AT: Final = np.array(
    [
        HEARTBEAT_ID, SYS_STATUS_ID, PARAM_VALUE_ID, GPS_RAW_INT_ID, GLOBAL_POSITION_INT_ID,
        AUTOPILOT_VERSION_ID, STATUSTEXT_ID,
    ]
)  # fmt: skip
ERROR: Final = 3
"""MAV_SEVERITY_ERROR; what is less is worse."""
FIX_2D: Final = 2

_POSITION: Final = struct.Struct("<Iiiiihh")
_DROP_RATE: Final = struct.Struct("<18xH")
"""SYS_STATUS: hundredths of a percent."""
_FIX_TYPE: Final = struct.Struct("<28xB")
_FIRMWARE: Final = struct.Struct("<16xI")
_PARAMETER: Final = struct.Struct("<4s4x16s")
CHECKSUM_DIGITS: Final = 12

Flown = tuple[FlightFacts, list[Place]]
"""What is known of a flight, and its track."""


class RowsTally:
    """Sums up a table, or the rows that another format was read as."""

    def __init__(self) -> None:
        self._tally, self._states = FlightTally(), FlightTally()
        self._span = TimesSpan()
        self._last_us = 0
        self._nodes: dict[int, NodeStatus] = {}

    def add_time(self, time_us: int) -> None:
        """Take in that there is a row of this time."""
        self._span.add(time_us)
        self._last_us = max(time_us, self._last_us)

    def add(self, row: TableRow) -> None:
        """Take a whole row in: its fix, and its state."""
        fix, state = row.gps, row.state
        if fix is not None:
            self._tally.add_gps(fix.time_us, fixed=fix.fix_ok)
            if fix.fix_ok:
                place = (fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7)
                speed_mps = float(np.hypot(*fix.vel_n_mps[:2]))
                self._tally.add_position(fix.time_us, (*place, fix.alt_amsl_m), speed_mps)
        if state is not None and NavFlags.POSITION_VALID in state.flags:
            speed_mps = float(np.hypot(*state.vel_n_mps[:2]))
            place3 = (state.lat_deg, state.lon_deg, state.alt_amsl_m)
            self._states.add_position(row.time_us, place3, speed_mps)

    def add_status(self, status: NodeStatus) -> None:
        """Count what a node reports as failed since its last report."""
        before = self._nodes.get(status.node.node_id)
        errors, failed = (before.bus_errors, before.sensors_failed) if before else (0, 0)
        # A restart sets the counter back.
        self._tally.faults += max(status.bus_errors - errors, 0)
        self._tally.faults += (status.sensors_failed & ~failed).bit_count()
        self._nodes[status.node.node_id] = status

    def flown(self, header: TableHeader | None, node_us: list[int], damaged: int) -> list[Flown]:
        """Return the one flight of the table; none if it holds no row."""
        first_us = self._span.first_us
        if first_us is None:
            return []
        self._tally.prefer_positions_of(self._states)
        head = header or TableHeader()
        zero_us = head.unix_us_at_zero
        known = msgspec.structs.replace(
            self._tally.facts(self._last_us),
            vehicle=head.vehicle_id,
            began=began_text(None if zero_us is None else zero_us + first_us),
            duration=self._span.length_us / US_PER_S,
            loss=lost_share(np.array(node_us, np.int64)),
            damaged=damaged,
            version=head.mavgate_version or None,
            settings=_checksum(head),
        )
        return [(known, self._tally.track())]


class TableSkimmer:
    """Sums up a table from its bytes: of most rows it reads the times alone."""

    def __init__(self) -> None:
        self._tally, self._reader = RowsTally(), TableReader()
        self._rest = b""
        self._node_us: list[int] = []
        self._damaged = 0
        self._places: tuple[int, int, int, int] | None = None
        """Where the time, the node's time, the fix and the state stand in a row."""
        self._state_us = 0
        """Time of the next state that is read."""

    def feed(self, data: bytes) -> None:
        """Take the next chunk of the file."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            if line.startswith(b"#") or self._places is None:
                self._read(line)
                if line.startswith(b"time_us") or b",time_us" in line:
                    self._find_places(line)
            elif line.strip():
                self._skim(line)

    def flown(self) -> list[Flown]:
        """Return the one flight of the table, once all of it was fed."""
        return self._tally.flown(
            self._reader.header, self._node_us, self._damaged + len(self._rest)
        )

    def _find_places(self, line: bytes) -> None:
        if self._places is not None or line.startswith(b"#"):
            return
        names = line.decode(errors="replace").strip().split(",")
        wanted = ("time_us", "node_time_us", "gps_time_us", "nav_time_us")
        time, node, gps, nav = (names.index(n) if n in names else -1 for n in wanted)
        self._places = (time, node, gps, nav)

    def _skim(self, line: bytes) -> None:
        assert self._places is not None
        time, node, gps, nav = self._places
        cells = line.split(b",")
        try:
            time_us = int(cells[time])
            node_us = int(cells[node]) if node >= 0 and cells[node] else None
            # Of a row without its end the cells behind it are missing.
            has_fix, has_state = (at >= 0 and bool(cells[at]) for at in (gps, nav))
        except (ValueError, IndexError):
            self._damaged += len(line) + 1
            return
        if node_us is not None:
            self._node_us.append(node_us)
        self._tally.add_time(time_us)
        if has_fix or (has_state and time_us >= self._state_us):
            self._read(line)

    def _read(self, line: bytes) -> None:
        for event in self._reader.feed(line + b"\n"):
            self._take(event)

    def _take(self, event: TableEvent) -> None:
        match event:
            case TableRow():
                self._tally.add(event)
                state = event.state
                is_placed = state is not None and NavFlags.POSITION_VALID in state.flags
                if is_placed and event.time_us >= self._state_us:
                    self._state_us = event.time_us + STEP_US
            case NodeStatus():
                self._tally.add_status(event)
            case TableFault(is_cut=False):
                self._damaged += event.size


def tally_rows(rows: Iterable[TableRow], header: TableHeader) -> list[Flown]:
    """Sum up a flight of another format from its rows."""
    tally = RowsTally()
    for row in rows:
        tally.add_time(row.time_us)
        tally.add(row)
    plain = msgspec.structs.replace(header, mavgate_version="", settings={}, calibration={})
    return tally.flown(plain, [], 0)


class TlogTally:
    """Sums up a tlog batch by batch, a flight a vehicle."""

    def __init__(self) -> None:
        self._index, self._span = TlogIndex(), TimesSpan()
        self._vehicles: dict[int, _Told] = {}

    def add(self, batch: Batch) -> None:
        """Take in the next batch of the file."""
        self._index.add(batch)
        if len(batch):
            self._span.add_all(batch.time_us)
        for i in np.flatnonzero(np.isin(batch.message_ids, LOOKED_AT)).tolist():
            origin = int(batch.origins[i])
            if is_station(origin, self._index.stations):
                continue
            told = self._vehicles.setdefault(origin >> 8, _Told())
            time_us = int(batch.time_us[i])
            told.see(time_us)
            told.take(int(batch.message_ids[i]), time_us, batch.frame(i))

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
            told.flown(system, index.damaged_bytes)
            for system, told in sorted(self._vehicles.items())
        ]


class _Told:
    """What one vehicle sent."""

    def __init__(self) -> None:
        self._tally = FlightTally()
        self._span = TimesSpan()
        self._last_us = 0
        self._drops: list[int] = []
        self._firmware: str | None = None
        self._parameters: dict[bytes, bytes] = {}

    def see(self, time_us: int) -> None:
        self._span.add(time_us)
        self._last_us = max(time_us, self._last_us)

    def take(self, message_id: int, time_us: int, frame: bytes) -> None:
        if message_id == GLOBAL_POSITION_INT_ID:
            _, lat, lon, alt, _, north, east = _POSITION.unpack(payload_of(frame, _POSITION.size))
            if lat or lon:
                place = (lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, alt * M_PER_MM)
                self._tally.add_position(time_us, place, float(np.hypot(north, east)) / 100.0)
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
        told = sorted(self._parameters.items())
        known = msgspec.structs.replace(
            self._tally.facts(self._last_us),
            vehicle=system_id,
            began=began_text(self._span.first_us),
            duration=self._span.length_us / US_PER_S,
            loss=float(np.mean(drops)) / 10_000.0 if drops else None,
            damaged=damaged,
            version=self._firmware,
            settings=_digits(b"".join(name + value for name, value in told)) if told else None,
        )
        return known, self._tally.track()


def _checksum(header: TableHeader) -> str | None:
    if not header.settings:
        return None
    # Sorted, so that a version that writes its sections in another order changes nothing.
    return _digits(msgspec.json.encode([header.settings, header.calibration], order="sorted"))


def _digits(data: bytes) -> str:
    return sha256(data).hexdigest()[:CHECKSUM_DIGITS]
