"""Summary of any recording, for `mavgate info`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gateway.edges.disk.recording_streams import (
    FileKind,
    Progress,
    kind_of,
    other_format,
    read_blocks,
)
from gateway.edges.disk.tlog_source import open_tlog
from gateway.flightlog.summary import FileInfo, TableSummary, TlogSummary
from gateway.flightlog.table.table import TableReader
from gateway.flights.flight_terms import NO_RECORDING, FlightError

if TYPE_CHECKING:
    from gateway.flights.reading import ReadOptions


def describe(file: Path, progress: Progress | None, options: Callable[[], ReadOptions]) -> FileInfo:
    """Summarise a recording.

    Parameters
    ----------
    file : Path
        A tlog, a table, or what can be read as one.
    progress : callable or None
        Called with the number of further bytes read.
    options : callable
        Returns how other programs' files are read; called for these alone.

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
    kind, size = kind_of(file), file.stat().st_size
    if kind is FileKind.TLOG:
        tlog, source = TlogSummary(), open_tlog(file)
        for batch in source.batches(progress):
            tlog.add(batch)
        found = tlog.result(size)
        found = replace(found, remarks=(*source.remarks, *found.remarks))
        if not found.records:
            raise FlightError(f"{file}: {NO_RECORDING}")
        return found
    if kind in (FileKind.CSV, FileKind.OTHER):
        return _describe_by_rows(file, kind, options())
    table, reader = TableSummary(), TableReader()
    for block in read_blocks(file, reader, progress):
        table.add(block, reader.header)
    return table.result(size)


def _describe_by_rows(file: Path, kind: FileKind, options: ReadOptions) -> FileInfo:
    # They import every stage, which a summary of a recording of our own does not need.
    from gateway.flights.joined import shifted
    from gateway.flights.reading import is_table, open_rows

    recorded, table = open_rows(file, options), TableSummary()
    own = is_table(file)
    zero_us = 0 if own else recorded.header.unix_us_at_zero or 0
    for block in recorded.blocks:
        table.add(shifted(block, zero_us), recorded.header)
    return replace(
        table.result(file.stat().st_size),
        kind=other_format(file) if kind is FileKind.OTHER else kind.value,
        header=recorded.header if own else None,
        remarks=tuple(recorded.remarks),
    )
