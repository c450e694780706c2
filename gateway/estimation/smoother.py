"""The Rauch-Tung-Striebel smoother of a recorded flight, based on the Kalman filter.

The filter runs forward as live. At each node a copy of it continues with inertial samples only; at
the next node the two differ by the corrections of all measurements in between, including late fixes
in any order. Backward, each node is corrected by the correction of the next one, in proportion to
their covariance [1]_, so an outage is also bridged from its end. Data after a reset does not
correct states before it.

If manoeuvres contradict the set GPS latency, the flight is smoothed with the estimated latency.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
   systems", AIAA Journal 3(8), 1965.
"""

import math
from typing import Final

import numpy as np

from gateway.compiled import address_of, array_at, compiled, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation import columns as col
from gateway.estimation.columns import FLAG, imu_vectors
from gateway.estimation.eskf import filter as live
from gateway.estimation.eskf.latency import begin_certain
from gateway.estimation.eskf.predict import COVARIANCE_INTERVAL_S, apply_transition, propagate
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    BARO_OFFSET,
    GPS_CLIMB,
    GPS_ERROR,
    GYRO_BIAS,
    GYRO_SCALE,
    HARD_IRON,
    MAG_LATENCY,
    MOVING_STATES,
    POS,
    STATES,
    VEL,
    State,
)
from gateway.estimation.kernel import KernelEstimator, SampleLog, log_arrays
from gateway.estimation.record import FloatArray, IntArray, as_quat, copy_record
from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import displacement_m, radii_m
from gateway.geometry.quaternion import multiply

NODE_S: Final = 0.5
"""Interval of the nodes; in between the corrections are interpolated."""
LASTING_CORRELATION_S: Final = 0.75
LASTING_VIBRATION: Final = 1.5
"""Factors for slow errors, which are noise to a fading filter but not to averages over minutes: the
smoother counts fewer fixes as independent, and more of the vibration, which aliases to slow
errors."""
SMOOTHED_IRON: Final = 1.0 / 3.0
"""Share of the initial hard iron: smoothing would also attribute the errors of soft iron to it."""
AXES_RAD: Final = 0.005
"""Error of the sensor axes, half a per cent, which averages do not reduce."""
LEAST_VAR: Final = 1e-24
RIDGE: Final = 1e-9
"""Added to the correlation matrix so that it can be inverted."""
RESET: Final = 1
AIDED: Final = 2
"""Bits of a sample: the filter was reset since the last node; position and velocity are states."""
BLOCK: Final = 256
"""Number of nodes whose gains are computed at once."""

STATE_SIZE: Final = live.STATE_LAYOUT.itemsize
MATRIX: Final = STATES * STATES
BYTE: Final = np.dtype(np.uint8)


@compiled
def predict_copy(s: State, p: Gains, F: FloatArray) -> None:
    """Propagate the copy's covariance and the transition."""
    apply_transition(s, F, STATES)
    kept = math.exp(-s.pending_s / p.gps_error_s)
    climb_kept = math.exp(-s.pending_s / p.gps_climb_error_s)
    for j in range(STATES):
        for k in range(3):
            F[GPS_ERROR + k, j] *= kept
        F[GPS_CLIMB, j] *= climb_kept
    propagate(s, p)


@compiled
def correction(s: State, copy: State, d: FloatArray) -> None:
    """Write the filter's state minus the copy's, as errors."""
    c = as_quat(copy.q_nb)
    q = multiply(as_quat(s.q_nb), (c[0], -c[1], -c[2], -c[3]))
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    angle = 2.0 * math.atan2(sine, abs(q[0]))
    share = math.copysign(angle / sine if sine > 1e-12 else 2.0, q[0])
    north, east = displacement_m(copy.origin[0], copy.origin[1], s.origin[0], s.origin[1], 0.0)
    for k in range(3):
        d[ATT + k] = share * q[1 + k]
        d[VEL + k] = s.vel_n[k] - copy.vel_n[k]
        moved = north if k == 0 else (east if k == 1 else 0.0)
        d[POS + k] = s.pos_n[k] + moved - copy.pos_n[k]
        d[GYRO_BIAS + k] = s.gyro_bias_b[k] - copy.gyro_bias_b[k]
        d[ACCEL_BIAS + k] = s.accel_bias_b[k] - copy.accel_bias_b[k]
        d[GPS_ERROR + k] = s.gps_error_n[k] - copy.gps_error_n[k]
        d[HARD_IRON + k] = s.hard_iron_b[k] - copy.hard_iron_b[k]
        d[GYRO_SCALE + k] = s.gyro_scale_b[k] - copy.gyro_scale_b[k]
    d[BARO_OFFSET] = s.baro_offset_m - copy.baro_offset_m
    d[MAG_LATENCY] = s.mag_latency_s - copy.mag_latency_s
    d[GPS_CLIMB] = s.gps_climb_error_mps - copy.gps_climb_error_mps


@compiled
def end_stretch(s: State, copy: State, F: FloatArray, predicted: FloatArray) -> None:
    """Write the predicted covariance, and clear the transition of states that were reset.

    The same applies to states that are not estimated without GPS: velocity, position, and states
    that are only considered then.
    """
    unaided = min(s.aided, copy.aided) == 0
    for i in range(STATES):
        for j in range(STATES):
            predicted[i, j] = copy.P[i, j]
    for i in range(STATES):
        unestimated = VEL <= i < POS + 3 or ACCEL_BIAS <= i < ACCEL_BIAS + 3
        unestimated = unestimated or GYRO_SCALE <= i < GYRO_SCALE + 3
        if copy.started == 0 or s.resets[i] != copy.resets[i] or (unaided and unestimated):
            for j in range(STATES):
                F[i, j] = predicted[i, j] = predicted[j, i] = 0.0
            predicted[i, i] = 1.0


@compiled
def move_copy(s: State, p: Gains, time_us: int, row: FloatArray, used: bool, F: FloatArray) -> None:
    """Advance the copy by one IMU sample, if the filter has used it."""
    if s.started == 0 or time_us <= s.time_us:
        return
    s.time_us, s.time_s = time_us, (time_us - s.base_us) * 1e-6
    if not used:
        return
    gyro, accel, _ = imu_vectors(row)
    dt, s.imu_s = s.time_s - s.imu_s, s.time_s
    live.move(s, p, gyro, accel, row[col.CLIPPED], dt)
    if s.pending_s >= COVARIANCE_INTERVAL_S:
        predict_copy(s, p, F)


@compiled
def share_raised(s: State, copy: State) -> bool:
    """Raise the variances of the copy like the filter's; return whether the filter was reset."""
    reset = s.started != copy.started
    for k in range(STATES):
        copy.P[k, k] += s.raised[k] - copy.raised[k]
        copy.raised[k] = s.raised[k]
        reset = reset or s.resets[k] != copy.resets[k]
    return reset


@compiled
def write_row(s: State, copy: State, p: Gains, reset: bool, row: FloatArray) -> None:
    """Write the prediction, and the part of its standard deviations beyond the covariance.

    After a reset of the filter, its own output is written.
    """
    chosen = s if reset else copy
    live.write_output(chosen, p, row)
    if s.aided == 0:
        live.write_position(s, p, row)
    flags = int(row[col.NAV_FLAGS]) | (FLAG.ATTITUDE_VALID if chosen.started == 1 else 0)
    if chosen.heading_known == 1 and chosen.heading_true == 1:
        flags |= FLAG.HEADING_VALID
    row[col.NAV_FLAGS] = float(flags)
    if reset:
        return
    for k in range(3 if s.aided == 0 else MOVING_STATES):
        # The columns of attitude, velocity and position follow one another like the states.
        row[col.NAV_ATTITUDE_STD + k] = beyond(row[col.NAV_ATTITUDE_STD + k], copy.P[k, k])


@compiled
def beyond(std: float, variance: float) -> float:
    """Return the part of a standard deviation beyond a variance; NaN stays."""
    rest = std * std - variance
    return 0.0 if rest < 0.0 else math.sqrt(rest)


@EntryPoint
def run_forward(
    states: int,
    gains: int,
    log_at: int,
    node_count: int,
    nodes_at: int,
    outputs: int,
    covariances: int,
    transitions: int,
    predictions: int,
    corrections: int,
    marks_at: int,
) -> None:
    """Run the filter, and a copy of it from each node to the next; all arguments are addresses.

    `states` are two records, `nodes` the index of the first sample of each interval and the end.
    Outputs are the rows; for each interval the covariance at its begin, the transition, the
    predicted covariance and the correction; for each sample the bits `RESET` and `AIDED`.
    """
    s = record_at(states, live.STATE_LAYOUT)
    copy = record_at(states + STATE_SIZE, live.STATE_LAYOUT)
    both = array_at(states, (2, STATE_SIZE), BYTE)
    p = record_at(gains, live.GAINS_LAYOUT)
    log = record_at(log_at, live.LOG_LAYOUT)
    nodes = array_at(nodes_at, (node_count,), live.INT)
    imu_time_us = array_at(log.imu_time_us, (log.imu_count,), live.INT)
    marks = array_at(marks_at, (log.imu_count,), BYTE)
    baros = fixes = 0
    for k in range(node_count - 1):
        P = array_at(covariances + 8 * k * MATRIX, (STATES, STATES), live.FLOAT)
        F = array_at(transitions + 8 * k * MATRIX, (STATES, STATES), live.FLOAT)
        propagate(s, p)
        for i in range(STATES):
            for j in range(STATES):
                P[i, j] = s.P[i, j]
                F[i, j] = 1.0 if i == j else 0.0
        for i in range(STATE_SIZE):
            both[1, i] = both[0, i]
        for i in range(nodes[k], nodes[k + 1]):
            now_us, row = imu_time_us[i], live.row_at(log.imu, i, col.IMU_COLUMNS)
            baros, fixes = live.update_aiding(s, p, log, now_us, baros, fixes)
            s.blend_n[:] = 0.0
            live.update_imu(s, p, now_us, row)
            move_copy(copy, p, now_us, row, s.imu_s == s.time_s, F)
            reset = share_raised(s, copy)
            marks[i] = (RESET if reset else 0) | (AIDED if s.aided == 1 else 0)
            write_row(s, copy, p, reset, live.row_at(outputs, i, col.NAV_COLUMNS))
        propagate(s, p)
        predict_copy(copy, p, F)
        predicted = array_at(predictions + 8 * k * MATRIX, (STATES, STATES), live.FLOAT)
        end_stretch(s, copy, F, predicted)
        correction(s, copy, live.row_at(corrections, k, STATES))


def smooth(estimator: KernelEstimator, log: SampleLog) -> tuple[FloatArray, float]:
    """Smooth a whole log.

    Parameters
    ----------
    estimator : KernelEstimator
        The Kalman filter, new or in a state to continue from; it is not changed.
    log : SampleLog
        Before each IMU sample, the barometer samples and fixes that are not later are used. A
        second of flight takes 32 kB of memory.

    Returns
    -------
    states : ndarray, shape (n, NAV_COLUMNS)
        One row per IMU sample. Rates are those of the filter; attitude and heading are valid if
        their smoothed standard deviation is small enough.
    latency_s : float
        The GPS latency with which the flight was smoothed.
    """
    gains: Gains = copy_record(estimator.gains)
    gains.gps_latency_s = latency_s = estimator.latency_of(log)
    gains.gps_correlation_s = max(gains.gps_correlation_s, LASTING_CORRELATION_S)
    gains.gyro_vibration_sq *= LASTING_VIBRATION
    gains.hard_iron_var *= SMOOTHED_IRON**2
    state = estimator.state
    if state.started == 0:
        state.P[HARD_IRON : HARD_IRON + 3] *= SMOOTHED_IRON**2
    begin_certain(state, latency_s)
    states = np.zeros(2, np.asarray(state).dtype)
    states[0] = state
    nodes = _nodes(log.imu_time_us)
    count = len(nodes) - 1
    out = np.empty((len(log.imu_time_us), col.NAV_COLUMNS))
    P, F, predicted = (np.empty((count, STATES, STATES)) for _ in range(3))
    d, marks = np.empty((count, STATES)), np.zeros(len(out), np.uint8)
    log, arrays = log_arrays(log)
    run_forward(
        address_of(states),
        address_of(gains),
        address_of(arrays),
        len(nodes),
        *map(address_of, (nodes, out, P, F, predicted, d, marks)),
    )
    begins, ends, variances = _backward(P, F, predicted, d, states[0]["P"])
    _correct(out, log.imu_time_us, nodes, begins, ends, variances, marks)
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
    """Run the recursion from the end, where the covariance is `last_P`.

    Returns the corrections at the begin of each interval and of the predictions at its end, shape
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
    """Compute `P F^T predicted^-1` for many nodes, from correlations, which have one magnitude."""
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
    marks: np.ndarray,
) -> None:
    """Apply the corrections between the nodes, and write the smoothed standard deviations."""
    stretch = np.repeat(np.arange(len(nodes) - 1), np.diff(nodes))
    if len(stretch) == 0:
        return
    # An interval begins at the last sample of the previous one.
    start_us = time_us[np.maximum(nodes[:-1] - 1, 0)]
    length = np.maximum(time_us[nodes[1:] - 1] - start_us, 1)
    share = ((time_us - start_us[stretch]) / length[stretch])[:, None]
    reset, aided = (marks & RESET) != 0, (marks & AIDED) != 0
    # A reset cannot be interpolated: the filter's output gets the correction of the next node.
    cut = np.add.reduceat(reset, nodes[:-1])[stretch] > 0
    share[cut, 0] = reset[cut]
    following = np.where(reset[:, None], begins[stretch + 1], ends[stretch])
    off = (1.0 - share) * begins[stretch] + share * following
    quat = slice(col.NAV_QUAT, col.NAV_QUAT + 4)
    out[:, quat] = _rotated(off[:, ATT : ATT + 3], out[:, quat])
    # Without GPS, position and velocity are those of the newest fix, and not states.
    out[aided, col.NAV_VEL : col.NAV_VEL + 3] += off[aided, VEL : VEL + 3]
    if aided.any():
        lat_deg = float(out[np.argmax(aided), col.NAV_LAT])
        meridian_m, parallel_m = radii_m(lat_deg, 0.0)
        out[aided, col.NAV_LAT] += np.degrees(off[aided, POS] / meridian_m)
        lon_deg = out[aided, col.NAV_LON] + np.degrees(off[aided, POS + 1] / parallel_m)
        out[aided, col.NAV_LON] = wrap_180(lon_deg)
        out[aided, col.NAV_ALT] -= off[aided, POS + 2]
    smoothed = (1.0 - share) * variances[stretch] + share * variances[stretch + 1]
    variance = np.where(reset[:, None], 0.0, np.maximum(smoothed[:, :MOVING_STATES], 0.0))
    variance[:, ATT : ATT + 3] += AXES_RAD**2
    # The columns of attitude, velocity and position follow one another like the states.
    columns = out[:, col.NAV_ATTITUDE_STD : col.NAV_ATTITUDE_STD + MOVING_STATES]
    std = np.hypot(columns, np.sqrt(variance))
    attitude_std = columns[:, :3] = std[:, :3]
    columns[aided, 3:] = std[aided, 3:]
    flags = out[:, col.NAV_FLAGS].astype(np.int64)
    # NaN, before the start of the filter, compares false.
    flags[~(attitude_std[:, :2].max(axis=1) < live.LEVEL_VALID_RAD)] &= ~FLAG.ATTITUDE_VALID
    flags[~(attitude_std[:, 2] < col.HEADING_VALID_RAD)] &= ~FLAG.HEADING_VALID
    out[:, col.NAV_FLAGS] = flags


def _rotated(turn: FloatArray, q: FloatArray) -> FloatArray:
    """Rotate attitudes by small rotation vectors in NED, shape (n, 3) and (n, 4)."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    w, v = np.cos(0.5 * angle), turn * (0.5 * np.sinc(0.5 * angle / math.pi))
    vector = w * q[:, 1:] + q[:, :1] * v + np.cross(v, q[:, 1:])
    scalar = w * q[:, :1] - np.sum(v * q[:, 1:], axis=1, keepdims=True)
    return np.hstack([scalar, vector])
