"""Summary of any recording, for `mavgate info`."""

from dataclasses import replace
from pathlib import Path

from gateway.edges.disk.recording_streams import (
    FileKind,
    kind_of,
    other_format,
    read_batches,
    read_blocks,
)
from gateway.flightlog.summary import FileInfo, TableSummary, TlogSummary
from gateway.flightlog.table.table import TableReader
from gateway.flights.joined import shifted
from gateway.flights.reading import (
    NO_RECORDING,
    FlightError,
    ReadOptions,
    is_table,
    open_rows,
)


def describe(file: Path, options: ReadOptions) -> FileInfo:
    """Summarise a recording.

    Parameters
    ----------
    file : Path
        A tlog, a table, or what can be read as one.
    options : ReadOptions
        Column map; its progress is called with how many more bytes were read.

    Returns
    -------
    FileInfo

    Raises
    ------
    FlightError
        If it is none of these.
    OSError
        If it cannot be read.
    """
    kind, size, advance = kind_of(file), file.stat().st_size, options.progress
    if kind is FileKind.TLOG:
        tlog = TlogSummary()
        for batch in read_batches(file, advance):
            tlog.add(batch)
        found = tlog.result(size)
        if not found.records:
            raise FlightError(f"{file}: {NO_RECORDING}")
        return found
    table, reader = TableSummary(), TableReader()
    if kind in (FileKind.FOREIGN, FileKind.OTHER):
        foreign = open_rows(file, options)
        own = is_table(file)
        zero_us = 0 if own else foreign.header.unix_us_at_zero or 0
        for block in foreign.blocks:
            table.add(shifted(block, zero_us), foreign.header)
        name = other_format(file) if kind is FileKind.OTHER else kind.value
        header = foreign.header if own else None
        remarks = tuple(foreign.remarks)
        return replace(table.result(size), kind=name, header=header, remarks=remarks)
    for block in read_blocks(file, reader, advance):
        table.add(block, reader.header)
    return table.result(size)
