"""Rows of a table fused again: sensing and estimation alone, a block at once.

Nobody is told of a flight that becomes a table: the vehicle that would make MAVLink of the states
is left out, and all samples of a block run through the estimator together. The states are the same,
bit for bit, as if every record had come live.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from gateway.aircraft import Aircraft
from gateway.flightlog.table.cells import NODE_ID, FloatArray, has_group
from gateway.flightlog.table.row import BARO, GPS, NAV, RAW, SI
from gateway.flightlog.table.table import TableBlock, TableComment, TableHeader
from gateway.records import FusionState
from gateway.replay import heard_of, imu_log_of, settings_of


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
        self.refused: list[str] = []
        """Why states of the file were not restored."""

    def blocks(self, blocks: Iterable[TableBlock]) -> Iterator[TableBlock]:
        """Yield what a file holds, with the new states; a row that holds nothing is left out."""
        for block in blocks:
            cells = block.cells
            held = np.any([has_group(cells, group) for group in (BARO, GPS, RAW, SI)], axis=0)
            cells = cells[held]
            place_of = np.concatenate([[0], np.cumsum(held)]).tolist()
            fused: list[FloatArray] = []
            comments: list[tuple[int, TableComment]] = []
            begin = 0
            for row, comment in block.comments:
                place = place_of[row]
                if isinstance(comment, TableHeader | FusionState):
                    fused.append(self._fused(cells[begin:place]))
                    begin = place
                if self._goes_on(comment):
                    comments.append((place, comment))
            fused.append(self._fused(cells[begin:]))
            yield TableBlock(np.concatenate(fused), tuple(comments))

    def _goes_on(self, comment: TableComment) -> bool:
        """Handle a line that is not a row; return whether it stays in the file."""
        if isinstance(comment, TableHeader):
            if self._follow:
                self._aircraft.change(settings_of(comment), 0)
            return self._follow
        if isinstance(comment, FusionState):
            try:
                self._aircraft.restore(comment)
            except ValueError as error:
                self.refused.append(str(error))
                return False
        return True

    def _fused(self, cells: FloatArray) -> FloatArray:
        """Return rows with the samples as they are calibrated now, and the states of now."""
        found = cells.copy()
        has_counts = has_group(cells, RAW)
        has_sample = has_counts | has_group(cells, SI)
        samples = cells[has_sample]
        log = imu_log_of(samples, self._aircraft.chain)
        states = self._aircraft.fuse(log, heard_of(cells, self._aircraft.vehicle_id))
        # A row that stands without an IMU sample has the time of its newest record.
        told_us = np.where(has_group(cells, GPS), cells[:, GPS.start], cells[:, BARO.start])
        found[~has_sample, 0] = told_us[~has_sample]
        found[has_sample & ~has_counts, NODE_ID] = 0.0
        found[has_sample, SI] = np.column_stack(
            [log.accel_b_mps2, log.gyro_b_radps, log.mag_b_ut, log.temperature_degc]
        )
        found[:, NAV] = np.nan
        found[has_sample, NAV] = np.column_stack([samples[:, 0], states])
        return found
