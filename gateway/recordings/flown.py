"""Read any recording as a flight that the simulated receiver sends again."""

import logging
import math
from pathlib import Path
from typing import Final

import numpy as np

from gateway.recordings.files import FlightError
from gateway.recordings.fuse import Samples, samples_of
from gateway.recordings.recorded_fusion import open_table
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recordings
from gateway.records import BaroSample
from gateway.simulator.recorded import RecordedFlight
from gateway.units import DEG_PER_DEGE7, US_PER_S, counted

log = logging.getLogger(__name__)

FIX_COLUMNS: Final = 7
"""Time, latitude, longitude, altitude, velocity."""


def open_flown(files: list[Path], options: ReadOptions) -> RecordedFlight:
    """Read a recording as a flight to be sent again.

    Raises FlightError if it contains no flight; OSError if it cannot be read at all.
    """
    table, aircraft = open_table(open_recordings(files), options)
    samples = samples_of(table.blocks, aircraft.calibration)
    for remark in table.remarks:
        log.warning(remark)
    latency_s = aircraft.estimation.reference.gps_latency_s
    found = _flight_of(samples, latency_s)
    if (count := len(found.time_s)) < 2:
        rows = counted(count, "row")
        raise FlightError(f"{files[0]}: {rows} with acceleration and rate; a flight has more")
    return found


def _flight_of(samples: Samples, latency_s: float) -> RecordedFlight:
    """Return samples as a flight; records between two samples go with the later one.

    Left out are samples that are not later than all before them, and fixes from before the start,
    which have no time on the nodes' clocks.
    """
    imu = samples.imu
    newest_us = np.maximum.accumulate(imu.time_us)
    kept = np.flatnonzero(np.diff(newest_us, prepend=newest_us[:1] - 1) > 0)
    baro_alt_m, found = np.full(len(kept), np.nan), dict[int, tuple[float, ...]]()
    for before, record in samples.aiding:
        row = int(np.searchsorted(kept, before))
        if row == len(kept):
            break
        if isinstance(record, BaroSample):
            baro_alt_m[row] = record.alt_pressure_m
        elif record.fix_ok:
            position = (record.lat_dege7 * DEG_PER_DEGE7, record.lon_dege7 * DEG_PER_DEGE7)
            # A receiver sends a complete velocity or none; speed and course are horizontal.
            north_mps, east_mps, down_mps = record.vel_n_mps
            velocity = (north_mps, east_mps, 0.0 if math.isnan(down_mps) else down_mps)
            found[row] = (record.time_us / US_PER_S, *position, record.alt_amsl_m, *velocity)
    is_usable = np.isfinite(imu.accel_b_mps2[kept] + imu.gyro_b_radps[kept]).all(axis=1)
    kept, baro_alt_m = kept[is_usable], baro_alt_m[is_usable]
    time_s = imu.time_us[kept] / US_PER_S
    begin_s = time_s.min(initial=np.inf)
    fixes = np.array([fix for fix in found.values() if fix[0] >= begin_s]).reshape(-1, FIX_COLUMNS)
    return RecordedFlight(
        time_s=time_s - begin_s,
        accel_b_mps2=imu.accel_b_mps2[kept],
        gyro_b_radps=imu.gyro_b_radps[kept],
        mag_b_ut=imu.mag_b_ut[kept],
        baro_alt_m=baro_alt_m,
        gps_time_s=np.maximum.accumulate(fixes[:, 0] - begin_s),
        gps_lat_deg=fixes[:, 1],
        gps_lon_deg=fixes[:, 2],
        gps_alt_m=fixes[:, 3],
        gps_vel_n_mps=fixes[:, 4:],
        gps_latency_s=latency_s,
    )
