"""Recordings joined in order of civil time, without repeated rows."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.recordings.files import FlightError
from gateway.recordings.recorded_table import RecordedTable
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableHeader, TableNote, block_of
from gateway.recordings.workshop.joining import joined_tables

SECOND_US = 1_000_000
EPOCH_US = 1_780_000_000 * SECOND_US


def table(begin_s: int, end_s: int, zero_us: int | None, session: str = "") -> RecordedTable:
    """Return a row a second; each tenth is remarked.

    They are on a clock of their own, which begins at 0, unless they are part of a session.
    """
    zero_s = 0 if session else begin_s
    if zero_us is not None:
        zero_us += zero_s * SECOND_US
    head = TableHeader(vehicle_id=1, unix_us_at_zero=zero_us, session=session)
    events: list[TableRow | TableNote] = []
    for second in range(begin_s, end_s):
        at_us = (second - zero_s) * SECOND_US
        events += [TableNote(at_us, str(second))] * (second % 10 == 0) + [TableRow(at_us)]
    return RecordedTable(head, block_of(events).pieces((end_s - begin_s) // 2))


def seconds_of(joined: RecordedTable) -> tuple[list[int], list[int]]:
    """Return the times of rows and of remarks, which have their own second as text."""
    blocks = list(joined.blocks)
    marks = [mark for block in blocks for _, mark in block.comments]
    assert [mark.time_us / SECOND_US for mark in marks] == [int(mark.text) for mark in marks]
    times = np.concatenate([block.cells[:, 0] for block in blocks])
    return (times / SECOND_US).astype(int).tolist(), [int(mark.text) for mark in marks]


@given(
    # Clocks that differ by a second or two are taken for one.
    begins=st.lists(st.integers(0, 12).map(lambda k: 5 * k), min_size=1, max_size=4),
    lengths=st.lists(st.integers(2, 40), min_size=4, max_size=4),
    session=st.sampled_from(["", "20260611-142530"]),
)
def test_rows_are_joined_in_order_and_overlapping_ones_taken_once(
    begins: list[int], lengths: list[int], session: str
) -> None:
    """Cut and joined, a recording is itself; what two recordings cover is taken once."""
    begins = [begin - min(begins) for begin in sorted(begins)]
    ordered = [(begin, begin + length) for begin, length in zip(begins, lengths, strict=False)]
    joined = joined_tables([table(*span, EPOCH_US, session) for span in ordered])
    times, marks = seconds_of(joined)
    kept = sorted({second for span in ordered for second in range(*span)})
    # The last second of a recording may hold more than one row.
    assert sorted(set(times)) == kept
    assert times == sorted(times)
    assert sorted(set(marks)) == [second for second in kept if second % 10 == 0]
    newest = left_out = 0
    for begin, end in ordered:
        left_out += max(min(end, newest) - begin, 0)
        newest = max(newest, end - 1)
    assert sum(int(re.findall(r"\d+", text)[0]) for text in joined.remarks) == left_out


@pytest.mark.parametrize("session", ["", "20260611-142530"])
@pytest.mark.parametrize("spans", [((50, 90), (0, 40)), ((0, 40), (80, 90), (40, 80))])
def test_older_recording_behind_a_newer_one_is_refused(
    spans: tuple[tuple[int, int], ...], session: str
) -> None:
    joined = joined_tables([table(*span, EPOCH_US, session) for span in spans])
    with pytest.raises(FlightError, match="give the oldest first"):
        list(joined.blocks)


def test_recordings_without_civil_time_keep_their_clock() -> None:
    joined = joined_tables([table(0, 9, None), table(20, 29, None)])
    times = np.concatenate([block.cells[:, 0] for block in joined.blocks]) / SECOND_US
    assert times.tolist() == [*range(9), *range(9)]


def test_parts_of_a_recording_keep_their_clock() -> None:
    """GPS has corrected the time between them; a late row is sorted by its time."""
    first, second = table(0, 10, EPOCH_US, "flight"), table(9, 20, EPOCH_US + 10**9, "flight")
    times, marks = seconds_of(joined := joined_tables([first, second]))
    assert times == [*range(10), *range(9, 20)]
    assert (marks, joined.remarks) == ([0, 10], [])
