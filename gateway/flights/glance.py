"""Length and vehicles of a recording, from the ends of its files only."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from gateway.edges.disk.recording_streams import FileKind, kind_of, read_ends
from gateway.edges.disk.tlog_source import HEAD_BYTES, Layout, layout_of, read_batches
from gateway.flightlog.damaged_times import DAY_US
from gateway.flightlog.table.row import TableRow
from gateway.flightlog.table.table import TableReader
from gateway.flightlog.tlog.recorded_commands import is_station
from gateway.flightlog.tlog.tlog import TlogIndex, TlogScanner
from gateway.units import US_PER_S

END_BYTES: Final = 1 << 16
"""Of a tlog: some thousand frames, and so more than a second's heartbeats."""


class Glance(msgspec.Struct, frozen=True):
    """Length and vehicles of a recording."""

    duration_s: float | None
    """None if no file gives it."""
    vehicles: tuple[int, ...]
    """System ids; of a very long recording those seen at its ends."""


def glance(files: Sequence[Path]) -> Glance:
    """Look at a recording.

    Parameters
    ----------
    files : sequence of Path
        All files of it; one that cannot be read, or is empty, is ignored.
    """
    times_us: list[int] = []
    vehicles: set[int] = set()
    for file in files:
        try:
            span = _tlog_span if kind_of(file) is FileKind.TLOG else _table_span
            first_us, last_us, systems = span(file)
        except (OSError, ValueError):
            continue
        times_us += [first_us, last_us]
        vehicles |= systems
    duration_s = (max(times_us) - min(times_us)) / US_PER_S if times_us else None
    return Glance(duration_s, tuple(sorted(vehicles)))


def _tlog_span(file: Path) -> tuple[int, int, set[int]]:
    """Return begin, end and vehicles; raises ValueError if there are none."""
    index = TlogIndex()
    with file.open("rb") as stream:
        size = file.stat().st_size
        for begin in sorted({0, max(size - END_BYTES, 0)}):
            stream.seek(begin)
            # The end begins within a record; the scanner finds the next one.
            index.add(TlogScanner(begin).feed(stream.read(END_BYTES), final=True))
        stream.seek(0)
        is_odd = layout_of(stream.read(HEAD_BYTES)) is not Layout.TLOG
    if is_odd or (index.last_us or 0) - (index.first_us or 0) > DAY_US:
        # Its clock was set meanwhile, or it is no plain tlog: only all of it shows its length.
        index = TlogIndex()
        for batch in read_batches(file):
            index.add(batch)
    if index.first_us is None or index.last_us is None:
        raise ValueError("holds no record")
    vehicles = {o >> 8 for o in index.origins if not is_station(o, index.stations)}
    return index.first_us, index.last_us, vehicles


def _table_span(file: Path) -> tuple[int, int, set[int]]:
    head, tail = read_ends(file)
    reader = TableReader()
    rows = [e for e in reader.feed(head + tail, final=True) if isinstance(e, TableRow)]
    header = reader.header
    if not rows or header is None:
        raise ValueError("holds no row")
    zero_us = header.unix_us_at_zero or 0
    return zero_us + _first_us(file, rows[0]), zero_us + rows[-1].time_us, {header.vehicle_id}


def _first_us(file: Path, row: TableRow) -> int:
    """Return the time of a table's first row."""
    with file.open("rb") as stream:
        for line in stream:
            time_us = line.partition(b",")[0]
            if time_us.isdigit():
                return int(time_us)
    return row.time_us
