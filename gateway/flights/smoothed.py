"""Recorded flights smoothed from both ends, instead of the estimates made in flight."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, Final

import msgspec
import numpy as np

from gateway.aircraft import AircraftSettings, make_fusion
from gateway.estimation.columns import GPS_COLUMNS, imu_rows, nav_state
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.kernel_record import FloatArray, IntArray
from gateway.estimation.smoothing.smoother import smooth
from gateway.flightlog.damaged_times import ORDER_US
from gateway.flightlog.table.cells import has_group
from gateway.flightlog.table.row import RAW, SI
from gateway.flightlog.table.table import NO_ROWS, TableBlock
from gateway.records import BaroRaw, GpsFix, NavState
from gateway.replay import calibrated_of, heard_of
from gateway.sensing.chain import SensorChain
from gateway.units import US_PER_S

SMOOTHED_ESTIMATOR: Final = "eskf"
"""The filter that the smoother goes over."""


def with_smoothed_estimator(aircraft: AircraftSettings) -> AircraftSettings:
    """Choose the estimator that can be smoothed."""
    estimation = msgspec.structs.replace(aircraft.estimation, estimator=SMOOTHED_ESTIMATOR)
    return msgspec.structs.replace(aircraft, estimation=estimation)


def smooth_blocks(
    blocks: Iterable[TableBlock], aircraft: AircraftSettings
) -> tuple[IntArray, FloatArray, float]:
    """Smooth the rows of one aircraft.

    Parameters
    ----------
    blocks : iterable of TableBlock
        In the order of the recording.
    aircraft : AircraftSettings
        Calibration, filters, and the settings of the Kalman filter.

    Returns
    -------
    time_us : ndarray, shape (n,)
        Of the IMU samples.
    states : ndarray, shape (n, NAV_COLUMNS)
        See `gateway.estimation.columns`.
    latency_s : float
        The GPS latency that was used; see `smooth`.

    Raises
    ------
    ValueError
        If the clock was set back: there is no order to smooth in.
    """
    log, estimator = gather_samples(blocks, aircraft)
    log = _in_order(log)
    return log.imu_time_us, *smooth(estimator, log)


def smoothed_latency_in_words(used_s: float, set_s: float) -> str:
    """Tell a GPS latency that a flight was smoothed with, and that was not set."""
    return (
        f"smoothed with a GPS latency of {used_s:.2f} s, which its manoeuvres show; "
        f"gps_latency_s is {set_s:.2f} s"
    )


class SmoothedStates:
    """Replace each state by the smoothed one of its time.

    Parameters
    ----------
    time_us : ndarray, shape (n,)
        In order.
    states : ndarray, shape (n, NAV_COLUMNS)
        At these times.
    """

    def __init__(self, time_us: IntArray, states: FloatArray) -> None:
        self._time_us, self._states = time_us, states

    def __call__(self, state: NavState) -> NavState:
        """Return the smoothed state of that time; a state of another time is unchanged."""
        at = int(np.searchsorted(self._time_us, state.time_us))
        if at == len(self._time_us) or self._time_us[at] != state.time_us:
            return state
        smoothed = nav_state(state.time_us, self._states[at])
        return msgspec.structs.replace(smoothed, flags=state.flags)


def gather_samples(
    blocks: Iterable[TableBlock], aircraft: AircraftSettings
) -> tuple[SampleLog, KernelEstimator[Any, Any]]:
    """Lay a flight's rows out as arrays, calibrated, for the Kalman filter, which is fresh."""
    chain, estimator = make_fusion(with_smoothed_estimator(aircraft))
    if not isinstance(estimator, KernelEstimator):
        raise TypeError(f"{SMOOTHED_ESTIMATOR} is {type(estimator)}, which cannot be smoothed")
    logs = [_sample_log(block.cells, chain, estimator) for block in blocks]
    if not logs:
        logs = [_sample_log(NO_ROWS, chain, estimator)]
    joined = [
        np.concatenate([getattr(log, field.name) for log in logs]) for field in fields(SampleLog)
    ]
    return SampleLog(*joined), estimator


def _in_order(log: SampleLog) -> SampleLog:
    """Put the samples that came late into their place."""
    if not len(log.imu_time_us):
        return log
    back_us = -np.diff(log.imu_time_us, prepend=log.imu_time_us[:1])
    sample = int(np.argmax(back_us))
    if back_us[sample] > ORDER_US:
        back_s = back_us[sample] / US_PER_S
        raise ValueError(
            f"its clock goes back by {back_s:.1f} s at IMU sample {sample + 1}, so it cannot be "
            "smoothed; cut it there, or leave out --smooth"
        )
    imu, baro, gps = (
        np.argsort(time_us, kind="stable")
        for time_us in (log.imu_time_us, log.baro_time_us, log.gps_time_us)
    )
    return SampleLog(
        log.imu_time_us[imu], log.imu[imu],
        log.baro_time_us[baro], log.baro_alt_m[baro],
        log.gps_time_us[gps], log.gps[gps],
    )  # fmt: skip


def _sample_log(
    cells: FloatArray, chain: SensorChain, estimator: KernelEstimator[Any, Any]
) -> SampleLog:
    samples = cells[has_group(cells, RAW) | has_group(cells, SI)]
    accel, gyro, mag, _, flags = calibrated_of(samples, chain)
    heard = [record for _, record in heard_of(cells, 1)]
    heights = [chain.baro(record) for record in heard if isinstance(record, BaroRaw)]
    fixes = [record for record in heard if isinstance(record, GpsFix)]
    return SampleLog(
        imu_time_us=samples[:, 0].astype(np.int64),
        imu=imu_rows(accel, gyro, mag, flags),
        baro_time_us=np.array([height.time_us for height in heights], np.int64),
        baro_alt_m=np.array([height.alt_pressure_m for height in heights], np.float64),
        gps_time_us=np.array([fix.time_us for fix in fixes], np.int64),
        gps=np.array([*map(estimator.fix_row, fixes)], np.float64).reshape(-1, GPS_COLUMNS),
    )
