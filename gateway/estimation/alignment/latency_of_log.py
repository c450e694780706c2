"""The GPS latency of a whole recording, by what `gps_latency` does in flight."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.compiled import address_of, array_at, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.alignment.gps_latency import (
    KNOWN_STD_S,
    LatencyState,
    begin_latency,
    close_window,
    found_latency_std,
    latency_to_use,
    watch_latency,
)
from gateway.estimation.columns import ACCEL, GPS_USABLE, GPS_VEL, GYRO, IMU_COLUMNS
from gateway.estimation.history import remember
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import as_vec, layout, new_record
from gateway.geometry.quaternion import from_rotation_vector, multiply, normalise, rotate

FLOAT: Final = np.dtype(np.float64)
INT: Final = np.dtype(np.int64)
LATENCY_LAYOUT: Final = layout(LatencyState)
LONGEST_STEP_S: Final = 0.5
"""A longer silence of the IMU is not integrated over."""


@dataclass(frozen=True, slots=True)
class GpsLatency:
    """An estimated latency and its standard deviation, s."""

    latency_s: float
    std_s: float


def estimate_latency(log: SampleLog) -> GpsLatency | None:
    """Estimate the time from the moment for which a fix is valid to its arrival.

    Parameters
    ----------
    log : SampleLog
        A whole flight; the fixes' velocities are used.

    Returns
    -------
    GpsLatency or None
        None where no manoeuvre tells it, or the fixes tell no velocity.
    """
    vel = log.gps[:, GPS_VEL : GPS_VEL + 3]
    told = (log.gps[:, GPS_USABLE] == 1.0) & np.isfinite(vel).all(axis=1)
    if not told.any() or len(log.imu_time_us) == 0:
        return None
    s = new_record(LatencyState)
    begin_latency(s, 0.0)
    parts = (log.imu_time_us, log.imu, log.gps_time_us[told], vel[told])
    arrays = [np.ascontiguousarray(part) for part in parts]
    watch_log(len(arrays[0]), len(arrays[2]), *map(address_of, (s, *arrays)))
    std_s = found_latency_std(s)
    return GpsLatency(max(float(s.found_latency_s), 0.0), std_s) if std_s < KNOWN_STD_S else None


def latency_of_flight(log: SampleLog, set_s: float) -> float:
    """Choose one latency for a whole flight, as `settle_latency` does in flight.

    Parameters
    ----------
    log : SampleLog
        A whole flight.
    set_s : float
        The latency that is set, s.

    Returns
    -------
    float
        What is set, or what the manoeuvres show where they contradict it, s.
    """
    found = estimate_latency(log)
    return set_s if found is None else latency_to_use(found.latency_s, set_s)


@EntryPoint
def watch_log(
    imu_count: int,
    gps_count: int,
    state: int,
    imu_times_us: int,
    imu_rows: int,
    gps_times_us: int,
    velocities: int,
) -> None:
    """Integrate the specific force in the gyroscope's frame, and watch every velocity."""
    s = record_at(state, LATENCY_LAYOUT)
    imu_time_us = array_at(imu_times_us, (imu_count,), INT)
    imu = array_at(imu_rows, (imu_count, IMU_COLUMNS), FLOAT)
    gps_time_us = array_at(gps_times_us, (gps_count,), INT)
    vel = array_at(velocities, (gps_count, 3), FLOAT)
    q, fixes = (1.0, 0.0, 0.0, 0.0), 0
    base_us = imu_time_us[0]
    for i in range(imu_time_us.shape[0]):
        while fixes < gps_time_us.shape[0] and gps_time_us[fixes] <= imu_time_us[i]:
            watch_latency(s, 0.0, (gps_time_us[fixes] - base_us) * 1e-6, as_vec(vel[fixes]))
            fixes += 1
        time_s = (imu_time_us[i] - base_us) * 1e-6
        dt, s.time_s = time_s - s.time_s, time_s
        g, a = imu[i, GYRO : GYRO + 3], imu[i, ACCEL : ACCEL + 3]
        told = math.isfinite(g[0] + g[1] + g[2] + a[0] + a[1] + a[2])
        if told and 0.0 < dt < LONGEST_STEP_S:
            half = from_rotation_vector((0.5 * g[0] * dt, 0.5 * g[1] * dt, 0.5 * g[2] * dt))
            q = multiply(q, half)
            f = rotate(q, (a[0], a[1], a[2]))
            for k in range(3):
                s.integrals[k] += f[k] * dt
            q = normalise(multiply(q, half))
        s.ring_count = remember(s.ring, s.ring_count, s.time_s, s.integrals)
    close_window(s)
