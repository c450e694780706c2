"""Recordings as streams for the commands: rows to fuse, frames to send, points to draw."""

import heapq
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Final, Literal, TypeVar

import msgspec

from gateway.edges.flight_files import (
    FileKind,
    Progress,
    kind_of,
    read_batches,
    read_chunks,
    read_events,
)
from gateway.flightlog.autopilot import AutopilotReader
from gateway.flightlog.foreign import ColumnMap, ForeignReader
from gateway.flightlog.mapshape import TrackPoint
from gateway.flightlog.row import RowBuilder, TableRow
from gateway.flightlog.stamps import Stamper
from gateway.flightlog.summary import payload_of
from gateway.flightlog.table import TableHeader, TableReader
from gateway.flightlog.tlog import TlogRecord
from gateway.pipeline import AircraftSettings, Pipeline, PipelineSettings
from gateway.records import (
    BaroRaw,
    FusedSample,
    GpsFix,
    ImuCalibrated,
    ImuRaw,
    NavFlags,
    NavState,
    Outgoing,
)
from gateway.replay import InterpolatedPosition, Replay, header_for, settings_of
from gateway.sensing.calibration import NodeCalibration
from gateway.units import DEG_PER_DEGE7, M_PER_MM
from gateway.wire.mavlink_splitter import message_id_of, origin_of

GLOBAL_POSITION_INT_ID: Final = 33
TRACKER_LOG: Final = files("gateway.cli") / "tracker-log.toml"
"""The map for logs whose columns are time_s, ax, gx and so on."""
_POSITION: Final = struct.Struct("<Iiii")

Position = Literal["causal", "interpolated"]
SettingsChoice = Literal["recorded", "current"]


Moved = TypeVar("Moved", BaroRaw, GpsFix, ImuRaw, ImuCalibrated, NavState)


Line = TableRow | TableHeader


class FlightError(Exception):
    """A file that does not hold what a command needs; the text says what and where."""


@dataclass(frozen=True, slots=True)
class Wishes:
    """How a command wants its flights."""

    current: PipelineSettings
    """The settings of today."""
    choice: SettingsChoice = "recorded"
    """Whose settings a table is fused with; those of today where it has none of its own."""
    position: Position = "causal"
    columns: ColumnMap | None = None
    """For a CSV that is not ours; by default those of a tracker log."""
    system_id: int | None = None
    """The vehicle of a tlog to take."""
    progress: Progress | None = None


@dataclass(slots=True)
class Table:
    """Rows with the head that belongs to them."""

    header: TableHeader
    rows: Iterator[Line]
    """A header among them tells of settings that were changed in flight."""

    @property
    def plain_rows(self) -> Iterator[TableRow]:
        """The rows alone."""
        return (row for row in self.rows if isinstance(row, TableRow))


def open_rows(path: Path, wishes: Wishes) -> Table:
    """Open any file that holds a flight as a table.

    Parameters
    ----------
    path : Path
        A table, a foreign CSV, or an autopilot's tlog.
    wishes : Wishes
        Column map, vehicle, settings.

    Returns
    -------
    Table
        The head is complete, the rows come as they are read.

    Raises
    ------
    FlightError
        If it holds no flight that can be read.
    OSError
        If it cannot be read at all.
    """
    match kind_of(path):
        case FileKind.TABLE:
            return _open_table(path, wishes)
        case FileKind.FOREIGN:
            return _open_foreign(path, wishes)
        case FileKind.TLOG:
            return _open_autopilot(path, wishes)


def fuse(table: Table, wishes: Wishes, fixes: Iterable[GpsFix] = ()) -> Replay:
    """Make a replay with the settings that the wishes name, for one table."""
    aircraft, correct = aircraft_of(table, wishes), None
    if wishes.position == "interpolated":
        latency_s = aircraft.estimation.reference.gps_latency_s
        correct = InterpolatedPosition(fixes, latency_s)
    zero_us = table.header.unix_us_at_zero or 0
    pipeline = Pipeline(PipelineSettings(aircraft, {}, zero_us, correct))
    return Replay(pipeline, follow=wishes.choice == "recorded")


def aircraft_of(table: Table, wishes: Wishes) -> AircraftSettings:
    """Choose the settings for one table: its own, or those of today."""
    if wishes.choice == "current" or not table.header.settings:
        return wishes.current.aircraft.get(table.header.vehicle_id, wishes.current.default)
    try:
        return settings_of(table.header)
    except msgspec.ValidationError as error:
        raise FlightError(
            f"the recorded settings are of another version ({error}); "
            "use the current ones: --settings current"
        ) from error


def fixes_of(path: Path, wishes: Wishes) -> list[GpsFix]:
    """List all fixes of a flight; a few per second, so hours of them fit the memory."""
    quiet = replace(wishes, progress=None)
    return [row.gps for row in open_rows(path, quiet).plain_rows if row.gps is not None]


def fused_rows(table: Table, replay: Replay) -> Iterator[Line]:
    """Fuse a table and yield its rows with the new states."""
    builder = RowBuilder()
    for row in table.rows:
        if isinstance(row, TableHeader):
            yield from builder.flush()
            yield row
        for _, action in replay.take(row):
            if isinstance(action, FusedSample | BaroRaw | GpsFix):
                yield from builder.add(action)
    yield from builder.flush()


def fused_frames(table: Table, replay: Replay) -> Iterator[TlogRecord]:
    """Fuse a table and yield the MAVLink that the gateway would have sent."""
    stamper = Stamper(table.header.unix_us_at_zero or 0)
    for row in table.rows:
        for now_us, action in replay.take(row):
            if isinstance(action, Outgoing) and action.client_id is None:
                yield TlogRecord(stamper.stamp(now_us), action.frame)


def recorded_frames(paths: Iterable[Path], progress: Progress | None) -> Iterator[TlogRecord]:
    """Yield the records of tlogs, merged by time."""
    streams = [
        (record for batch in read_batches(path, progress) for record in batch.records())
        for path in paths
    ]
    return heapq.merge(*streams, key=lambda record: record.time_us)


def joined_rows(tables: list[Table]) -> Table:
    """Put tables behind one another on the clock of the first.

    Parts of one recording share a clock; other recordings are put in their place by civil time.
    """
    first = tables[0].header

    def rows() -> Iterator[Line]:
        for table in tables:
            header = table.header
            follows = header.session == first.session or not header.cold_start
            shift_us = 0
            if not follows and None not in (header.unix_us_at_zero, first.unix_us_at_zero):
                shift_us = (header.unix_us_at_zero or 0) - (first.unix_us_at_zero or 0)
            for row in table.rows:
                yield shifted(row, shift_us) if shift_us else row

    return Table(first, rows())


def shifted(row: Line, shift_us: int) -> Line:
    """Move a row and all its records in time."""
    if isinstance(row, TableHeader):
        return row
    return TableRow(
        row.time_us + shift_us,
        _moved(row.baro, shift_us),
        _moved(row.gps, shift_us),
        _moved(row.raw, shift_us),
        _moved(row.imu, shift_us),
        _moved(row.state, shift_us),
    )


def points_of_rows(table: Table) -> Iterator[TrackPoint]:
    """Yield the fused positions of a table; its fixes where it has no states."""
    zero_us = table.header.unix_us_at_zero or 0
    for row in table.plain_rows:
        state, fix = row.state, row.gps
        if state is not None and NavFlags.POSITION_VALID in state.flags:
            time_us = zero_us + row.time_us
            yield TrackPoint(time_us, state.lat_deg, state.lon_deg, state.alt_amsl_m)
        elif state is None and fix is not None and fix.fix_ok:
            lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
            yield TrackPoint(zero_us + fix.time_us, lat_deg, lon_deg, fix.alt_amsl_m)


def points_of_frames(records: Iterable[TlogRecord], system_id: int | None) -> Iterator[TrackPoint]:
    """Yield the positions that one vehicle told; the first that tells one by default."""
    for record in records:
        if message_id_of(record.frame) != GLOBAL_POSITION_INT_ID:
            continue
        sender = origin_of(record.frame)[0]
        system_id = sender if system_id is None else system_id
        _, lat, lon, alt = _POSITION.unpack(payload_of(record.frame, _POSITION.size))
        if sender == system_id and (lat or lon):
            yield TrackPoint(
                record.time_us, lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, alt * M_PER_MM
            )


def _moved(record: Moved | None, shift_us: int) -> Moved | None:
    return None if record is None else replace(record, time_us=record.time_us + shift_us)


def _lines(path: Path, progress: Progress | None) -> Iterator[str]:
    rest = b""
    for data in read_chunks(path, progress):
        *lines, rest = (rest + data).split(b"\n")
        yield from (line.decode(errors="replace") for line in lines)
    if rest:
        yield rest.decode(errors="replace")


def _open_table(path: Path, wishes: Wishes) -> Table:
    reader = TableReader()
    events = read_events(path, reader, wishes.progress)
    first = next((event for event in events if isinstance(event, TableRow)), None)
    if first is None:
        raise FlightError(f"{path}: holds no row")

    def rows() -> Iterator[Line]:
        yield first
        yield from (event for event in events if isinstance(event, TableRow | TableHeader))

    return Table(reader.header or TableHeader(), rows())


def _open_foreign(path: Path, wishes: Wishes) -> Table:
    vehicle_id, lines = wishes.system_id or 1, _lines(path, wishes.progress)
    known = wishes.columns or msgspec.toml.decode(TRACKER_LOG.read_bytes(), type=ColumnMap)
    rows = ForeignReader(known, vehicle_id, lenient=wishes.columns is None).rows(lines)
    try:
        first = next(rows, None)
    except ValueError as error:
        raise FlightError(f"{path}: {error}; tell what its columns are: --columns MAP") from error
    if first is None:
        raise FlightError(f"{path}: holds no row that can be read")
    return _headed(first, rows, wishes, vehicle_id, None)


def _open_autopilot(path: Path, wishes: Wishes) -> Table:
    reader, builder = AutopilotReader(wishes.system_id), RowBuilder()
    records = recorded_frames([path], wishes.progress)

    def rows() -> Iterator[TableRow]:
        for record in records:
            for imported in reader.feed(record.frame, record.time_us):
                yield from builder.add(imported)
        yield from builder.flush()

    stream = rows()
    first = next(stream, None)
    if first is None:
        raise FlightError(
            f"{path}: holds no HIGHRES_IMU, RAW_IMU or SCALED_IMU of a vehicle to fuse"
        )
    return _headed(first, stream, wishes, reader.system_id or 1, reader.unix_us_at_zero)


def _headed(
    first: TableRow,
    rest: Iterator[TableRow],
    wishes: Wishes,
    vehicle_id: int,
    unix_us_at_zero: int | None,
) -> Table:
    """Give rows of another program the head of a table, with the settings of today."""
    current = wishes.current.aircraft.get(vehicle_id, wishes.current.default)
    # Its values are calibrated already, whatever the calibration of the aircraft of that number.
    calibrated = msgspec.structs.replace(current, calibration=NodeCalibration())
    known = header_for(calibrated, vehicle_id)
    header = msgspec.structs.replace(known, unix_us_at_zero=unix_us_at_zero)

    def rows() -> Iterator[TableRow]:
        yield first
        yield from rest

    return Table(header, rows())
