"""Open any recording as a table, with the reader of its format.

Readers that require large packages are imported with the first file of their format.
"""

import codecs
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any, Final, Literal

import msgspec

from gateway.extras import how_to_add
from gateway.recordings.autopilot_record import AutopilotLog
from gateway.recordings.columns import TIMES
from gateway.recordings.file_format import (
    CSV,
    OTHER_FORMATS,
    PARQUET,
    TABLE,
    TLOG,
    encoding_of,
    format_of,
)
from gateway.recordings.files import FlightError, Progress, read_blocks, read_chunks
from gateway.recordings.formats.csv import ColumnMap, CsvReader
from gateway.recordings.formats.mavlink import AutopilotReader
from gateway.recordings.logged_samples import read_samples
from gateway.recordings.recorded_clock import RestartClock
from gateway.recordings.recorded_table import (
    ReadOptions,
    RecordedTable,
    header_of_today,
    table_of_blocks,
)
from gateway.recordings.table import MAX_LINE, TableBlock, TableReader
from gateway.recordings.tlog_source import open_tlog
from gateway.toml_file import TomlError, read_toml
from gateway.units import counted
from gateway.vehicle_state.senders import FIRST_GROUND_STATION

TRACKER_LOG: Final = files("gateway.recordings.formats") / "tracker-log.toml"
"""Column map for logs with the columns time_s, ax, gx and so on."""
RECORDS: Final = {"DataFlash": "dataflash_record", "ULog": "ulog_record"}
"""Module that reads an autopilot's log, by the name of the format."""

Estimates = Literal["own", "fused", "both"]
"""Estimates to use from an autopilot's log: its own, those of mavgate, or both as two vehicles."""

Read = Callable[[Path, ReadOptions], RecordedTable]

READERS: dict[str, Read] = {}
"""Readers by the name of the format."""


def add_reader(name: str, knows: Callable[[bytes], bool], read: Read) -> None:
    """Add a format that every command that takes a flight will be able to read."""
    if name in READERS:
        raise ValueError(f"{name} files are read already")
    OTHER_FORMATS[name], READERS[name] = knows, read


def import_format(module: str, name: str) -> Any:
    """Import the module of a format, which requires an extra; raises FlightError if missing."""
    try:
        return import_module(f"gateway.recordings.formats.{module}")
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gateway"):
            raise
        raise FlightError(how_to_add(name, "formats")) from error


def has_record(path: Path) -> bool:
    """Return whether a file is an autopilot's log, with its own estimates."""
    return format_of(path) in RECORDS


def open_record(path: Path, options: ReadOptions) -> AutopilotLog:
    """Open an autopilot's own log for playback; raises FlightError and OSError as `open_rows`."""
    log = _open_log(path, options)
    if not log.is_shown:
        raise FlightError(f"{path}: nothing to play: {log.why_no_samples}")
    return log


def _open_log(path: Path, options: ReadOptions, *, sampled: bool = False) -> AutopilotLog:
    kind = format_of(path)
    module = import_format(RECORDS[kind], kind)
    log: AutopilotLog = module.open_record(path, options, sampled=sampled)
    return log


def _open_samples(path: Path, options: ReadOptions) -> RecordedTable:
    return read_samples(path, _open_log(path, options, sampled=True), options)


def _open_parquet(path: Path, options: ReadOptions) -> RecordedTable:
    table: RecordedTable = import_format("parquet", PARQUET).read(path, options)
    return table


def estimates_of(files: Iterable[Path], *, fuse: bool, both: bool) -> Estimates:
    """Return which estimates of these files are sent; FlightError for `both` if none is a log."""
    if not all(has_record(file) for file in files):
        if both:
            raise FlightError("--beside is for logs of autopilots, DataFlash and ULog")
        return "fused"
    return "both" if both else "fused" if fuse else "own"


def beside_id(vehicle_id: int) -> int:
    """Return the system id of the second vehicle, which has the states of mavgate."""
    return vehicle_id % (FIRST_GROUND_STATION - 1) + 1


def is_table(path: Path) -> bool:
    """Return whether a file is a table of mavgate, with its own settings and states."""
    return format_of(path) in (TABLE, PARQUET)


def open_rows(path: Path, options: ReadOptions) -> RecordedTable:
    """Open any file that contains a flight as a table.

    Raises FlightError if it contains no readable flight; OSError if it cannot be read at all.
    """
    return READERS[format_of(path)](path, options)


def read_column_map(path: Path) -> ColumnMap:
    """Read a column map; raises FlightError if it is invalid."""
    try:
        return msgspec.convert(read_toml(path), ColumnMap)
    except TomlError as error:
        raise FlightError(f"{path}: {error}") from error
    except msgspec.ValidationError as error:
        raise FlightError(f"{path}: is not a column map: {error}") from error


def csv_reader(options: ReadOptions) -> CsvReader:
    """Return a reader for another program's CSV."""
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
    header = header_of_today(options, options.system_id or 1, reader.unix_us_at_zero)
    clock = RestartClock()

    def in_order() -> Iterator[TableBlock]:
        for block in counting():
            block.cells[:, TIMES] += clock.shifts_us(block.cells[:, 0])[:, None]
            yield block
        if clock.restarts:
            remarks.append(
                f"{path}: its clock went back {counted(clock.restarts, 'time')}; "
                "later times continue from there"
            )

    return RecordedTable(header, in_order(), remarks)


def check_vehicle(paths: Iterable[Path], wanted: int | None, found: Iterable[int]) -> None:
    """Raise FlightError if the files do not contain the vehicle that the user wants."""
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
    header = header_of_today(options, reader.system_id or 1, reader.unix_us_at_zero)
    remarks = [f"{path}: {remark}" for remark in source.remarks]
    return RecordedTable(header, map(TableBlock, chain([first], stream)), remarks)


READERS |= {TABLE: _open_table, CSV: _open_csv, TLOG: _open_autopilot, PARQUET: _open_parquet}
READERS |= dict.fromkeys(RECORDS, _open_samples)
