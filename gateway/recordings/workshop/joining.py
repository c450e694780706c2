"""Join tables of one aircraft on the clock of the first, and cut them to a start and an end."""

import math
from collections.abc import Iterable, Iterator
from typing import Final

import msgspec
import numpy as np

from gateway.recordings.columns import TIMES, BoolArray
from gateway.recordings.files import FlightError
from gateway.recordings.moment import time_us_of
from gateway.recordings.recorded_clock import LATE_US, civil_shift_us
from gateway.recordings.recorded_table import ReadOptions, RecordedTable
from gateway.recordings.recording import RecordedFile
from gateway.recordings.table import NO_ROWS, TableBlock, TableComment, TableHeader, TableNote
from gateway.recordings.workshop.selection import NOTHING_WITHIN, Limits
from gateway.records import FusionState, NodeStatus
from gateway.units import counted

OLDER: Final = "a recording is older than the one before it; give the oldest first"
OVERLAP: Final = "left out {} that overlap with the previous recording"


def joined_rows(recordings: Iterable[RecordedFile], options: ReadOptions) -> RecordedTable:
    """Open the rows of recordings of one aircraft, and join them; see `joined_tables`."""
    return joined_tables([recording.rows(options) for recording in recordings])


def joined_tables(tables: list[RecordedTable]) -> RecordedTable:
    """Concatenate tables of one aircraft on the clock of the first.

    Parts of one recording share a clock; other recordings are aligned by civil time.
    Where two overlap, the later one starts at the end of the earlier one.

    Raises FlightError if they are of several aircraft and, while the rows are read, if a recording
    begins before the one given before it.
    """
    vehicles = sorted({table.header.vehicle_id for table in tables})
    if len(vehicles) > 1:
        listed = " and ".join(map(str, vehicles))
        raise FlightError(f"these are tables of the aircraft {listed}; give those of one only")
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
                    overlap = first_true(times_us >= newest_us)
                    placed, is_behind = _without(placed, overlap), overlap < len(block)
                    left_out += overlap
                newest_us = times_us.max(initial=newest_us)
                yield placed
            remarks.extend(table.remarks)
            if left_out:
                remarks.append(OVERLAP.format(counted(left_out, "row")))

    return RecordedTable(first, blocks(), remarks)


def _is_behind(begin_us: float, shift_us: int | None, begun_us: float, newest_us: float) -> bool:
    """Return whether a recording continues after the one before, as far as this is known."""
    if shift_us is None:
        return True
    if begin_us < begun_us:
        raise FlightError(OLDER)
    return shift_us == 0 and begin_us > newest_us - LATE_US


def _shift_us(header: TableHeader, first: TableHeader) -> int | None:
    """Return the difference of two clocks by civil time; None if it is unknown."""
    if header.session != "" and header.session == first.session:
        return 0  # parts of a recording, whose time GPS may have corrected in between
    return civil_shift_us(header.unix_us_at_zero, first.unix_us_at_zero)


def _without(block: TableBlock, count: int) -> TableBlock:
    """Leave out the first rows and their comments, but keep changes of settings."""
    comments = tuple(
        (max(row - count, 0), comment)
        for row, comment in block.comments
        if row >= count or isinstance(comment, TableHeader)
    )
    return TableBlock(block.cells[count:], comments)


def shifted(block: TableBlock, shift_us: int) -> TableBlock:
    """Shift rows and comments in time; states are left out, since they contain times themselves."""
    if not shift_us:
        return block
    cells = block.cells.copy()
    cells[:, TIMES] += shift_us
    kept = ((k, c) for k, c in block.comments if not isinstance(c, FusionState))
    return TableBlock(cells, tuple((k, _moved(c, shift_us)) for k, c in kept))


def _moved(comment: TableComment, shift_us: int) -> TableComment:
    if isinstance(comment, TableNote | NodeStatus):
        return msgspec.structs.replace(comment, time_us=comment.time_us + shift_us)
    return comment


def trimmed(table: RecordedTable, limits: Limits) -> RecordedTable:
    """Cut a table to a start and an end, each a moment or None."""
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
                stop = first_true(times_us > time_us_of(end, first_us))
            if not begun and begin is not None and first_us is not None:
                start = first_true(times_us[:stop] >= time_us_of(begin, first_us))
                begun = start < stop
            # Settings changed before the start still apply, but a state from there does not.
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


def first_true(where: BoolArray) -> int:
    """Return the index of the first True, or the length if there is none."""
    found = np.flatnonzero(where)
    return int(found[0]) if len(found) else len(where)
