"""Rows keep every record, its digits and its order."""

import math
import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gateway.estimation.columns import nav_row
from gateway.recordings.columns import COLUMNS, NAV_CODEC
from gateway.recordings.rows import RowBuilder, TableRow, row_to_line
from gateway.recordings.table import (
    TableEvent,
    TableFault,
    TableHeader,
    TableNote,
    TableReader,
    block_of,
    encode_block,
    encode_head,
    encode_line,
)
from gateway.recordings.table_lines import read_lines, write_lines
from gateway.records import FusedSample
from tests.recordings.samples import (
    make_baro,
    make_fix,
    make_flight,
    make_fused,
    make_rows,
    rows_of,
)
from tools.document_columns import PAGE, with_table


def read(line: str) -> TableEvent:
    (event,) = TableReader().feed((encode_head(TableHeader(vehicle_id=3)) + line).encode())
    return event


def test_columns_are_distinct_and_the_first_and_last_are_fixed() -> None:
    assert len(set(COLUMNS)) == len(COLUMNS)
    assert (COLUMNS[0], COLUMNS[-1]) == ("time_us", "nav_flags")


@pytest.mark.parametrize("seed", range(20))
def test_records_become_rows_in_their_order_and_lines_with_every_digit(seed: int) -> None:
    records = make_flight(np.random.default_rng(seed), 50)
    rows, flat = rows_of(records), list[object]()
    for row in rows:
        flat += [record for record in (row.baro, row.gps, row.raw) if record is not None]
        newest = row.raw or row.gps or row.baro
        assert newest is None or row.time_us == newest.time_us
    assert flat == [r.imu if isinstance(r, FusedSample) else r for r in records]
    lines = [row_to_line(row) for row in rows]
    assert {len(line.split(",")) for line in lines} == {len(COLUMNS)}
    block = block_of(rows)
    assert encode_block(block) == "".join(lines).encode()
    text = (encode_head(TableHeader(vehicle_id=3)) + "".join(lines)).encode()
    assert TableReader().feed_block(text).cells.tobytes() == block.cells.tobytes()
    # NaN is not equal to itself, so whole rows are compared by what they print.
    for events in (block.events(3), TableReader().feed(text)):
        assert repr([*events]) == repr(rows)


def test_row_without_counts_keeps_the_calibrated_sample(rng: np.random.Generator) -> None:
    (row,) = RowBuilder().add(replace(make_fused(rng, 1000), imu=None))
    assert row.raw is None
    assert row.imu is not None
    assert repr(read(row_to_line(row))) == repr(row)
    fix = make_fix(rng, 900)
    assert repr(rows_of([fix, row.imu])) == repr([TableRow(1000, gps=fix, imu=row.imu)])


def test_baro_fix_and_sample_share_one_row(rng: np.random.Generator) -> None:
    baro, fix, fused = make_baro(rng, 1), make_fix(rng, 2), make_fused(rng, 3)
    (row,) = rows_of([baro, fix, fused])
    assert (row.time_us, row.baro, row.gps, row.raw) == (3, baro, fix, fused.imu)


numbers = st.one_of(
    st.floats(),
    st.floats(-1e3, 1e3),
    st.floats(-2e-4, 2e-4),
    st.floats(1e15, 1e17),
    st.integers(-1100, 1023).map(lambda power: math.ldexp(1.0, power)),
    st.binary(min_size=4, max_size=4).map(lambda data: struct.unpack("<f", data)[0]),
)


@given(st.lists(st.tuples(numbers, st.one_of(st.just(math.nan), st.integers(-(2**53), 2**53)))))
def test_numbers_are_written_and_read_as_by_python(rows: list[tuple[float, float]]) -> None:
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
def test_lines_with_unusual_cells_are_not_read_at_once(text: bytes) -> None:
    assert read_lines(b"5,6\n" + text, 2) is None


def test_invalid_line_leaves_others_unchanged() -> None:
    """Then each line is read by itself: the numbers are the same."""
    rows = make_rows(7, 60)
    lines = [row_to_line(row).encode() for row in rows]
    mark = encode_line(TableNote(3, "here")).encode()
    head = encode_head(TableHeader()).encode()
    text = b"".join([head, *lines[:9], b"1,2\n", mark, b"\r\n", *lines[9:]])
    block = TableReader().feed_block(text)
    assert block.cells.tobytes() == block_of(rows).cells.tobytes()
    (at_fault, fault), (at_mark, found) = block.comments
    assert (at_fault, at_mark, found) == (9, 9, TableNote(3, "here"))
    assert isinstance(fault, TableFault)
    assert (fault.line, fault.size) == (13, 4)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"time_us": "x"}, "'x'"),
        ({"gps_fix_type": "9"}, "gps_fix_type: 9"),
        ({"time_us": "1.5"}, "time_us: 1.5"),
        ({"time_us": "9007199254740994"}, "time_us: 9007199254740994"),
        ({"time_us": ""}, "time_us is empty"),
        ({"baro_node_id": "", "baro_time_us": "5"}, "baro_node_id is empty"),
        ({"gps_fix_type": "6"}, "gps_fix_type: 6"),
        ({"nav_flags": "inf"}, "nav_flags: inf"),
    ],
)
def test_impossible_numbers_are_faults(changed: dict[str, str], reason: str) -> None:
    row = next(row for row in make_rows(1, 60) if row.gps and row.state)
    cells = dict(zip(COLUMNS, row_to_line(row).rstrip("\n").split(","), strict=True))
    text = encode_head(TableHeader()) + ",".join((cells | changed).values()) + "\n"
    block = TableReader().feed_block(text.encode())
    assert len(block) == 0
    ((_, fault),) = block.comments
    assert isinstance(fault, TableFault)
    assert reason in fault.reason
    assert repr(TableReader().feed(text.encode())) == repr([fault])


def test_whole_number_in_float_notation_is_read_exactly() -> None:
    row = make_rows(2, 60)[0]
    text = row_to_line(row).replace(f"{row.time_us},", f"{row.time_us}.0,", 1)
    assert repr(read(text)) == repr(row)


def test_documented_columns_are_those_of_the_codec() -> None:
    page = PAGE.read_text()
    assert with_table(page) == page
    named = [name for pattern in re.findall(r"^\| [^|`]+ \| `(.+?)`", page, re.MULTILINE)
             for name in expanded(pattern)]  # fmt: skip
    assert tuple(named) == COLUMNS


def expanded(pattern: str) -> list[str]:
    """Return the columns of a pattern such as `accel_{x,y,z}_raw`."""
    found = re.fullmatch(r"(.*)\{(.*)\}(.*)", pattern)
    if found is None:
        return [pattern]
    before, parts, after = found.groups()
    return [before + part + after for part in parts.split(",")]


def test_states_have_the_order_of_the_estimators() -> None:
    state = make_fused(np.random.default_rng(1), 5).state
    assert repr([*map(float, NAV_CODEC.write(state)[1:])]) == repr(nav_row(state))
