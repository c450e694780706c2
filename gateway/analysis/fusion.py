"""A flight fused again, with any settings: the same code as live, on arrays where possible."""

from collections.abc import Callable

import msgspec
import numpy as np

from gateway.analysis.flight_arrays import (
    Flight,
    FlightTrack,
    FloatArray,
    FusionSettings,
    track_of_states,
)
from gateway.estimation.columns import (
    GPS_COLUMNS,
    NAV_ALT,
    NAV_COLUMNS,
    NAV_FLAGS,
    NAV_LAT,
    NAV_LON,
    NAV_QUAT,
    NAV_VEL,
    GpsRow,
    imu_rows,
    nav_row,
)
from gateway.estimation.interface import Estimator
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.select import make_estimator
from gateway.estimation.smoother.smoother import smooth
from gateway.records import NAN, BaroSample, GpsFix, NavState
from gateway.sensing.imu_log import ImuLog


def imu_log(flight: Flight) -> ImuLog:
    """Return the samples of a flight."""
    return ImuLog(
        flight.time_us,
        flight.accel_b_mps2,
        flight.gyro_b_radps,
        flight.mag_b_ut,
        np.full(len(flight.time_us), np.nan),
        flight.flags,
    )


def fuse(flight: Flight, settings: FusionSettings) -> FlightTrack:
    """Fuse a flight with the estimator selected in the settings."""
    estimator = make_estimator(settings.estimation)
    if isinstance(estimator, KernelEstimator):
        return _track_of_rows(flight, estimator.run(sample_log(flight, estimator.fix_row)))
    return track_of_states(_states_by_sample(flight, estimator))


def fuse_states(flight: Flight, settings: FusionSettings) -> FloatArray:
    """Fuse a flight, and return all outputs of the estimator.

    Returns
    -------
    ndarray, shape (N, NAV_COLUMNS)
        One row per IMU sample; see `gateway.estimation.columns`.
    """
    estimator = make_estimator(settings.estimation)
    if isinstance(estimator, KernelEstimator):
        return estimator.run(sample_log(flight, estimator.fix_row))
    states = _states_by_sample(flight, estimator)
    return np.array([nav_row(state) for state in states], np.float64).reshape(-1, NAV_COLUMNS)


def fuse_smoothed(flight: Flight, settings: FusionSettings) -> tuple[FlightTrack, float]:
    """Smooth a flight from both ends, over the Kalman filter."""
    estimation = msgspec.structs.replace(settings.estimation, estimator="eskf")
    estimator = make_estimator(estimation)
    if not isinstance(estimator, KernelEstimator):
        raise TypeError(f"{type(estimator)} cannot be smoothed")
    out, latency_s = smooth(estimator, sample_log(flight, estimator.fix_row))
    return _track_of_rows(flight, out), latency_s


def sample_log(flight: Flight, fix_row: Callable[[GpsFix], GpsRow]) -> SampleLog:
    """Lay a flight out for the compiled estimators."""
    vectors = (flight.accel_b_mps2, flight.gyro_b_radps, flight.mag_b_ut)
    imu = imu_rows(*vectors, flight.flags)
    rows = np.array([fix_row(fix) for fix in flight.fixes], np.float64)
    return SampleLog(
        imu_time_us=flight.time_us,
        imu=imu,
        baro_time_us=flight.baro_time_us,
        baro_alt_m=flight.baro_alt_m,
        gps_time_us=np.array([fix.time_us for fix in flight.fixes], np.int64),
        gps=rows.reshape(-1, GPS_COLUMNS),
    )


def _track_of_rows(flight: Flight, out: FloatArray) -> FlightTrack:
    track = FlightTrack(
        time_us=flight.time_us,
        q_nb=out[:, NAV_QUAT : NAV_QUAT + 4],
        lat_deg=out[:, NAV_LAT],
        lon_deg=out[:, NAV_LON],
        alt_amsl_m=out[:, NAV_ALT],
        vel_n_mps=out[:, NAV_VEL : NAV_VEL + 3],
    )
    return track.where_valid(out[:, NAV_FLAGS].astype(np.int64))


def _states_by_sample(flight: Flight, estimator: Estimator) -> list[NavState]:
    others: list[BaroSample | GpsFix] = [
        *flight.fixes,
        *(
            BaroSample(time_us, NAN, NAN, alt_m)
            for time_us, alt_m in zip(
                flight.baro_time_us.tolist(), flight.baro_alt_m.tolist(), strict=True
            )
        ),
    ]
    others.sort(key=lambda record: record.time_us)
    waiting = iter(others)
    record = next(waiting, None)
    states = []
    for sample in imu_log(flight).samples():
        while record is not None and record.time_us <= sample.time_us:
            if isinstance(record, GpsFix):
                estimator.update_gps(record)
            else:
                estimator.update_baro(record)
            record = next(waiting, None)
        states.append(estimator.update_imu(sample))
    return states
