"""Tables of one aircraft behind one another, on the clock of the first."""

import math
from collections.abc import Iterator
from typing import Final

import msgspec

from gateway.recordings.columns import TIMES
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_table import RecordedTable
from gateway.recordings.table import NO_ROWS, TableBlock, TableComment, TableHeader, TableNote
from gateway.recordings.tlog import JUMP_US
from gateway.recordings.trimming import first_true
from gateway.records import FusionState, NodeStatus
from gateway.units import counted

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
    if isinstance(comment, TableNote | NodeStatus):
        return msgspec.structs.replace(comment, time_us=comment.time_us + shift_us)
    return comment
