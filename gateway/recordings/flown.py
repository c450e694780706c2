"""Any recording as a flight that the simulated receiver sends again."""

import logging
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from gateway.aircraft import AircraftSettings
from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.recordings.columns import TableRow
from gateway.recordings.files import FlightError
from gateway.recordings.reading import ReadOptions, joined_tables, open_rows
from gateway.recordings.recorded_fusion import aircraft_for
from gateway.records import ImuCalibrated
from gateway.sensing.chain import SensorChain
from gateway.simulator.recorded import RecordedFlight
from gateway.units import DEG_PER_DEGE7, US_PER_S

log = logging.getLogger(__name__)

COLUMNS: Final = (
    *("time_s", "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "baro_alt_m"),
    *("gps_time_s", "gps_lat", "gps_lon", "gps_alt_m", "gps_vn", "gps_ve", "gps_vd"),
)
BARO: Final = COLUMNS.index("baro_alt_m")
GPS: Final = COLUMNS.index("gps_time_s")
IMU: Final = slice(1, BARO)


def open_flown(files: list[Path], options: ReadOptions) -> RecordedFlight:
    """Read a recording as a flight to be sent again.

    Raises FlightError if there is no flight in it; OSError if it cannot be read at all.
    """
    table = joined_tables([open_rows(file, options) for file in files])
    aircraft = aircraft_for(files, table, options)
    cells = _cells(table.plain_rows, aircraft)
    for remark in table.remarks:
        log.warning(remark)
    latency_s = aircraft.estimation.reference.gps_latency_s
    columns = np.array(cells, float).reshape(-1, len(COLUMNS))
    try:
        return RecordedFlight.from_columns(dict(zip(COLUMNS, columns.T, strict=True)), latency_s)
    except ValueError as error:
        raise FlightError(f"{files[0]}: {error}") from error


def _cells(rows: Iterable[TableRow], aircraft: AircraftSettings) -> list[list[float]]:
    """Return rows in the order of `COLUMNS`; records between two samples are in the later one."""
    chain = SensorChain(aircraft.calibration)
    found: list[list[float]] = []
    cells = [math.nan] * len(COLUMNS)
    for row in rows:
        if row.baro is not None:
            cells[BARO] = pressure_altitude_m(row.baro.pressure_pa)
        if (fix := row.gps) is not None and fix.fix_ok:
            place = (fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7)
            north_mps, east_mps, down_mps = fix.vel_n_mps
            if math.isnan(down_mps):
                # A receiver sends a whole velocity or none; speed and course are of a level one.
                down_mps = 0.0
            velocity = (north_mps, east_mps, down_mps)
            cells[GPS:] = (fix.time_us / US_PER_S, *place, fix.alt_amsl_m, *velocity)
        imu = _imu(row, chain)
        if imu is None or (found and row.time_us / US_PER_S <= found[-1][0]):
            continue
        cells[0] = row.time_us / US_PER_S
        cells[IMU] = [*imu[0], *imu[1], *(imu[2] or (math.nan,) * 3)]
        found.append(cells)
        cells = [math.nan] * len(COLUMNS)
    return found


def _imu(
    row: TableRow, chain: SensorChain
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...] | None] | None:
    sample: ImuCalibrated | None = row.imu
    if sample is not None:
        return sample.accel_b_mps2, sample.gyro_b_radps, sample.mag_b_ut
    if row.raw is None:
        return None
    made = chain.imu(row.raw)
    return made.accel_b_mps2, made.gyro_b_radps, made.mag_b_ut
