"""Read any recording as a flight that the simulated receiver sends again."""

import logging
import math
from pathlib import Path
from typing import Final

import numpy as np

from gateway.recordings.columns import FloatArray
from gateway.recordings.files import FlightError
from gateway.recordings.fuse import Samples, samples_of
from gateway.recordings.recorded_fusion import aircraft_for
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recordings
from gateway.recordings.workshop.joining import joined_rows
from gateway.records import BaroSample
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

    Raises FlightError if it contains no flight; OSError if it cannot be read at all.
    """
    recordings = open_recordings(files)
    table = joined_rows(recordings, options)
    aircraft = aircraft_for(recordings[0], table, options)
    cells = _cells(samples_of(table.blocks, aircraft.calibration))
    for remark in table.remarks:
        log.warning(remark)
    latency_s = aircraft.estimation.reference.gps_latency_s
    try:
        return RecordedFlight.from_columns(dict(zip(COLUMNS, cells.T, strict=True)), latency_s)
    except ValueError as error:
        raise FlightError(f"{files[0]}: {error}") from error


def _cells(samples: Samples) -> FloatArray:
    """Return samples in the order of `COLUMNS`; records between two samples go with the later one.

    A sample that is not later than all before it is left out.
    """
    imu = samples.imu
    newest_us = np.maximum.accumulate(imu.time_us)
    kept = np.flatnonzero(np.diff(newest_us, prepend=newest_us[:1] - 1) > 0)
    cells = np.full((len(kept), len(COLUMNS)), np.nan)
    cells[:, 0] = imu.time_us[kept] / US_PER_S
    cells[:, IMU] = np.column_stack([imu.accel_b_mps2, imu.gyro_b_radps, imu.mag_b_ut])[kept]
    for before, record in samples.aiding:
        row = int(np.searchsorted(kept, before))
        if row == len(kept):
            break
        if isinstance(record, BaroSample):
            cells[row, BARO] = record.alt_pressure_m
        elif record.fix_ok:
            position = (record.lat_dege7 * DEG_PER_DEGE7, record.lon_dege7 * DEG_PER_DEGE7)
            # A receiver sends a complete velocity or none; speed and course are horizontal.
            north_mps, east_mps, down_mps = record.vel_n_mps
            velocity = (north_mps, east_mps, 0.0 if math.isnan(down_mps) else down_mps)
            cells[row, GPS:] = (record.time_us / US_PER_S, *position, record.alt_amsl_m, *velocity)
    return cells
