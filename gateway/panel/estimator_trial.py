"""Comparison of all estimators on the last minutes, with the present parameters.

It runs in a separate process, so that the page is not blocked.
"""

import asyncio
import multiprocessing
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.analysis.blending import scored_error_m
from gateway.analysis.flight import (
    Flight,
    FlightTrack,
    IntArray,
    fixes_of,
    flight_of_blocks,
    fuse_track,
)
from gateway.analysis.metrics import euler_rad
from gateway.estimation.select import ESTIMATORS, EstimationSettings
from gateway.panel.state.fields import FloatArray, TimedFrames
from gateway.recordings.formats.mavlink import AutopilotReader
from gateway.recordings.fuse import FusionSettings, with_estimator
from gateway.recordings.table import TableBlock
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.sensing.calibration import NodeCalibration
from gateway.units import US_PER_S
from gateway.vehicle.services.parameters import ParameterTable

LEAST_S: Final = 20.0
"""Shortest span for a comparison, s: a shorter one shows only the convergence."""
LEAST_HZ: Final = 20.0
SHOWN_HZ: Final = 5.0


class ComparisonError(ValueError):
    """Too little data to fuse; the text names the missing data."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One estimator's result for the last minutes."""

    name: str
    time_us: IntArray
    """Time on the panel's clock."""
    roll_deg: FloatArray
    pitch_deg: FloatArray
    yaw_deg: FloatArray
    alt_amsl_m: FloatArray
    to_fixes_m: float
    """RMS of the horizontal distance to the GPS fixes, NaN without any."""


def compare(frames: TimedFrames, parameters: Mapping[str, float]) -> list[Estimate]:
    """Fuse the frames with each estimator; raises ComparisonError if the frames are too few.

    If their rate is too low over the whole time, only the newest ones are used.
    """
    settings = settings_of(parameters)
    try:
        flight, zero_us = _flight_of(frames, settings)
    except ComparisonError:
        since_us = frames[-1][0] - round((LEAST_S + 1.0) * US_PER_S) if frames else 0
        newest = [(time_us, frame) for time_us, frame in frames if time_us >= since_us]
        flight, zero_us = _flight_of(newest, settings)
    found = []
    for name in ESTIMATORS:
        track = fuse_track(flight, with_estimator(settings, name))
        found.append(_estimate(name, flight, track, zero_us))
    return found


def settings_of(parameters: Mapping[str, float]) -> FusionSettings:
    """Convert MAVLink parameters back to the settings of filters and estimators."""
    table = ParameterTable({"estimation": EstimationSettings()})
    for name, value in parameters.items():
        parameter = table.parameters.get(name)
        if parameter is None:
            continue
        try:
            table.change(parameter, value)
        except ValueError:
            # A value out of range, as from another version: use the default.
            continue
    estimation = table.sections["estimation"]
    assert isinstance(estimation, EstimationSettings)
    return FusionSettings(estimation=estimation)


async def compare_apart(frames: TimedFrames, parameters: Mapping[str, float]) -> list[Estimate]:
    """Run `compare` in a separate process."""
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    try:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(pool, compare, frames, dict(parameters))
    finally:
        # In a thread, so that waiting for the process does not block the page.
        pool.shutdown(wait=False)


def _flight_of(frames: TimedFrames, settings: FusionSettings) -> tuple[Flight, int]:
    reader = AutopilotReader()
    data = b"".join(encode_record(time_us, frame) for time_us, frame in frames)
    rows = reader.feed(TlogScanner(strict=True).feed(data, final=True))
    try:
        flight = flight_of_blocks(
            [TableBlock(rows)], NodeCalibration(), settings, name="the last minutes", description=""
        )
    except ValueError as error:
        raise ComparisonError("no sensor samples received yet") from error
    rate_hz = (len(flight.time_us) - 1) / max(flight.duration_s, 1.0 / LEAST_HZ)
    if flight.duration_s < LEAST_S or rate_hz < LEAST_HZ:
        raise ComparisonError(
            f"{flight.duration_s:.0f} s of samples at {rate_hz:.0f} Hz; "
            f"{LEAST_S:.0f} s at {LEAST_HZ:.0f} Hz are needed"
        )
    return flight, reader.unix_us_at_zero or 0


def _estimate(name: str, flight: Flight, track: FlightTrack, zero_us: int) -> Estimate:
    step = max(round(flight.rate_hz / SHOWN_HZ), 1)
    angles = np.degrees(euler_rad(track.q_nb[::step]))
    return Estimate(
        name=name,
        time_us=track.time_us[::step] + zero_us,
        roll_deg=angles[:, 0],
        pitch_deg=angles[:, 1],
        yaw_deg=angles[:, 2],
        alt_amsl_m=track.alt_amsl_m[::step],
        to_fixes_m=scored_error_m(track, flight, fixes_of(flight)),
    )
