"""Rows of a table fused again: only sensing and estimation, many samples at once.

A flight that becomes a table needs no MAVLink, so the vehicle stage is left out, and the samples
between two heights or fixes run through the estimator together. The states are the same, bit for
bit, as if every record had arrived live.
"""

from collections.abc import Iterable, Iterator
from typing import Final

from gateway.aircraft import Aircraft
from gateway.flightlog.table.row import RowBuilder, TableRow
from gateway.flightlog.table.table import TableHeader
from gateway.flights.reading import Line
from gateway.records import FusionState
from gateway.replay import settings_of

BLOCK: Final = 1000
"""Samples that run together at most."""


class RowFusion:
    """Put new states into rows.

    Parameters
    ----------
    aircraft : Aircraft
        Fresh, with the settings to fuse with.
    follow : bool
        Whether to change settings where they were changed in flight.
    """

    def __init__(self, aircraft: Aircraft, *, follow: bool) -> None:
        self._aircraft = aircraft
        self._follow = follow
        self._builder = RowBuilder()
        self._waiting: list[TableRow] = []
        """Rows with a sample; their earlier records were processed already."""
        self.refused: list[str] = []
        """Why states of the file were not restored."""

    def rows(self, lines: Iterable[Line]) -> Iterator[Line]:
        """Yield the lines of a file, with the new states."""
        for line in lines:
            if not isinstance(line, TableRow):
                yield from self._fused()
                if self._goes_on(line):
                    yield line
                continue
            if line.baro is not None or line.gps is not None:
                yield from self._fused()
                for record in (line.baro, line.gps):
                    if record is not None:
                        self._aircraft.hear(record)
            self._waiting.append(line)
            if len(self._waiting) == BLOCK:
                yield from self._fused()
        yield from self._fused()

    def _goes_on(self, line: Line) -> bool:
        """Handle a line that is not a row; return whether it stays in the file."""
        if isinstance(line, TableHeader):
            if self._follow:
                self._aircraft.change(settings_of(line), 0)
            return self._follow
        if isinstance(line, FusionState):
            try:
                self._aircraft.restore(line)
            except ValueError as error:
                self.refused.append(str(error))
                return False
        return True

    def _fused(self) -> Iterator[TableRow]:
        samples = [row.raw or row.imu for row in self._waiting]
        fused = iter(self._aircraft.fuse([sample for sample in samples if sample is not None]))
        for row, sample in zip(self._waiting, samples, strict=True):
            for record in (row.baro, row.gps):
                if record is not None:
                    yield from self._builder.add(record)
            # A row without an IMU sample stays so.
            yield from self._builder.flush() if sample is None else self._builder.add(next(fused))
        self._waiting.clear()
