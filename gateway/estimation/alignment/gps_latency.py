"""How late GPS fixes come, out of nothing but motion: GPS velocity against the accelerometer.

The specific force is summed in the gyroscope's own frame. Over a few seconds, one turn takes all
its changes from fix to fix to those of the GPS velocity, gravity added: Wahba's problem, whose
misfit is known without the turn itself [1]_. The latency is the one at which the misfit is least;
how sharp the least is tells how well it is known. Straight flight has no least.

References
----------
.. [1] F. L. Markley and J. L. Crassidis, "Fundamentals of Spacecraft Attitude Determination and
   Control", 2014, section 5.3.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.compiled.entry_point import dispatched
from gateway.estimation.columns import ACCEL, GPS_USABLE, GPS_VEL, GYRO
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import FloatArray, IntArray
from gateway.geometry.quaternion import from_rotation_vector, multiply, normalise, rotate
from gateway.units import STANDARD_GRAVITY_MPS2

BoolArray = NDArray[np.bool_]

EARLIEST_S: Final = -0.1
LATEST_S: Final = 0.6
"""No receiver is later, and none early; but the clocks of a log may be off by a little."""
STEP_S: Final = 0.01
PAIR_S: Final = 0.15
MAX_PAIR_S: Final = 1.5
"""Changes of velocity from fix to fix are compared within these intervals."""
WINDOW_S: Final = 8.0
"""For so long the gyroscope's frame holds still."""
WINDOW_PAIRS: Final = 6
"""A window of fewer says little."""
MANOEUVRE_MPS2: Final = 0.7
"""A window in which the acceleration changes by less is no manoeuvre; rms about its mean."""
KNOWN_STD_S: Final = 0.02
"""A latency that is told less well is not known."""
SHARED: Final = 2.0
"""Changes that follow one another share the noise of a velocity: they tell half as much."""
LONGEST_STEP_S: Final = 0.5
"""A longer silence of the IMU is not integrated over."""
REACH: Final = 3
"""Steps on either side of the least through which the parabola goes."""


@dataclass(frozen=True, slots=True)
class GpsLatency:
    """An estimated latency and its standard deviation, s."""

    latency_s: float
    std_s: float


@dispatched
def sum_force(time_us: IntArray, imu: FloatArray, total: FloatArray) -> None:
    """Integrate the specific force in the gyroscope's frame, m/s; `total` has shape (n, 3)."""
    q, x, y, z = (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0
    for i in range(time_us.shape[0]):
        dt = (time_us[i] - time_us[i - 1]) * 1e-6 if i > 0 else 0.0
        g, a = imu[i, GYRO : GYRO + 3], imu[i, ACCEL : ACCEL + 3]
        told = math.isfinite(g[0] + g[1] + g[2] + a[0] + a[1] + a[2])
        if told and 0.0 < dt < LONGEST_STEP_S:
            half = from_rotation_vector((0.5 * g[0] * dt, 0.5 * g[1] * dt, 0.5 * g[2] * dt))
            q = multiply(q, half)
            f = rotate(q, (a[0], a[1], a[2]))
            x, y, z = x + f[0] * dt, y + f[1] * dt, z + f[2] * dt
            q = normalise(multiply(q, half))
        total[i, 0], total[i, 1], total[i, 2] = x, y, z


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
    arrival_s, vel = log.gps_time_us[told] * 1e-6, vel[told]
    dt = np.diff(arrival_s)
    whole = (dt > PAIR_S) & (dt < MAX_PAIR_S)
    if whole.sum() < WINDOW_PAIRS or len(log.imu_time_us) == 0:
        return None
    gravity = np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
    wanted = np.diff(vel, axis=0)[whole] - gravity * dt[whole, None]
    window = (arrival_s[:-1][whole] // WINDOW_S).astype(np.int64)
    moved = _manoeuvres(wanted / dt[whole, None], window)
    if not moved.any():
        return None
    total = np.empty((len(log.imu_time_us), 3))
    sum_force(log.imu_time_us, log.imu, total)
    time_s = log.imu_time_us * 1e-6
    lags_s = np.arange(EARLIEST_S, LATEST_S + 0.5 * STEP_S, STEP_S)
    misfits = []
    for lag_s in lags_s:
        then = np.column_stack([np.interp(arrival_s - lag_s, time_s, column) for column in total.T])
        felt = np.diff(then, axis=0)[whole]
        misfits.append(_misfit(wanted[moved], felt[moved], window[moved]))
    return _least(lags_s, np.array(misfits), 3 * int(moved.sum()))


def _manoeuvres(accel: FloatArray, window: IntArray) -> BoolArray:
    """Tell which intervals lie in windows that hold enough of them, and a manoeuvre."""
    _, index, pairs = np.unique(window, return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(index, column) for column in accel.T]) / pairs[:, None]
    off = ((accel - mean[index]) ** 2).sum(axis=1)
    enough = np.bincount(index, off) / pairs > MANOEUVRE_MPS2**2
    return np.asarray((enough & (pairs >= WINDOW_PAIRS))[index])


def _misfit(wanted: FloatArray, felt: FloatArray, window: IntArray) -> float:
    """Sum the squares that are left, with the best turn in each window."""
    _, index = np.unique(window, return_inverse=True)
    count = index.max() + 1
    outer = np.zeros((count, 3, 3))
    np.add.at(outer, index, wanted[:, :, None] * felt[:, None, :])
    squares = np.bincount(index, (wanted**2 + felt**2).sum(axis=1), count)
    values = np.linalg.svd(outer, compute_uv=False)
    values[:, 2] *= np.sign(np.linalg.det(outer))
    return float((squares - 2.0 * values.sum(axis=1)).sum())


def _least(lags_s: FloatArray, misfits: FloatArray, numbers: int) -> GpsLatency | None:
    """Fit a parabola about the least misfit; None at an edge, or where it is too flat."""
    k = int(np.argmin(misfits))
    if not REACH <= k < len(lags_s) - REACH:
        return None
    near = slice(k - REACH, k + REACH + 1)
    bend, slope, _ = np.polyfit(lags_s[near] - lags_s[k], misfits[near], 2)
    if bend <= 0.0:
        return None
    std_s = math.sqrt(SHARED * misfits[k] / numbers / bend)
    latency_s = float(lags_s[k] - 0.5 * slope / bend)
    return GpsLatency(max(latency_s, 0.0), std_s) if std_s < KNOWN_STD_S else None
