"""Open any recording as a table: the reader of its format, and the settings to fuse it with.

Readers that need large packages are imported with the first file of their format. Several tables
of one aircraft are joined, cut and moved in time.
"""

import codecs
import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from importlib.resources import files
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from gateway import __version__
from gateway.aircraft import AircraftSettings, migrate_sections
from gateway.extras import how_to_add
from gateway.pipeline import PipelineSettings
from gateway.recordings.autopilot_record import AutopilotLog
from gateway.recordings.columns import TIMES, BoolArray, TableRow
from gateway.recordings.files import (
    CSV,
    MAX_UNPACKED,
    OTHER_FORMATS,
    PARQUET,
    TABLE,
    TLOG,
    Estimates,
    FlightError,
    Position,
    Progress,
    SettingsChoice,
    TlogSource,
    encoding_of,
    format_of,
    open_tlog,
    read_blocks,
    read_chunks,
)
from gateway.recordings.formats.csv import ColumnMap, CsvReader
from gateway.recordings.formats.mavlink import AutopilotReader
from gateway.recordings.moment import Moment, time_us_of
from gateway.recordings.senders import FIRST_GROUND_STATION
from gateway.recordings.table import (
    BLOCK_ROWS,
    HEAD_LINES,
    MAX_LINE,
    NO_ROWS,
    TableBlock,
    TableComment,
    TableFault,
    TableHeader,
    TableMark,
    TableReader,
    block_of,
)
from gateway.recordings.tlog import JUMP_US, ORDER_US, TlogRecord
from gateway.records import FusionState, NodeStatus
from gateway.sensing.calibration import NodeCalibration
from gateway.toml_file import TomlError, read_toml
from gateway.units import counted

TRACKER_LOG: Final = files("gateway.recordings.formats") / "tracker-log.toml"
"""The map for logs whose columns are time_s, ax, gx and so on."""


Line = TableRow | TableHeader | TableMark | FusionState | NodeStatus


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read and fuse flights."""

    current: PipelineSettings
    """The settings of today."""
    choice: SettingsChoice = "recorded"
    """Settings to fuse a table with; the current ones if it has none."""
    position: Position = "causal"
    columns: ColumnMap | None = None
    """For a CSV that is not ours; by default those of a tracker log."""
    system_id: int | None = None
    """The vehicle of a tlog to take."""
    progress: Progress | None = None
    sensors: tuple[tuple[str, int], ...] = ()
    """Which of several sensors of a kind to take: ("GPS", 1) is the second."""
    unpacked_limit: int = MAX_UNPACKED
    """Maximum unpacked size of a packed file that is read as a whole, in bytes."""


@dataclass(slots=True)
class RecordedTable:
    """Rows with their head."""

    header: TableHeader
    blocks: Iterator[TableBlock]
    """A header among the rows is a change of settings in flight, a state is that of the fusion at
    this row, and a mark is a remark of the operator."""
    remarks: list[str] = field(default_factory=list)
    """Remarks about the file for the user; complete once the rows are read."""

    @property
    def rows(self) -> Iterator[Line]:
        """The same one by one, but for faults."""
        events = (e for block in self.blocks for e in block.events(self.header.vehicle_id))
        return (event for event in events if isinstance(event, Line))

    @property
    def plain_rows(self) -> Iterator[TableRow]:
        """The rows only."""
        return (row for row in self.rows if isinstance(row, TableRow))


Read = Callable[[Path, ReadOptions], RecordedTable]

READERS: dict[str, Read] = {}
"""By the name of the format."""


def add_reader(name: str, knows: Callable[[bytes], bool], read: Read) -> None:
    """Add a format that every command that takes a flight can read."""
    if name in READERS:
        raise ValueError(f"{name} files are read already")
    OTHER_FORMATS[name], READERS[name] = knows, read


def import_format(module: str, name: str) -> Any:
    """Import the module of a format, which needs an extra; raises FlightError if absent."""
    try:
        return import_module(f"gateway.recordings.formats.{module}")
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gateway"):
            raise
        raise FlightError(how_to_add(name, "formats")) from error


def _add_packaged(name: str, module: str) -> None:
    """Add a reader whose packages are imported with the first file of its format."""

    def read(path: Path, options: ReadOptions) -> RecordedTable:
        table: RecordedTable = import_format(module, name).read(path, options)
        return table

    READERS[name] = read


RECORDS: Final = {"DataFlash": "dataflash_record", "ULog": "ulog_record"}
"""Module that reads the record of an autopilot, by the name of the format."""


def has_record(path: Path) -> bool:
    """Return whether a file is the log of an autopilot, with its own estimates."""
    return format_of(path) in RECORDS


def open_record(path: Path, options: ReadOptions) -> AutopilotLog:
    """Open an autopilot's own log to be played; raises FlightError and OSError as `open_rows`."""
    kind = format_of(path)
    record: AutopilotLog = import_format(RECORDS[kind], kind).open_record(path, options)
    return record


def estimates_of(files: Iterable[Path], *, fuse: bool, both: bool) -> Estimates:
    """Return which estimates of these files are sent; FlightError for `both` without a log."""
    if not all(has_record(file) for file in files):
        if both:
            raise FlightError("--beside is for logs of autopilots, DataFlash and ULog")
        return "fused"
    return "both" if both else "fused" if fuse else "own"


def beside_id(vehicle_id: int) -> int:
    """Return the system id of the second vehicle, with the states of mavgate."""
    return vehicle_id % (FIRST_GROUND_STATION - 1) + 1


def is_table(path: Path) -> bool:
    """Return whether a file is a table of mavgate's, with its own settings and states."""
    return format_of(path) in (TABLE, PARQUET)


def open_rows(path: Path, options: ReadOptions) -> RecordedTable:
    """Open any file that holds a flight as a table.

    Raises FlightError if it contains no flight that can be read; OSError if it cannot be read at
    all.
    """
    return READERS[format_of(path)](path, options)


def header_for(aircraft: AircraftSettings, vehicle_id: int) -> TableHeader:
    """Return the header that a table needs to be fused again."""
    sections: dict[str, Any] = msgspec.to_builtins(aircraft)
    sections["vehicle"].pop("signing_passphrase")
    calibration = sections.pop("calibration")
    return TableHeader(
        mavgate_version=__version__,
        vehicle_id=vehicle_id,
        settings=sections,
        calibration=calibration,
    )


def settings_of(header: TableHeader) -> AircraftSettings:
    """Return the settings with which a table was recorded."""
    sections = {**header.settings, "calibration": header.calibration}
    return msgspec.convert(migrate_sections(sections)[0], AircraftSettings)


def aircraft_of(table: RecordedTable, options: ReadOptions) -> AircraftSettings:
    """Choose the settings for one table: its own, or those of today."""
    if options.choice == "current" or not table.header.settings:
        return options.current.aircraft.get(table.header.vehicle_id, options.current.default)
    try:
        return settings_of(table.header)
    except msgspec.ValidationError as error:
        raise FlightError(
            f"the recorded settings are of another version ({error}); "
            "use the current ones: --fuse-with current"
        ) from error


def recorded_frames(
    sources: Iterable[TlogSource], progress: Progress | None = None
) -> Iterator[TlogRecord]:
    """Yield the records of tlogs, merged by time."""
    streams = [
        (record for batch in source.batches(progress) for record in batch.records())
        for source in sources
    ]
    return heapq.merge(*streams, key=lambda record: record.time_us)


def read_column_map(path: Path) -> ColumnMap:
    """Read a column map; raises FlightError if it is invalid."""
    try:
        return msgspec.convert(read_toml(path), ColumnMap)
    except TomlError as error:
        raise FlightError(f"{path}: {error}") from error
    except msgspec.ValidationError as error:
        raise FlightError(f"{path}: is not a column map: {error}") from error


def csv_reader(options: ReadOptions) -> CsvReader:
    """Make the reader of another program's CSV."""
    known = options.columns or msgspec.toml.decode(TRACKER_LOG.read_bytes(), type=ColumnMap)
    return CsvReader(known, lenient=options.columns is None)


def _lines(path: Path, progress: Progress | None) -> Iterator[str]:
    decoder = codecs.getincrementaldecoder(_encoding_of(path))(errors="replace")
    rest, number = "", 0
    for data in read_chunks(path, progress):
        *lines, rest = (rest + decoder.decode(data)).split("\n")
        yield from lines
        number += len(lines)
        if len(rest) > MAX_LINE:
            raise FlightError(
                f"{path}: line {number + 1} is longer than {MAX_LINE >> 20} MB; it is not a CSV"
            )
    if rest := rest + decoder.decode(b"", final=True):
        yield rest


def _encoding_of(path: Path) -> str:
    return encoding_of(next(read_chunks(path), b""))


def _open_table(path: Path, options: ReadOptions) -> RecordedTable:
    reader = TableReader()
    return table_of_blocks(path, reader, read_blocks(path, reader, options.progress))


def table_of_blocks(path: Path, reader: TableReader, blocks: Iterator[TableBlock]) -> RecordedTable:
    """Begin to read a table; raises FlightError if its head is damaged, or there is no row."""
    head: list[TableBlock] = []
    for block in blocks:
        head.append(block)
        for _, comment in block.comments:
            if isinstance(comment, TableFault) and comment.line <= HEAD_LINES:
                raise FlightError(
                    f"{path}: line {comment.line}: {comment.reason}; `mavgate recover` writes the "
                    "rows that are sound"
                )
        if len(block):
            return RecordedTable(reader.header or TableHeader(), chain(head, blocks))
    raise FlightError(f"{path}: contains no row")


def _open_csv(path: Path, options: ReadOptions) -> RecordedTable:
    reader = csv_reader(options)
    blocks = (block for block in reader.blocks(_lines(path, options.progress)) if len(block))
    try:
        first = next(blocks, None)
    except ValueError as error:
        encoding = _encoding_of(path).removesuffix("-sig").upper()
        raise FlightError(
            f"{path}: {error} (as {encoding}); name its columns with --columns MAP"
        ) from error
    if first is None:
        why = f": {reader.first_fault}" if reader.first_fault else ""
        raise FlightError(f"{path}: contains no row that can be read{why}")

    def counting() -> Iterator[TableBlock]:
        yield from chain([first], blocks)
        if reader.skipped:
            text = counted(reader.skipped, "line")
            remarks.append(f"{path}: left out {text} of text before the column names")
        odd = ((reader.faults, "line"), (reader.odd_cells, "cell"))
        if left_out := " and ".join(counted(*one) for one in odd if one[0]):
            example = f" ({reader.first_fault})" if reader.first_fault else ""
            remarks.append(f"{path}: left out {left_out} that cannot be read{example}")

    remarks: list[str] = []
    header = _header_of_today(options, options.system_id or 1, reader.unix_us_at_zero)
    return RecordedTable(header, _monotone(counting(), path, remarks), remarks)


def _monotone(blocks: Iterator[TableBlock], path: Path, remarks: list[str]) -> Iterator[TableBlock]:
    """Shift times behind each step back of the clock, as after a restart, so that they increase."""
    last_us, shift_us, restarts = -math.inf, 0.0, 0
    for block in blocks:
        times_us = block.cells[:, 0]
        steps_us = np.diff(times_us, prepend=last_us)
        back_us = np.where(steps_us < -ORDER_US, -steps_us, 0.0)
        last_us = times_us[-1]
        restarts += int(np.count_nonzero(back_us))
        shifts_us = shift_us + np.cumsum(back_us)
        shift_us = shifts_us[-1]
        if shift_us:
            block.cells[:, TIMES] += shifts_us[:, None]
        yield block
    if restarts:
        remarks.append(
            f"{path}: its clock went back {counted(restarts, 'time')}; "
            "what follows goes on from there"
        )


def check_vehicle(paths: Iterable[Path], wanted: int | None, found: Iterable[int]) -> None:
    """Raise FlightError if the vehicle that the user wants is not among those of the files."""
    if wanted is not None and wanted not in (known := sorted(found)):
        each = ", ".join(map(str, paths))
        listed = ", ".join(map(str, known)) or "none"
        raise FlightError(f"{each}: no vehicle {wanted} in this file; it has {listed}")


def _open_autopilot(path: Path, options: ReadOptions) -> RecordedTable:
    source = open_tlog(path)
    reader = AutopilotReader(options.system_id, source.senders)
    batches = source.batches(options.progress, strict=True)
    blocks = chain(map(reader.feed, batches), [None])
    stream = (reader.flush() if cells is None else cells for cells in blocks)
    first = next((cells for cells in stream if len(cells)), None)
    if first is None:
        check_vehicle([path], options.system_id, source.senders.systems())
        raise FlightError(
            f"{path}: contains no HIGHRES_IMU, RAW_IMU or SCALED_IMU of a vehicle to fuse"
        )
    header = _header_of_today(options, reader.system_id or 1, reader.unix_us_at_zero)
    remarks = [f"{path}: {remark}" for remark in source.remarks]
    return RecordedTable(header, map(TableBlock, chain([first], stream)), remarks)


def table_of_rows(
    rows: Iterator[TableRow],
    options: ReadOptions,
    vehicle_id: int = 1,
    unix_us_at_zero: int | None = None,
) -> RecordedTable:
    """Give rows of another program the head of a table, with the current settings."""
    header = _header_of_today(options, vehicle_id, unix_us_at_zero)
    blocks = (block_of(some) for some in iter(lambda: [*islice(rows, BLOCK_ROWS)], []))
    return RecordedTable(header, blocks)


def _header_of_today(
    options: ReadOptions, vehicle_id: int, unix_us_at_zero: int | None
) -> TableHeader:
    current = options.current.aircraft.get(vehicle_id, options.current.default)
    # Its values are calibrated already, whatever the calibration of the aircraft of that number.
    calibrated = msgspec.structs.replace(current, calibration=NodeCalibration())
    known = header_for(calibrated, vehicle_id)
    return msgspec.structs.replace(known, unix_us_at_zero=unix_us_at_zero)


READERS |= {TABLE: _open_table, CSV: _open_csv, TLOG: _open_autopilot}
for _name, _module in (("ULog", "ulog"), ("DataFlash", "dataflash"), (PARQUET, "parquet")):
    _add_packaged(_name, _module)


Limits = tuple[Moment | None, Moment | None]

NOTHING_WITHIN: Final = (
    "there is nothing between that begin and end; `mavgate info` shows the length"
)
OLDER: Final = "a recording is older than the one before it; give the oldest first"
OVERLAP: Final = "left out {} that overlap with the recording before"
LATE_US: Final = 1_000_000
"""Rows of one clock that are older by less than this came late, and are in their place."""


def joined_tables(tables: list[RecordedTable]) -> RecordedTable:
    """Put tables of one aircraft behind one another on the clock of the first.

    Parts of one recording share a clock; other recordings are ordered by civil time.
    Where two overlap, the later one is taken from the end of the earlier one on.

    Raises FlightError if they are of several aircraft; while the rows are read, if one begins
    before the one that it is given behind.
    """
    vehicles = sorted({table.header.vehicle_id for table in tables})
    if len(vehicles) > 1:
        listed = " and ".join(map(str, vehicles))
        raise FlightError(f"these are tables of the aircraft {listed}; take those of one alone")
    first = tables[0].header
    remarks: list[str] = []

    def blocks() -> Iterator[TableBlock]:
        known, begun_us, newest_us = first, -math.inf, -math.inf
        for table in tables:
            header, left_out = table.header, 0
            if (header.settings, header.calibration) != (known.settings, known.calibration):
                yield TableBlock(NO_ROWS, ((0, header),))
            shift_us = _shift_us(header, first)
            is_behind = None
            for block in table.blocks:
                for _, comment in block.comments:
                    known = comment if isinstance(comment, TableHeader) else known
                placed = shifted(block, shift_us or 0)
                times_us = placed.cells[:, 0]
                if len(block) and is_behind is None:
                    is_behind = _is_behind(times_us[0], shift_us, begun_us, newest_us)
                    begun_us = times_us[0]
                if len(block) and not is_behind:
                    overlap = _first(times_us >= newest_us)
                    placed, is_behind = _without(placed, overlap), overlap < len(block)
                    left_out += overlap
                newest_us = times_us.max(initial=newest_us)
                yield placed
            remarks.extend(table.remarks)
            if left_out:
                remarks.append(OVERLAP.format(counted(left_out, "row")))

    return RecordedTable(first, blocks(), remarks)


def _is_behind(begin_us: float, shift_us: int | None, begun_us: float, newest_us: float) -> bool:
    """Return whether a recording begins at the end of the one before, as far as that is known."""
    if shift_us is None:
        return True
    if begin_us < begun_us:
        raise FlightError(OLDER)
    return shift_us == 0 and begin_us > newest_us - LATE_US


def _shift_us(header: TableHeader, first: TableHeader) -> int | None:
    """Return how far two clocks are apart by civil time; None where it is unknown."""
    zero_us, first_zero_us = header.unix_us_at_zero, first.unix_us_at_zero
    if header.session != "" and header.session == first.session:
        return 0  # parts of a recording, whose time GPS may have corrected in between
    if zero_us is None or first_zero_us is None:
        return None
    shift_us = zero_us - first_zero_us
    return 0 if abs(shift_us) <= JUMP_US else shift_us


def _without(block: TableBlock, count: int) -> TableBlock:
    """Leave out the first rows and their remarks, but keep changes of settings."""
    comments = tuple(
        (max(row - count, 0), comment)
        for row, comment in block.comments
        if row >= count or isinstance(comment, TableHeader)
    )
    return TableBlock(block.cells[count:], comments)


def shifted(block: TableBlock, shift_us: int) -> TableBlock:
    """Move rows and all that they hold in time; a state holds times of its own and is left out."""
    if not shift_us:
        return block
    cells = block.cells.copy()
    cells[:, TIMES] += shift_us
    kept = ((k, c) for k, c in block.comments if not isinstance(c, FusionState))
    return TableBlock(cells, tuple((k, _moved(c, shift_us)) for k, c in kept))


def _moved(comment: TableComment, shift_us: int) -> TableComment:
    if isinstance(comment, TableMark | NodeStatus):
        return msgspec.structs.replace(comment, time_us=comment.time_us + shift_us)
    return comment


def trimmed(table: RecordedTable, limits: Limits) -> RecordedTable:
    """Cut a table at its begin and end, each a moment or None."""
    begin, end = limits
    zero_us = table.header.unix_us_at_zero or 0

    def blocks() -> Iterator[TableBlock]:
        first_us: int | None = None
        begun, count = begin is None, 0
        for block in table.blocks:
            times_us = zero_us + block.cells[:, 0]
            if first_us is None and len(block):
                first_us = int(times_us[0])
            start, stop, was_begun = 0, len(block), begun
            if end is not None and first_us is not None:
                stop = _first(times_us > time_us_of(end, first_us))
            if not begun and begin is not None and first_us is not None:
                start = _first(times_us[:stop] >= time_us_of(begin, first_us))
                begun = start < stop
            # What was changed before the begin still holds, but a state from there does not.
            comments = tuple(
                (max(k - start, 0), c)
                for k, c in block.comments
                if k <= stop and (was_begun or (begun and k > start) or isinstance(c, TableHeader))
            )
            yield TableBlock(block.cells[start:stop], comments)
            count += stop - start
            if stop < len(block):
                break
        if not count and limits != (None, None):
            raise FlightError(NOTHING_WITHIN)

    cold_start = table.header.cold_start and begin is None
    return RecordedTable(msgspec.structs.replace(table.header, cold_start=cold_start), blocks())


def _first(where: BoolArray) -> int:
    """Return the number of the first that is true, or how many there are."""
    found = np.flatnonzero(where)
    return int(found[0]) if len(found) else len(where)
