"""Read the rows of each format; `recording` chooses the reader."""

import codecs
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Final

import msgspec

from gateway.recordings.columns import TIMES
from gateway.recordings.file_format import (
    CSV,
    LOGS,
    OTHER_FORMATS,
    PARQUET,
    TABLE,
    TLOG,
    encoding_of,
    import_format,
)
from gateway.recordings.files import FlightError, Progress, read_blocks, read_chunks, read_ends
from gateway.recordings.formats.csv import ColumnMap, CsvReader
from gateway.recordings.formats.mavlink import AutopilotReader
from gateway.recordings.recorded_clock import RestartClock
from gateway.recordings.recorded_table import (
    ReadOptions,
    RecordedTable,
    header_of_today,
    table_of_blocks,
)
from gateway.recordings.table import MAX_LINE, TableBlock, TableReader
from gateway.recordings.tlog_source import TlogSource
from gateway.toml_file import TomlError, read_toml
from gateway.units import counted

TRACKER_LOG: Final = files("gateway.recordings.formats") / "tracker-log.toml"
"""Column map for logs with the columns time_s, ax, gx and so on."""
HEAD_LINES: Final = 20
"""Lines of a CSV in which values are searched."""
_KEY_VALUE: Final = re.compile(r"(\w+)=(-?[\d.]+)")

Read = Callable[[Path, ReadOptions], RecordedTable]

READERS: dict[str, Read] = {}
"""Readers by the name of the format."""


def add_reader(name: str, knows: Callable[[bytes], bool], read: Read) -> None:
    """Add a format that every command that takes a flight will be able to read."""
    if name in {TLOG, *LOGS, *READERS}:
        raise ValueError(f"{name} files are read already")
    OTHER_FORMATS[name], READERS[name] = knows, read


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


def read_mavlink(source: TlogSource, options: ReadOptions) -> RecordedTable:
    """Read the samples of one vehicle in MAVLink as a flight; FlightError if there are none."""
    path, reader = source.path, AutopilotReader(options.system_id, source.senders)
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


def facts_of_csv(path: Path) -> dict[str, float]:
    """Read `key=value` in the comments of a CSV; FlightError if one is not a number."""
    facts: dict[str, float] = {}
    begin = next(read_chunks(path), b"")
    head = begin.decode(encoding_of(begin), errors="replace")
    for number, line in enumerate(head.split("\n", HEAD_LINES)[:HEAD_LINES], 1):
        for key, value in _KEY_VALUE.findall(line) if line.startswith("#") else ():
            try:
                facts[key] = float(value)
            except ValueError as error:
                raise FlightError(
                    f"{path}: line {number}: {key}={value} is not a number"
                ) from error
    return facts


def _end_of_csv(path: Path, options: ReadOptions) -> int | None:
    lines = b"".join(read_ends(path)).decode(errors="replace").splitlines()
    with suppress(ValueError):
        *_, last = csv_reader(options).blocks(lines)
        return int(last.cells[-1, 0]) if len(last) else None
    return None


def _end_of_table(path: Path, _: ReadOptions) -> int | None:
    reader = TableReader()
    rows = reader.feed_block(b"".join(read_ends(path)), final=True)
    zero_us = (reader.header.unix_us_at_zero or 0) if reader.header else 0
    return zero_us + int(rows.cells[-1, 0]) if len(rows) else None


def _open_parquet(path: Path, options: ReadOptions) -> RecordedTable:
    table: RecordedTable = import_format("parquet", PARQUET).read(path, options)
    return table


READERS |= {TABLE: _open_table, CSV: _open_csv, PARQUET: _open_parquet}
END_READERS: Final = {TABLE: _end_of_table, CSV: _end_of_csv}
"""Readers of the civil time of the last row, for formats in which it can be found."""
