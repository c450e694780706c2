"""Rows keep every record, its digits and its place."""

import numpy as np
import pytest
from msgspec.structs import replace

from gateway.recordings.columns import COLUMNS, RowBuilder, TableRow, row_to_line
from gateway.recordings.table import TableEvent, TableFault, TableHeader, TableReader, encode_head
from gateway.records import FusedSample
from tests.recordings.samples import make_baro, make_fix, make_flight, make_fused


def rows_of(records: list[object]) -> list[TableRow]:
    builder = RowBuilder()
    rows = [row for record in records for row in builder.add(record)]  # type: ignore[arg-type]
    return rows + builder.flush()


def read(line: str) -> TableEvent:
    (event,) = TableReader().feed((encode_head(TableHeader(vehicle_id=3)) + line).encode())
    return event


def test_columns_are_distinct() -> None:
    assert len(set(COLUMNS)) == len(COLUMNS)


@pytest.mark.parametrize("seed", range(20))
def test_records_come_back_in_their_order(seed: int) -> None:
    records = make_flight(np.random.default_rng(seed), 50)
    flat: list[object] = []
    for row in rows_of(list(records)):
        flat += [record for record in (row.baro, row.gps, row.raw) if record is not None]
    assert flat == [r.imu if isinstance(r, FusedSample) else r for r in records]


@pytest.mark.parametrize("seed", range(20))
def test_a_line_holds_every_digit(seed: int) -> None:
    records = make_flight(np.random.default_rng(seed), 20)
    for row in rows_of(list(records)):
        line = row_to_line(row)
        assert len(line.split(",")) == len(COLUMNS)
        again = read(line)
        # NaN is not equal to itself, so whole rows are compared by what they print.
        assert repr(again) == repr(row)


def test_a_row_without_counts_keeps_the_calibrated_sample(rng: np.random.Generator) -> None:
    (row,) = RowBuilder().add(replace(make_fused(rng, 1000), imu=None))
    assert row.raw is None
    assert row.imu is not None
    again = read(row_to_line(row))
    assert repr(again) == repr(row)


def test_usual_records_share_one_row(rng: np.random.Generator) -> None:
    baro, fix, fused = make_baro(rng, 1), make_fix(rng, 2), make_fused(rng, 3)
    rows = rows_of([baro, fix, fused])
    assert [(row.time_us, row.baro, row.gps, row.raw) for row in rows] == [
        (3, baro, fix, fused.imu)
    ]


def test_calibrated_samples_without_states_make_rows_too(rng: np.random.Generator) -> None:
    (row,) = RowBuilder().add(replace(make_fused(rng, 1000), imu=None))
    assert row.imu is not None
    fix = make_fix(rng, 900)
    assert repr(rows_of([fix, row.imu])) == repr([TableRow(1000, gps=fix, imu=row.imu)])


@pytest.mark.parametrize(("column", "text"), [("time_us", "x"), ("gps_fix_type", "9")])
def test_a_cell_that_cannot_be_is_refused(rng: np.random.Generator, column: str, text: str) -> None:
    row = TableRow(5, gps=make_fix(rng, 5))
    cells = row_to_line(row).rstrip("\n").split(",")
    cells[COLUMNS.index(column)] = text
    event = read(",".join(cells) + "\n")
    assert isinstance(event, TableFault)
    assert text in event.reason
    assert column in event.reason or not text.isdigit()
