"""Cut a table to a start and an end."""

from collections.abc import Iterator
from typing import Final

import msgspec
import numpy as np

from gateway.recordings.columns import BoolArray
from gateway.recordings.files import FlightError
from gateway.recordings.moment import Moment, time_us_of
from gateway.recordings.recorded_table import RecordedTable
from gateway.recordings.table import TableBlock, TableHeader

Limits = tuple[Moment | None, Moment | None]
NOTHING_WITHIN: Final = (
    "there is nothing between that begin and end; `mavgate info` shows the length"
)


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
