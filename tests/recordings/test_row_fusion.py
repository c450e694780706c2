"""Rows fused many at once have the states that they have record by record through the pipeline."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import msgspec
import pytest

from gateway.aircraft import Aircraft, AircraftSettings
from gateway.estimation.select import EstimationSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.fuse import Fusion
from gateway.recordings.recorded_fusion import Replay
from gateway.recordings.recorded_table import Line, header_for
from gateway.recordings.rows import RowBuilder, TableRow, row_to_line
from gateway.recordings.table import TableEvent, TableHeader, TableNote, block_of
from gateway.records import BaroRaw, FusedSample, FusionState, GpsFix
from tests.recordings.flights import flown_table, read

DURATION_S = 25.0
BLOCK = 700


def settings_for(estimator: str) -> AircraftSettings:
    return AircraftSettings(estimation=EstimationSettings(estimator=estimator))


@cache
def flown() -> tuple[TableRow, ...]:
    """Return the rows of a flight, some of whose pressures are rows of their own."""
    rows: list[TableRow] = []
    for number, row in enumerate(read(flown_table(DURATION_S))[1]):
        if row.baro and number % 2:
            # The autopilot's state is left out where there is no sample.
            rows.append(replace(row, time_us=row.baro.time_us, gps=None, raw=None, imu=None))
        rows.append(replace(row, baro=None) if number % 2 else row)
    return tuple(rows)


def one_by_one(lines: Iterable[Line], settings: AircraftSettings) -> Iterator[TableRow]:
    """Fuse as if every record came live."""
    replay, builder = Replay(Pipeline(PipelineSettings(settings))), RowBuilder()
    for line in lines:
        for record in (record for _, out in replay.feed(line) for record in out.records):
            if isinstance(record, FusedSample | BaroRaw | GpsFix):
                yield from builder.add(record)
        yield from builder.flush()


def at_once(lines: Sequence[Line], settings: AircraftSettings) -> list[TableEvent]:
    fusion = Fusion(1, settings, follow=True)
    blocks = [block_of(lines[k : k + BLOCK]) for k in range(0, len(lines), BLOCK)]
    return [event for block in blocks for event in fusion.block(block).events(1)]


def rows_in(events: Iterable[TableEvent]) -> list[str]:
    return [row_to_line(event) for event in events if isinstance(event, TableRow)]


@pytest.mark.parametrize("estimator", ["paper", "eskf"])
def test_fusion_by_blocks_is_bit_equal_to_live_fusion(estimator: str) -> None:
    lines, settings = flown(), settings_for(estimator)
    assert any(row.raw is None for row in lines if isinstance(row, TableRow))
    assert len(lines) > 2 * BLOCK
    assert rows_in(at_once(lines, settings)) == rows_in(one_by_one(lines, settings))


def test_repeated_or_decreasing_times_are_fused_bit_equally() -> None:
    settings = settings_for("eskf")
    rows = [row for row in flown()[:900] if isinstance(row, TableRow)]
    for k, row in enumerate(rows):
        if k % 50 == 20 and row.raw is not None:
            back = msgspec.structs.replace(row.raw, time_us=row.time_us - 10_000 * (k % 3))
            rows[k] = replace(row, time_us=back.time_us, raw=back)
    first = next(row for row in rows if row.baro and row.raw)
    fix = next(row.gps for row in rows if row.gps)
    for k in range(300, 800, 100):
        time_us = rows[k].time_us
        late = TableRow(time_us, gps=msgspec.structs.replace(fix, time_us=time_us))
        rows[k:k] = [late, TableRow(time_us, baro=first.baro)]
    assert rows_in(at_once(rows, settings)) == rows_in(one_by_one(rows, settings))


def test_lines_between_rows_stay_there_and_settings_are_followed() -> None:
    lines, settings = flown(), settings_for("eskf")
    other = settings_for("paper")
    mark, header = TableNote(1, "here"), header_for(other, 1)
    begun = Aircraft(1, settings).fusion_state
    lines = [begun, *lines[:500], mark, header, *lines[500:900]]
    found = at_once(lines, settings)
    assert rows_in(found) == rows_in(one_by_one(lines, settings))
    assert [type(line) for line in found if not isinstance(line, TableRow)] == [
        FusionState, TableNote, TableHeader
    ]  # fmt: skip
    assert found[501:503] == [mark, header]
