"""Tables come back whole, in any chunks, cut anywhere, edited by people."""

import numpy as np
import pytest

from gateway.recordings.rows import TableRow, row_to_line
from gateway.recordings.table import (
    MAX_LINE,
    TableEvent,
    TableFault,
    TableHeader,
    TableNote,
    TableReader,
    block_of,
    encode_head,
    encode_line,
)
from gateway.records import NodeId, NodeStatus
from tests.recordings.samples import make_rows

HEADER = TableHeader(
    mavgate_version="0.1.0",
    vehicle_id=3,
    session="flight",
    unix_us_at_zero=1_760_000_000_000_000,
    settings={"sensing": {"accel_cutoff_hz": 10.0}},
    calibration={"accel_bias_mps2": [0.1, 0.2, 0.3]},
)


def make_table(rows: list[TableRow]) -> bytes:
    return (encode_head(HEADER) + "".join(map(row_to_line, rows))).encode()


def read(data: bytes, chunk: int | None = None) -> tuple[TableReader, list[TableEvent]]:
    reader = TableReader()
    chunk = chunk or max(len(data), 1)
    events = [e for i in range(0, len(data), chunk) for e in reader.feed(data[i : i + chunk])]
    return reader, events + reader.feed(b"", final=True)


@pytest.mark.parametrize("chunk", [None, 1, 13, 1000])
def test_written_file_is_read_in_any_chunks(chunk: int | None) -> None:
    rows = make_rows(1)
    reader, events = read(make_table(rows), chunk)
    assert reader.header == HEADER
    assert repr(events) == repr(rows)


NOTE = TableNote(1234, 'over the "gate", # 2')
STATUS = NodeStatus(5, NodeId(3, 1), 4, (1, 2), 1, 8, 0, 3, 2, 1, 900, 5, 3290)


@pytest.mark.parametrize(("event", "prefix"), [(NOTE, "# note: "), (STATUS, "# node: ")])
def test_comments_are_read_between_rows(event: TableNote | NodeStatus, prefix: str) -> None:
    rows = make_rows(2, 4)
    line = encode_line(event).replace("# note: ", prefix)
    assert line.startswith(prefix)
    data = make_table(rows[:1]) + line.encode() + row_to_line(rows[1]).encode()
    assert repr(read(data)[1]) == repr([rows[0], event, rows[1]])


def test_truncated_table_loses_at_most_its_last_line() -> None:
    rows = make_rows(3, 4)
    data = make_table(rows)
    head = len(encode_head(HEADER))
    ends = head + np.cumsum([len(row_to_line(row)) for row in rows])
    for size in range(len(data) + 1):
        events = read(data[:size])[1]
        whole = int(np.searchsorted(ends, size, side="right"))
        assert repr([e for e in events if isinstance(e, TableRow)]) == repr(rows[:whole])
        faults = [e for e in events if isinstance(e, TableFault)]
        assert len(faults) == (size > 0 and not data[:size].endswith(b"\n"))


@pytest.mark.parametrize("chunk", [None, 4096])
def test_endless_zeros_are_read_within_bounded_memory(chunk: int | None) -> None:
    rows = make_rows(5, 4)
    data = make_table(rows) + bytes(3 * MAX_LINE)
    events = read(data, chunk)[1]
    assert repr(events[:-1]) == repr(rows)
    assert isinstance(events[-1], TableFault)
    assert events[-1].size == 3 * MAX_LINE


def test_columns_are_found_by_name() -> None:
    rows = make_rows(6)
    table = make_table(rows).decode().splitlines()
    moved = [",".join(["more", *reversed(line.split(","))]) for line in table[2:]]
    assert repr(read("\r\n".join([*table[:2], *moved, ""]).encode())[1]) == repr(rows)


def test_missing_columns_are_unknown() -> None:
    events = read(b"time_us,accel_x_b_mps2,accel_y_b_mps2,accel_z_b_mps2\n7,0.0,0.0,-9.81\n")[1]
    (row,) = events
    assert isinstance(row, TableRow)
    assert row.imu is not None
    assert row.imu.accel_b_mps2 == (0.0, 0.0, -9.81)
    assert row.imu.mag_b_ut is None
    assert row.raw is row.gps is row.baro is row.state is None


def test_foreign_file_gives_only_faults() -> None:
    reader, events = read(b"a,b,c\n1,2,3\n")
    assert reader.header is None
    assert all(isinstance(event, TableFault) for event in events)


@pytest.mark.parametrize("size", [1, 7, 20, 1000])
@pytest.mark.parametrize("count", [0, 20])
def test_pieces_of_a_block_contain_all_events_in_order(size: int, count: int) -> None:
    rows, mark = make_rows(1, count)[:20], TableNote(5, "here")
    events = [mark, *rows[:7], mark, mark, *rows[7:], mark]
    pieces = [*block_of(events).pieces(size)]
    assert max(map(len, pieces)) <= size
    assert repr([event for piece in pieces for event in piece.events(3)]) == repr(events)


@pytest.mark.parametrize(
    "line",
    [
        f'# header: {{"unix_us_at_zero": {10**30}}}',
        f'# note: {{"time_us": {10**30}, "text": "over the wood"}}',
        f'# note: {{"time_us": {-(10**30)}, "text": "over the wood"}}',
        '# state: {"vehicle_id": 256, "fits": "", "estimation": ""}',
        '# state: {"vehicle_id": 0, "fits": "", "estimation": ""}',
    ],
)
def test_comment_with_a_number_that_no_other_format_can_hold_is_a_fault(line: str) -> None:
    _, events = read(make_table([]) + line.encode() + b"\n")
    (fault,) = events
    assert isinstance(fault, TableFault)
    assert "Expected `int`" in fault.reason
