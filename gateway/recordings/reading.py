"""Open any recording as a table: the reader of its format, and the settings to fuse it with.

Readers that need large packages are imported with the first file of their format.
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
from gateway.aircraft import AircraftSettings
from gateway.estimation.select import migrate_sections
from gateway.pipeline import PipelineSettings
from gateway.recordings.columns import TIMES, TableRow
from gateway.recordings.files import (
    MAX_UNPACKED,
    OTHER_FORMATS,
    PARQUET,
    FileKind,
    FlightError,
    Position,
    Progress,
    SettingsChoice,
    encoding_of,
    kind_of,
    open_tlog,
    other_format,
    read_blocks,
    read_chunks,
)
from gateway.recordings.formats.csv import ColumnMap, CsvReader
from gateway.recordings.formats.mavlink import AutopilotReader
from gateway.recordings.table import (
    HEAD_LINES,
    MAX_LINE,
    TableBlock,
    TableFault,
    TableHeader,
    TableMark,
    TableReader,
    block_of,
)
from gateway.recordings.tlog import ORDER_US, TlogRecord
from gateway.records import FusionState, NodeStatus
from gateway.sensing.calibration import NodeCalibration
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


ROWS: Final = 1000
"""Of another program's file that are laid out as columns at once."""

Read = Callable[[Path, ReadOptions], RecordedTable]

READERS: Final[dict[str, Read]] = {}
"""Of the formats in `OTHER_FORMATS`."""


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
        raise FlightError(
            f"{name} needs {error.name}, the extra mavgate[formats]: see mavgate doctor"
        ) from error


def _add_packaged(name: str, module: str) -> None:
    """Add a reader whose packages are imported with the first file of its format."""

    def read(path: Path, options: ReadOptions) -> RecordedTable:
        table: RecordedTable = import_format(module, name).read(path, options)
        return table

    READERS[name] = read


def is_table(path: Path) -> bool:
    """Return whether a file is a table of mavgate's, with its own settings and states."""
    kind = kind_of(path)
    return kind is FileKind.TABLE or (kind is FileKind.OTHER and other_format(path) == PARQUET)


def open_rows(path: Path, options: ReadOptions) -> RecordedTable:
    """Open any file that holds a flight as a table.

    Raises FlightError if it holds no flight that can be read; OSError if it cannot be read at
    all.
    """
    match kind_of(path):
        case FileKind.TABLE:
            return _open_table(path, options)
        case FileKind.CSV:
            return _open_csv(path, options)
        case FileKind.TLOG:
            return _open_autopilot(path, options)
        case FileKind.OTHER:
            return READERS[other_format(path)](path, options)


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
            "use the current ones: --settings current"
        ) from error


def recorded_frames(
    paths: Iterable[Path], progress: Progress | None, remarks: list[str] | None = None
) -> Iterator[TlogRecord]:
    """Yield the records of tlogs, merged by time; remarks about their times are added."""
    sources = [open_tlog(path) for path in paths]
    if remarks is not None:
        remarks += [f"{source.path}: {text}" for source in sources for text in source.remarks]
    streams = [
        (record for batch in source.batches(progress) for record in batch.records())
        for source in sources
    ]
    return heapq.merge(*streams, key=lambda record: record.time_us)


def csv_reader(options: ReadOptions) -> CsvReader:
    """Make the reader of another program's CSV."""
    known = options.columns or msgspec.toml.decode(TRACKER_LOG.read_bytes(), type=ColumnMap)
    return CsvReader(known, options.system_id or 1, lenient=options.columns is None)


def _lines(path: Path, progress: Progress | None) -> Iterator[str]:
    decoder = codecs.getincrementaldecoder(_encoding_of(path))(errors="replace")
    rest, number = "", 0
    for data in read_chunks(path, progress):
        *lines, rest = (rest + decoder.decode(data)).split("\n")
        yield from lines
        number += len(lines)
        if len(rest) > MAX_LINE:
            raise FlightError(
                f"{path}: line {number + 1} is longer than {MAX_LINE >> 20} MB; it is no CSV"
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
    raise FlightError(f"{path}: holds no row")


def _open_csv(path: Path, options: ReadOptions) -> RecordedTable:
    reader = csv_reader(options)
    rows = reader.rows(_lines(path, options.progress))
    try:
        first = next(rows, None)
    except ValueError as error:
        encoding = _encoding_of(path).removesuffix("-sig").upper()
        raise FlightError(
            f"{path}: {error} (as {encoding}); name its columns with --columns MAP"
        ) from error
    if first is None:
        raise FlightError(f"{path}: holds no row that can be read")

    def lines() -> Iterator[TableRow]:
        yield from rows
        if reader.skipped:
            text = counted(reader.skipped, "line")
            table.remarks.append(f"{path}: left out {text} of text before the column names")
        if reader.faults:
            table.remarks.append(
                f"{path}: left out {counted(reader.faults, 'line')} that cannot be read"
            )

    table = table_of_rows(chain([first], lines()), options, options.system_id or 1)
    table.blocks = _going_on(table.blocks, path, table.remarks)
    return table


def _going_on(blocks: Iterator[TableBlock], path: Path, remarks: list[str]) -> Iterator[TableBlock]:
    """Let a clock that goes back, as after a restart, go on from where it was."""
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


def _open_autopilot(path: Path, options: ReadOptions) -> RecordedTable:
    reader = AutopilotReader(options.system_id)
    source = open_tlog(path)
    batches = source.batches(options.progress, strict=True)
    blocks = chain(map(reader.feed, batches), [None])
    stream = (reader.flush() if cells is None else cells for cells in blocks)
    first = next((cells for cells in stream if len(cells)), None)
    if first is None:
        raise FlightError(
            f"{path}: holds no HIGHRES_IMU, RAW_IMU or SCALED_IMU of a vehicle to fuse"
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
    blocks = (block_of(some) for some in iter(lambda: [*islice(rows, ROWS)], []))
    return RecordedTable(header, blocks)


def _header_of_today(
    options: ReadOptions, vehicle_id: int, unix_us_at_zero: int | None
) -> TableHeader:
    current = options.current.aircraft.get(vehicle_id, options.current.default)
    # Its values are calibrated already, whatever the calibration of the aircraft of that number.
    calibrated = msgspec.structs.replace(current, calibration=NodeCalibration())
    known = header_for(calibrated, vehicle_id)
    return msgspec.structs.replace(known, unix_us_at_zero=unix_us_at_zero)


_add_packaged("ULog", "ulog")
_add_packaged("DataFlash", "dataflash")
_add_packaged(PARQUET, "parquet")
