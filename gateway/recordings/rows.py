"""Rows of a flight, one by one.

A row is an IMU sample, the barometer and GPS records that arrived before it, and the resulting
state. Records of a row were processed in the order barometer, GPS, IMU. Where they arrived in
another order, or two of a kind arrived between two IMU samples, rows without an IMU sample are
inserted, so that the file keeps the order of all records.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from gateway.recordings.columns import (
    BARO,
    BARO_CODEC,
    GPS,
    GPS_CODEC,
    NAV,
    NAV_CODEC,
    NO_VECTOR,
    RAW,
    RAW_CODEC,
    SI,
    SI_CODEC,
    Cell,
)
from gateway.records import (
    BaroRaw,
    FusedSample,
    GpsFix,
    ImuCalibrated,
    ImuFlags,
    ImuRaw,
    NavState,
    NodeId,
)

# Cached: most rows have the same node and flags.
_node: Final = lru_cache(64)(NodeId)
_imu_flags: Final = lru_cache(256)(ImuFlags)

Imported = ImuCalibrated | BaroRaw | GpsFix | NavState
"""Records that can be read from another program's log."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row; absent values are None."""

    time_us: int
    """Time of the IMU sample, or of the newest record if there is no sample."""
    baro: BaroRaw | None = None
    gps: GpsFix | None = None
    raw: ImuRaw | None = None
    imu: ImuCalibrated | None = None
    state: NavState | None = None


def row_to_line(row: TableRow) -> str:
    """Write a row as a line: floats with all their digits, NaN and absent values as empty cells."""
    # Only NaN differs from itself.
    return ",".join(["" if c is None or c != c else repr(c) for c in cells_of(row)]) + "\n"


def cells_of(row: TableRow) -> tuple[Cell, ...]:
    """Return a row's values in the order of `COLUMNS`; None for absent ones."""
    imu = row.raw or row.imu
    node_time_us = row.raw.node_time_us if row.raw else None
    return (
        row.time_us,
        *((imu.node.node_id, node_time_us, int(imu.flags)) if imu else NO_VECTOR),
        *(RAW_CODEC.write(row.raw) if row.raw else RAW_CODEC.empty),
        *(SI_CODEC.write(row.imu) if row.imu else SI_CODEC.empty),
        *(BARO_CODEC.write(row.baro) if row.baro else BARO_CODEC.empty),
        *(GPS_CODEC.write(row.gps) if row.gps else GPS_CODEC.empty),
        *(NAV_CODEC.write(row.state) if row.state else NAV_CODEC.empty),
    )


def row_of_cells(cells: Sequence[float], vehicle_id: int) -> TableRow:
    """Make a row from the numbers of its cells, in the order of `COLUMNS`."""
    time_us = int(cells[0])
    has_raw, has_si, has_baro, has_gps, has_nav = (
        not math.isnan(cells[group.start]) for group in (RAW, SI, BARO, GPS, NAV)
    )
    head: dict[str, Any] = {}
    if has_raw or has_si:
        node, flags = _node(vehicle_id, int(cells[1])), _imu_flags(int(cells[3]))
        head = {"time_us": time_us, "node": node, "flags": flags}
    return TableRow(
        time_us=time_us,
        baro=BARO_CODEC.read(cells[BARO], vehicle_id) if has_baro else None,
        gps=GPS_CODEC.read(cells[GPS], vehicle_id) if has_gps else None,
        raw=RAW_CODEC.read(cells[RAW], node_time_us=int(cells[2]), **head) if has_raw else None,
        imu=SI_CODEC.read(cells[SI], **head) if has_si else None,
        state=NAV_CODEC.read(cells[NAV]) if has_nav else None,
    )


class RowBuilder:
    """Collect the records of one aircraft into rows."""

    def __init__(self) -> None:
        self._baro: BaroRaw | None = None
        self._gps: GpsFix | None = None
        self._state: NavState | None = None

    def add(
        self, record: BaroRaw | GpsFix | FusedSample | ImuRaw | ImuCalibrated | NavState
    ) -> list[TableRow]:
        """Process the next record and return the rows that it completes.

        A state without a sample, such as an autopilot's, is stored with the next sample.
        """
        match record:
            case BaroRaw():
                rows = self.flush() if self._baro or self._gps else []
                self._baro = record
            case GpsFix():
                rows = self.flush() if self._gps else []
                self._gps = record
            case FusedSample():
                rows = [self._row(record.imu, _calibrated(record), record.state)]
            case ImuRaw():
                rows = [self._row(record, None, None)]
            case ImuCalibrated():
                rows = [self._row(None, record, self._state)]
                self._state = None
            case NavState():
                rows, self._state = [], record
        return rows

    def _row(
        self, raw: ImuRaw | None, imu: ImuCalibrated | None, state: NavState | None
    ) -> TableRow:
        newest = raw or imu
        assert newest is not None
        row = TableRow(newest.time_us, self._baro, self._gps, raw, imu, state)
        self._baro = self._gps = None
        return row

    def flush(self) -> list[TableRow]:
        """Return the waiting records as a row without an IMU sample."""
        newest = self._gps or self._baro
        if newest is None:
            return []
        row = TableRow(newest.time_us, self._baro, self._gps)
        self._baro = self._gps = None
        return [row]


def _calibrated(fused: FusedSample) -> ImuCalibrated:
    sample = fused.sample
    return ImuCalibrated(
        sample.time_us,
        fused.imu.node if fused.imu else NodeId(fused.vehicle_id, 0),
        sample.accel_b_mps2,
        sample.gyro_b_radps,
        sample.mag_b_ut,
        sample.temperature_degc,
        fused.imu.flags if fused.imu else sample.flags,
    )
