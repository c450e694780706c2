"""Recorded flights smoothed from both ends, instead of the estimates made in flight."""

from collections.abc import Iterable
from typing import Any, Final

import msgspec
import numpy as np

from gateway.aircraft import AircraftSettings, make_fusion
from gateway.estimation.columns import (
    GPS_COLUMNS,
    IMU_COLUMNS,
    GpsRow,
    ImuRow,
    imu_row,
    nav_state,
)
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.kernel_record import FloatArray, IntArray
from gateway.estimation.smoothing.smoother import smooth
from gateway.flights.reading import FlightError
from gateway.records import BaroRaw, GpsFix, ImuCalibrated, ImuRaw, NavState

SMOOTHED_ESTIMATOR: Final = "eskf"
"""The filter that the smoother goes over."""


def with_smoothed_estimator(aircraft: AircraftSettings) -> AircraftSettings:
    """Choose the estimator that can be smoothed."""
    estimation = msgspec.structs.replace(aircraft.estimation, estimator=SMOOTHED_ESTIMATOR)
    return msgspec.structs.replace(aircraft, estimation=estimation)


def smooth_records(
    records: Iterable[BaroRaw | GpsFix | ImuRaw | ImuCalibrated], aircraft: AircraftSettings
) -> tuple[IntArray, FloatArray]:
    """Smooth the records of one aircraft.

    Parameters
    ----------
    records : iterable of record
        Raw or calibrated samples and fixes, in the order in which they came.
    aircraft : AircraftSettings
        Calibration, filters, and the settings of the Kalman filter.

    Returns
    -------
    time_us : ndarray, shape (n,)
        Of the IMU samples.
    states : ndarray, shape (n, NAV_COLUMNS)
        See `gateway.estimation.columns`.

    Raises
    ------
    FlightError
        If the clock went back: there is no order to smooth in.
    """
    log, estimator = gather_samples(records, aircraft)
    if np.any(np.diff(log.imu_time_us) < 0):
        raise FlightError("its clock goes back, so it cannot be smoothed; cut it there")
    return log.imu_time_us, smooth(estimator, log)


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
    records: Iterable[BaroRaw | GpsFix | ImuRaw | ImuCalibrated], aircraft: AircraftSettings
) -> tuple[SampleLog, KernelEstimator[Any, Any]]:
    """Collect a flight's records as calibrated arrays, with a fresh Kalman filter for them."""
    chain, estimator = make_fusion(with_smoothed_estimator(aircraft))
    if not isinstance(estimator, KernelEstimator):
        raise TypeError(f"{SMOOTHED_ESTIMATOR} is {type(estimator)}, which cannot be smoothed")
    imu_us: list[int] = []
    imu: list[ImuRow] = []
    baro_us: list[int] = []
    baro: list[float] = []
    gps_us: list[int] = []
    gps: list[GpsRow] = []
    for record in records:
        match record:
            case BaroRaw():
                baro_us.append(record.time_us)
                baro.append(chain.baro(record).alt_pressure_m)
            case GpsFix():
                gps_us.append(record.time_us)
                gps.append(estimator.fix_row(record))
            case ImuRaw():
                imu_us.append(record.time_us)
                imu.append(imu_row(chain.imu(record)))
            case _:
                imu_us.append(record.time_us)
                sample = chain.imu_si(
                    record.time_us,
                    record.accel_b_mps2,
                    record.gyro_b_radps,
                    record.mag_b_ut,
                    record.temperature_degc,
                    record.flags,
                )
                imu.append(imu_row(sample))
    log = SampleLog(
        imu_time_us=np.array(imu_us, np.int64),
        imu=np.array(imu, np.float64).reshape(-1, IMU_COLUMNS),
        baro_time_us=np.array(baro_us, np.int64),
        baro_alt_m=np.array(baro, np.float64),
        gps_time_us=np.array(gps_us, np.int64),
        gps=np.array(gps, np.float64).reshape(-1, GPS_COLUMNS),
    )
    return log, estimator
