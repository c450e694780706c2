"""A recorded flight from both ends: the Rauch-Tung-Striebel smoother over the Kalman filter.

The filter runs forward as live. Backward, each node is corrected by the correction of the next one,
in proportion to their covariance [1]_, so an outage is bridged from its end as well. What came
before a reset is not corrected by what came after.

Where manoeuvres contradict the GPS latency that is set, the flight is smoothed with the latency
that they show.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
   systems", AIAA Journal 3(8), 1965.
"""

import math
from typing import Final

import numpy as np

from gateway.compiled import address_of
from gateway.estimation.columns import (
    ATTITUDE_VALID,
    HEADING_VALID,
    HEADING_VALID_RAD,
    NAV_ALT,
    NAV_ATTITUDE_STD,
    NAV_COLUMNS,
    NAV_FLAGS,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
    NAV_QUAT,
    NAV_VEL,
    NAV_VEL_STD,
)
from gateway.estimation.eskf.latency import begin_certain
from gateway.estimation.eskf.output import LEVEL_VALID_RAD
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import ATT, MOVING_STATES, POS, STATES, VEL
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.record import FloatArray, IntArray, copy_record
from gateway.estimation.smoother.forward import run_forward
from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import radii_m

NODE_S: Final = 0.5
"""Interval of the nodes; in between the corrections are interpolated."""
LASTING_CORRELATION_S: Final = 0.75
LASTING_VIBRATION: Final = 1.5
"""Slow errors are noise to a filter that fades, but not to averages over minutes: the smoother
counts fewer fixes as independent, and more of the vibration, which aliases to slow errors."""
AXES_RAD: Final = 0.005
"""Error of the sensor axes, which averages do not reduce: half a per cent."""
LEAST_VAR: Final = 1e-24
RIDGE: Final = 1e-9
"""Added to the correlation matrix so that it can be inverted."""
BLOCK: Final = 256
"""Nodes whose gains are computed at once."""
BYTES_PER_SECOND: Final = round(3 * 8 * STATES * STATES / NODE_S)
"""Memory for a second of flight."""


def smooth(estimator: KernelEstimator, log: SampleLog) -> tuple[FloatArray, float]:
    """Smooth a whole log.

    Parameters
    ----------
    estimator : KernelEstimator
        The Kalman filter, fresh or in a state to continue from; it is not changed.
    log : SampleLog
        At each IMU sample, the barometer samples and fixes that are not later come first. Takes
        `BYTES_PER_SECOND` of memory.

    Returns
    -------
    states : ndarray, shape (n, NAV_COLUMNS)
        One row per IMU sample. Rates are the filter's; attitude and heading are valid where their
        smoothed standard deviation allows it.
    latency_s : float
        The GPS latency that the flight was smoothed with.
    """
    gains: Gains = copy_record(estimator.gains)
    gains.gps_latency_s = latency_s = estimator.latency_of(log)
    gains.gps_correlation_s = max(gains.gps_correlation_s, LASTING_CORRELATION_S)
    gains.gyro_vibration_sq *= LASTING_VIBRATION
    state = estimator.state
    begin_certain(state, latency_s)
    states = np.zeros(2, np.asarray(state).dtype)
    states[0] = state
    nodes = _nodes(log.imu_time_us)
    count = len(nodes) - 1
    out = np.empty((len(log.imu_time_us), NAV_COLUMNS))
    P, F, predicted = (np.empty((count, STATES, STATES)) for _ in range(3))
    d, reset = np.empty((count, STATES)), np.zeros(len(out), np.uint8)
    inputs = [
        nodes, log.imu_time_us, log.imu, log.baro_time_us, log.baro_alt_m, log.gps_time_us, log.gps,
    ]  # fmt: skip
    inputs = [np.ascontiguousarray(array) for array in inputs]
    at = [address_of(array) for array in inputs]
    run_forward(
        address_of(states), address_of(gains), len(nodes), at[0],
        len(inputs[1]), at[1], at[2], len(inputs[3]), at[3], at[4], len(inputs[5]), at[5], at[6],
        *map(address_of, (out, P, F, predicted, d, reset)),
    )  # fmt: skip
    begins, ends, variances = _backward(P, F, predicted, d, states[0]["P"])
    _correct(out, log.imu_time_us, nodes, begins, ends, variances, reset != 0)
    return out, latency_s


def _nodes(time_us: IntArray) -> IntArray:
    """Return the index of the first sample in each `NODE_S`, and the end."""
    if len(time_us) == 0:
        return np.zeros(1, np.int64)
    slot = (time_us - time_us[0]) // round(NODE_S * 1e6)
    firsts = np.flatnonzero(np.diff(slot, prepend=slot[0] - 1) != 0)
    return np.append(firsts, len(time_us)).astype(np.int64)


def _backward(
    P: FloatArray, F: FloatArray, predicted: FloatArray, d: FloatArray, last_P: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Run the recursion from the end, whose covariance is `last_P`.

    Returns the corrections at the begin of each stretch and of the predictions at its end, shape
    (m + 1, STATES) and (m, STATES), and the smoothed variances, (m + 1, STATES).
    """
    count = len(d)
    begins, ends = np.zeros((count + 1, STATES)), np.empty((count, STATES))
    variances = np.empty((count + 1, STATES))
    later_P = last_P
    variances[count] = np.diagonal(later_P)
    for k in range(count - 1, -1, -1):
        if k % BLOCK == BLOCK - 1 or k == count - 1:
            first = k - k % BLOCK
            gains = _gains(P[first : k + 1], F[first : k + 1], predicted[first : k + 1])
        gain = gains[k - first]
        ends[k] = d[k] + begins[k + 1]
        begins[k] = gain @ ends[k]
        later_P = P[k] + gain @ (later_P - predicted[k]) @ gain.T
        variances[k] = np.diagonal(later_P)
    return begins, ends, variances


def _gains(P: FloatArray, F: FloatArray, predicted: FloatArray) -> FloatArray:
    """Compute `P F^T predicted^-1` for many nodes, on correlations, which are of one size."""
    scale = np.sqrt(np.maximum(np.diagonal(predicted, axis1=1, axis2=2), LEAST_VAR))
    norm = predicted / (scale[:, :, None] * scale[:, None, :]) + RIDGE * np.eye(STATES)
    gains = np.linalg.solve(norm, (F @ P) / scale[:, :, None]).transpose(0, 2, 1)
    return np.asarray(gains / scale[:, None, :])


def _correct(
    out: FloatArray,
    time_us: IntArray,
    nodes: IntArray,
    begins: FloatArray,
    ends: FloatArray,
    variances: FloatArray,
    reset: np.ndarray,
) -> None:
    """Apply the corrections between the nodes, and write the smoothed standard deviations."""
    stretch = np.repeat(np.arange(len(nodes) - 1), np.diff(nodes))
    if len(stretch) == 0:
        return
    # A stretch begins at the last sample of the one before.
    start_us = time_us[np.maximum(nodes[:-1] - 1, 0)]
    length = np.maximum(time_us[nodes[1:] - 1] - start_us, 1)
    share = ((time_us - start_us[stretch]) / length[stretch])[:, None]
    # A reset cannot be interpolated: the filter's own output is corrected as at the next node.
    cut = np.add.reduceat(reset, nodes[:-1])[stretch] > 0
    share[cut, 0] = reset[cut]
    following = np.where(reset[:, None], begins[stretch + 1], ends[stretch])
    off = (1.0 - share) * begins[stretch] + share * following
    quat = slice(NAV_QUAT, NAV_QUAT + 4)
    out[:, quat] = _rotated(off[:, ATT : ATT + 3], out[:, quat])
    # Without GPS, position and velocity are those of the newest fix, and no states.
    aided = np.isfinite(out[:, NAV_POS_STD])
    out[aided, NAV_VEL : NAV_VEL + 3] += off[aided, VEL : VEL + 3]
    if aided.any():
        lat_deg = float(out[np.argmax(aided), NAV_LAT])
        meridian_m, parallel_m = radii_m(lat_deg, 0.0)
        out[aided, NAV_LAT] += np.degrees(off[aided, POS] / meridian_m)
        lon_deg = out[aided, NAV_LON] + np.degrees(off[aided, POS + 1] / parallel_m)
        out[aided, NAV_LON] = wrap_180(lon_deg)
        out[aided, NAV_ALT] -= off[aided, POS + 2]
    variance = ((1.0 - share) * variances[stretch] + share * variances[stretch + 1])[
        :, :MOVING_STATES
    ]
    variance[reset] = 0.0
    variance[:, ATT : ATT + 3] += AXES_RAD**2
    for column, first in ((NAV_ATTITUDE_STD, ATT), (NAV_VEL_STD, VEL), (NAV_POS_STD, POS)):
        std = out[:, column : column + 3]
        std[:] = np.sqrt(std**2 + np.maximum(variance[:, first : first + 3], 0.0))
    attitude_std = out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3]
    flags = out[:, NAV_FLAGS].astype(np.int64)
    flags[attitude_std[:, :2].max(axis=1) >= LEVEL_VALID_RAD] &= ~ATTITUDE_VALID
    flags[attitude_std[:, 2] >= HEADING_VALID_RAD] &= ~HEADING_VALID
    out[:, NAV_FLAGS] = flags


def _rotated(turn: FloatArray, q: FloatArray) -> FloatArray:
    """Rotate attitudes by small rotation vectors in NED, shape (n, 3) and (n, 4)."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    w, v = np.cos(0.5 * angle), turn * (0.5 * np.sinc(0.5 * angle / math.pi))
    vector = w * q[:, 1:] + q[:, :1] * v + np.cross(v, q[:, 1:])
    scalar = w * q[:, :1] - np.sum(v * q[:, 1:], axis=1, keepdims=True)
    return np.hstack([scalar, vector])
