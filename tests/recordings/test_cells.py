"""Columns of numbers have the digits that Python's own `float` and `repr` give them."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.recordings.columns import (
    COLUMNS,
    RowBuilder,
    TableRow,
    read_lines,
    row_to_line,
    write_lines,
)
from gateway.recordings.table import (
    TableFault,
    TableHeader,
    TableMark,
    TableReader,
    block_of,
    encode_block,
    encode_head,
    encode_mark,
)
from tests.recordings.samples import make_flight

numbers = st.one_of(
    st.floats(),
    st.floats(-1e3, 1e3),
    st.floats(-2e-4, 2e-4),
    st.floats(1e15, 1e17),
    st.integers(-1100, 1023).map(lambda power: math.ldexp(1.0, power)),
    st.binary(min_size=4, max_size=4).map(lambda data: struct.unpack("<f", data)[0]),
)


@given(st.lists(st.tuples(numbers, st.one_of(st.just(math.nan), st.integers(-(2**53), 2**53)))))
def test_written_as_python_writes_and_read_as_it_reads(rows: list[tuple[float, float]]) -> None:
    cells = np.array(rows, np.float64).reshape(-1, 2)
    text = write_lines(cells, np.array([False, True]))
    expected = [
        ("" if math.isnan(x) else repr(x)) + "," + ("" if math.isnan(n) else str(n))
        for x, n in rows
    ]
    assert text.decode().splitlines() == expected
    again = read_lines(text, 2)
    if np.isinf(cells).any():
        assert again is None, "line by line"
    elif rows:
        assert again is not None
        assert again.tobytes() == np.where(np.isnan(cells), np.nan, cells).tobytes()


@pytest.mark.parametrize(
    "text",
    [b"1,2\n3\n", b"1\n2,3\n", b"1,2,3,4\n", b"1,x\n", b"1,nan\n", b"1,-\n", b"-0,1\n", b"1,01\n"],
)
def test_what_is_not_so_many_plain_numbers_is_left_to_python(text: bytes) -> None:
    assert read_lines(b"5,6\n" + text, 2) is None


def some_rows(seed: int) -> list[TableRow]:
    builder = RowBuilder()
    records = make_flight(np.random.default_rng(seed), 60)
    return [row for record in records for row in builder.add(record)] + builder.flush()


@pytest.mark.parametrize("seed", range(5))
def test_a_block_is_its_rows(seed: int) -> None:
    rows = some_rows(seed)
    lines = "".join(map(row_to_line, rows)).encode()
    block = block_of(rows)
    assert encode_block(block) == lines
    assert repr([*block.events(3)]) == repr(rows)
    again = TableReader().feed_block(encode_head(TableHeader()).encode() + lines)
    assert again.cells.tobytes() == block.cells.tobytes()


def test_one_bad_line_changes_no_other() -> None:
    """Then each line is read by itself: the numbers are the same."""
    rows = some_rows(7)
    lines = [row_to_line(row).encode() for row in rows]
    mark = encode_mark(TableMark(3, "here")).encode()
    head = encode_head(TableHeader()).encode()
    text = b"".join([head, *lines[:9], b"1,2\n", mark, b"\r\n", *lines[9:]])
    block = TableReader().feed_block(text)
    assert block.cells.tobytes() == block_of(rows).cells.tobytes()
    (at_fault, fault), (at_mark, found) = block.comments
    assert (at_fault, at_mark, found) == (9, 9, TableMark(3, "here"))
    assert isinstance(fault, TableFault)
    assert (fault.line, fault.size) == (13, 4)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"time_us": "1.5"}, "time_us: 1.5"),
        ({"time_us": "9007199254740994"}, "time_us: 9007199254740994"),
        ({"time_us": ""}, "time_us is empty"),
        ({"baro_node_id": "", "baro_time_us": "5"}, "baro_node_id is empty"),
        ({"gps_fix_type": "6"}, "gps_fix_type: 6"),
        ({"nav_flags": "inf"}, "nav_flags: inf"),
    ],
)
def test_numbers_that_cannot_be_are_faults(changed: dict[str, str], reason: str) -> None:
    row = next(row for row in some_rows(1) if row.gps and row.state)
    cells = dict(zip(COLUMNS, row_to_line(row).rstrip("\n").split(","), strict=True))
    text = encode_head(TableHeader()) + ",".join((cells | changed).values()) + "\n"
    block = TableReader().feed_block(text.encode())
    assert len(block) == 0
    ((_, fault),) = block.comments
    assert isinstance(fault, TableFault)
    assert reason in fault.reason


def test_whole_numbers_that_another_program_wrote_as_floats_are_read() -> None:
    (row,) = (row for row in some_rows(2)[:1])
    text = row_to_line(row).replace(f"{row.time_us},", f"{row.time_us}.0,", 1)
    (again,) = TableReader().feed((encode_head(TableHeader(vehicle_id=3)) + text).encode())
    assert repr(again) == repr(row)
