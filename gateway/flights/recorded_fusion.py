"""Recorded flights through the pipeline again, to rows or to the frames it would have sent."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

import msgspec

from gateway import __version__
from gateway.aircraft import Aircraft
from gateway.edges.disk.recording_streams import FileKind, kind_of, read_ends
from gateway.flightlog.table.row import TableRow
from gateway.flightlog.table.table import TableBlock, TableReader
from gateway.flightlog.tlog.stamps import Stamper
from gateway.flightlog.tlog.tlog import TlogRecord
from gateway.flights.flight_terms import FlightError
from gateway.flights.joined import joined_tables
from gateway.flights.log_facts import aircraft_for, note_smoothed_latency
from gateway.flights.reading import ReadOptions, RecordedTable, csv_reader, is_table, open_rows
from gateway.flights.row_fusion import RowFusion
from gateway.flights.smoothed import (
    SmoothedStates,
    smooth_blocks,
    with_smoothed_estimator,
)
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.records import RECORDED_ONLY, FusionState, GpsFix, NavState, Outgoing
from gateway.replay import InterpolatedPosition, Replay, header_for, heard_of

SETTLES: Final = "the state stored at the start is not used: {}; the estimator has to converge"


class RecordedFusion:
    """Flights in sequence, fused again.

    Parameters
    ----------
    files : sequence of Path
        Anything that `open_rows` reads, of one aircraft.
    options : ReadOptions
        Settings, and how to read the files.
    smooth : bool
        Return smoothed states instead of those of the filter.

    Raises
    ------
    FlightError
        If there is no flight in a file, or they do not belong together.
    """

    def __init__(
        self, files: Sequence[Path], options: ReadOptions, *, smooth: bool = False
    ) -> None:
        self._table = table = joined_tables([open_rows(file, options) for file in files])
        self._aircraft = aircraft_for(files, table, options)
        self._zero_us = table.header.unix_us_at_zero
        self._recorded = options.choice == "recorded" and is_table(files[0])
        correct: Callable[[NavState], NavState] | None = None
        if smooth:
            self._aircraft = with_smoothed_estimator(self._aircraft)
            blocks = _blocks_of(files, options)
            try:
                time_us, states, latency_s = smooth_blocks(blocks, self._aircraft)
            except ValueError as error:
                raise FlightError(f"{files[0]}: {error}") from error
            self._aircraft = note_smoothed_latency(files[0], table, self._aircraft, latency_s)
            correct = SmoothedStates(time_us, states)
        elif options.position == "interpolated":
            latency_s = self._aircraft.estimation.reference.gps_latency_s
            correct = InterpolatedPosition(_fixes_of(files, options), latency_s)
        common = PipelineSettings(self._aircraft, {}, self._zero_us or 0, correct)
        self._replay = Replay(Pipeline(common), follow=self._recorded)
        fresh = Aircraft(table.header.vehicle_id, self._aircraft, correct=correct)
        self._rows = RowFusion(fresh, follow=self._recorded)

    @property
    def remarks(self) -> list[str]:
        """Remarks about the states for the user, as far as the rows were read."""
        return [
            *(SETTLES.format(reason) for reason in (*self._replay.refused, *self._rows.refused)),
            *self._table.remarks,
        ]

    def introduction(self) -> Iterator[bytes]:
        """Yield the frames with the vehicle's version and the parameters that it is fused with."""
        vehicle = Aircraft(self._table.header.vehicle_id, self._aircraft).vehicle
        for action in vehicle.introduction():
            if isinstance(action, Outgoing):
                yield action.frame

    def frames(self) -> Iterator[TlogRecord]:
        """Yield the MAVLink that the gateway would have sent, at civil times."""
        stamper = Stamper(self._zero_us or 0)
        for row in self._table.rows:
            for now_us, action in self._replay.take(row):
                if isinstance(action, Outgoing) and action.client_id in (None, RECORDED_ONLY):
                    yield TlogRecord(stamper.stamp(now_us), action.frame)

    def table(self) -> RecordedTable:
        """Return the rows with the new states, under a head that says how they were fused."""
        blocks = self._rows.blocks(self._table.blocks)
        # The first may hold nothing but the head of the file.
        first = next((block for block in blocks if len(block) or block.comments), None)
        at_begin = [] if first is None else [c for row, c in first.comments if row == 0]
        begins_cold = not any(isinstance(comment, FusionState) for comment in at_begin[:1])
        old, new = self._table.header, header_for(self._aircraft, self._table.header.vehicle_id)
        if not self._recorded or not old.settings:
            old = msgspec.structs.replace(old, settings=new.settings, calibration=new.calibration)
        header = msgspec.structs.replace(old, mavgate_version=__version__, cold_start=begins_cold)
        return RecordedTable(header, chain([] if first is None else [first], blocks))


def end_of(file: Path, options: ReadOptions) -> int | None:
    """Return the civil time of a table's last row without reading all of it; None if unknown."""
    kind = kind_of(file)
    if kind is FileKind.OTHER:
        return None
    head, tail = read_ends(file)
    rows: list[TableRow] = []
    if kind is FileKind.CSV:
        lines = (head + tail).decode(errors="replace").splitlines()
        with suppress(ValueError):
            rows = list(csv_reader(options).rows(lines))
        zero_us = 0
    else:
        reader = TableReader()
        events = reader.feed(head + tail, final=True)
        rows = [event for event in events if isinstance(event, TableRow)]
        zero_us = (reader.header.unix_us_at_zero or 0) if reader.header else 0
    return zero_us + rows[-1].time_us if rows else None


def _blocks_of(files: Iterable[Path], options: ReadOptions) -> Iterator[TableBlock]:
    """Read all once more, before the rows or beside them."""
    quiet = replace(options, progress=None)
    return joined_tables([open_rows(file, quiet) for file in files]).blocks


def _fixes_of(files: Iterable[Path], options: ReadOptions) -> Iterator[GpsFix]:
    heard = (
        record for block in _blocks_of(files, options) for _, record in heard_of(block.cells, 1)
    )
    return (record for record in heard if isinstance(record, GpsFix))
