"""A recorded flight from both ends: the Rauch-Tung-Striebel smoother over the Kalman filter.

Forwards the filter runs as live. Backwards, each node hears from the next by how much the
measurements from there on have moved it, as far as the two hang together [1]_. An outage is bridged
from its end as well as from its begin. Of a state that the filter began anew, as an attitude that
was lost, what came later says nothing of what was before; of the other states it still does.

Where the flight's manoeuvres contradict the GPS latency that is set, the whole flight is smoothed
with the one that they show.

A flight without GPS surprises the filter, which took it for rest or for a hand's motion up to then.
So it is run over once more, knowing of the flight beforehand.

Without any GPS, the filter learns the gyroscope's bias and scale on the way, from an assumed speed;
the compass must not tell the scale, which the gains of a smoother cannot know. So these passes
begin with the bias that the one before has ended with, and the last one takes the scale for known.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
   systems", AIAA Journal 3(8), 1965.
"""

import math
from typing import Any, Final

import numpy as np

from gateway.estimation.alignment.gps_latency import begin_certain
from gateway.estimation.alignment.latency_of_log import latency_of_flight
from gateway.estimation.alignment.wahba import SPEED_MEMORY_S
from gateway.estimation.columns import (
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
from gateway.estimation.eskf.covariance import MOVED
from gateway.estimation.eskf.eskf_output import LEVEL_VAR
from gateway.estimation.eskf.eskf_settings import LASTING_RAD, EskfGains
from gateway.estimation.eskf.eskf_state import GYRO_SCALE, POS, STATES, TILT, VEL
from gateway.estimation.eskf.unaided_velocity import WAY_S
from gateway.estimation.flagbits import ATTITUDE_VALID, HEADING_VALID, HEADING_VALID_RAD
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.kernel_record import FloatArray, IntArray, copy_record
from gateway.estimation.magfield import PLACE_RAD
from gateway.estimation.smoothing.forward import SHOWN, BoolArray, run_forward
from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import radii_m

NODE_S: Final = 0.5
"""From node to node; between them the corrections are interpolated."""
VELOCITY_CORRELATION_S: Final = 0.75
FIELD_MEMORY_S: Final = 5.0
"""What lasts is noise to a filter that forgets, and an error to one that averages over minutes:
the smoother counts fewer GPS velocities as independent, and doubts a disturbed field for longer."""
LASTING_ROUGHNESS: Final = 1.5
"""The same of vibration, which sampling folds down to slow errors: its variance counts for more."""
LEAST_VAR: Final = 1e-24
RIDGE: Final = 1e-9
"""Share of its own variance that each state foreseen is blurred by, so that all can be divided."""
BLOCK: Final = 256
"""Nodes whose gains are computed at once."""
BYTES_PER_SECOND: Final = round(3 * 8 * STATES * STATES / NODE_S)
"""Memory that a second of flight takes."""


def smooth(estimator: KernelEstimator[Any, Any], log: SampleLog) -> tuple[FloatArray, float]:
    """Smooth a whole log.

    Parameters
    ----------
    estimator : KernelEstimator
        The Kalman filter, fresh or in a state to go on from; it is left as it was.
    log : SampleLog
        At each IMU sample, the barometer samples and fixes that are not later come first. Takes
        `BYTES_PER_SECOND` of memory.

    Returns
    -------
    states : ndarray, shape (n, NAV_COLUMNS)
        One row per IMU sample. Rates and flags are the filter's, but attitude and heading are
        valid where they are sure enough as smoothed.
    latency_s : float
        The GPS latency that the whole flight was smoothed with; see `latency_of_flight`.
    """
    state, gains = estimator.state, _gains_of(estimator)
    latency_s = latency_of_flight(log, gains.gps_latency_s)
    gains.gps_latency_s = latency_s
    begin_certain(state, latency_s)
    states = np.zeros(2, np.asarray(state).dtype)
    states[0] = state
    nodes = _nodes(log.imu_time_us)
    count = len(nodes) - 1
    out = np.empty((len(log.imu_time_us), NAV_COLUMNS))
    P, F, foreseen = (np.empty((count, STATES, STATES)) for _ in range(3))
    d, anew = np.empty((count, STATES)), np.empty(len(out), np.bool_)
    shown, doubt, on_compass = np.zeros((count, SHOWN)), np.empty(count + 1), np.empty(count + 1)
    arguments = (
        states, gains, nodes,
        log.imu_time_us, log.imu, log.baro_time_us, log.baro_alt_m, log.gps_time_us, log.gps,
        out, P, F, foreseen, d, anew, shown, doubt, on_compass,
    )  # fmt: skip
    run_forward(*arguments)
    unaided = states[0]["aided_before"] == 0 and state.started == 0
    for left in range(int(shown.any()) + int(unaided), 0, -1):
        shown[:] = _hindsight(shown)
        found = states[0].copy()
        states[0] = state
        if unaided:
            _begin_with(states[0], found, scale_known=left == 1)
        run_forward(*arguments)
    smoothed = _backward(P, F, foreseen, d, states[0]["P"], on_compass)
    begins, ends, variances = (numbers[:, :MOVED] for numbers in smoothed)
    variances[:, TILT + 2] += _lasting_doubt(doubt, F) + (PLACE_RAD * on_compass) ** 2
    _correct(out, log.imu_time_us, nodes, begins, ends, variances, anew)
    return out, latency_s


def _gains_of(estimator: KernelEstimator[Any, Any]) -> EskfGains:
    """Return the filter's gains with the noises that count over minutes."""
    gains: EskfGains = copy_record(estimator.gains)
    gains.velocity_correlation_s = VELOCITY_CORRELATION_S
    gains.field_memory_s = FIELD_MEMORY_S
    gains.gyro_roughness_sq *= LASTING_ROUGHNESS
    return gains


def _begin_with(state: Any, found: Any, *, scale_known: bool) -> None:
    """Begin a pass with the gyroscope's bias, and its scale, that the one before has found.

    The bias is as unsure as ever: what is found is where to look for it.
    """
    state["gyro_bias_b"] = found["gyro_bias_b"]
    if not scale_known:
        return
    state["scale_known"] = 1
    state["gyro_scale_b"] = found["gyro_scale_b"]
    for k in range(GYRO_SCALE, GYRO_SCALE + 3):
        state["P"][k, k] = found["P"][k, k]


def _nodes(time_us: IntArray) -> IntArray:
    """Lay the nodes: indices of the first sample in each `NODE_S`, and the end."""
    if len(time_us) == 0:
        return np.zeros(1, np.int64)
    slot = (time_us - time_us[0]) // round(NODE_S * 1e6)
    firsts = np.flatnonzero(np.diff(slot, prepend=slot[0] - 1) != 0)
    return np.append(firsts, len(time_us)).astype(np.int64)


def _hindsight(shown: FloatArray) -> FloatArray:
    """Expect the speed of a flight without GPS as long before it showed as after.

    Parameters
    ----------
    shown : ndarray, shape (m, SHOWN)
        See `run_forward`.

    Returns
    -------
    ndarray, shape (m, SHOWN)
        For a second pass.
    """
    known = shown.copy()
    kept = math.exp(-NODE_S / SPEED_MEMORY_S)
    for k in range(len(known) - 2, -1, -1):
        known[k, 0] = max(known[k, 0], kept * known[k + 1, 0])
    # What shows a flight is the way of the last seconds.
    for _ in range(round(WAY_S / NODE_S)):
        known[:-1, 1] = np.maximum(known[:-1, 1], known[1:, 1])
    return known


def _lasting_doubt(doubt: FloatArray, F: FloatArray) -> FloatArray:
    """Doubt a heading as much before the field in motion contradicted it as after.

    It is one error all along, until the heading begins anew.

    Parameters
    ----------
    doubt : ndarray, shape (m + 1,)
        Variance of the heading by `standing_field_var` at each node, rad2.
    F : ndarray, shape (m, STATES, STATES)
        Transitions between the nodes.

    Returns
    -------
    ndarray, shape (m + 1,)
    """
    known = doubt.copy()
    for k in range(len(F) - 1, -1, -1):
        if F[k, TILT + 2, TILT + 2] != 0.0:
            known[k] = max(known[k], known[k + 1])
    return known


def _backward(
    P: FloatArray,
    F: FloatArray,
    foreseen: FloatArray,
    d: FloatArray,
    last_P: FloatArray,
    on_compass: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Recurse from the end, whose covariance is `last_P`.

    Changes `on_compass`, the filter's, into what is left of the smoothed heading on the compass.

    Returns
    -------
    begins : ndarray, shape (m + 1, STATES)
        By how much the filter is off at each node; zero at the end.
    ends : ndarray, shape (m, STATES)
        By how much what was foreseen for the end of each stretch is off.
    variances : ndarray, shape (m + 1, STATES)
        Smoothed, at each node.
    """
    count = len(d)
    begins, ends = np.zeros((count + 1, STATES)), np.empty((count, STATES))
    variances = np.empty((count + 1, STATES))
    later_P = last_P
    variances[count] = np.diagonal(later_P)
    for k in range(count - 1, -1, -1):
        if k % BLOCK == BLOCK - 1 or k == count - 1:
            first = k - k % BLOCK
            gains = _gains(P[first : k + 1], F[first : k + 1], foreseen[first : k + 1])
        gain = gains[k - first]
        ends[k] = d[k] + begins[k + 1]
        begins[k] = gain @ ends[k]
        on_compass[k] += gain[TILT + 2, TILT + 2] * (on_compass[k + 1] - on_compass[k])
        later_P = P[k] + gain @ (later_P - foreseen[k]) @ gain.T
        variances[k] = np.diagonal(later_P)
    return begins, ends, variances


def _gains(P: FloatArray, F: FloatArray, foreseen: FloatArray) -> FloatArray:
    """Compute `P F^T foreseen^-1` for many nodes, by correlations, which are all of one size."""
    scale = np.sqrt(np.maximum(np.diagonal(foreseen, axis1=1, axis2=2), LEAST_VAR))
    norm = foreseen / (scale[:, :, None] * scale[:, None, :]) + RIDGE * np.eye(STATES)
    gains = np.linalg.solve(norm, (F @ P) / scale[:, :, None]).transpose(0, 2, 1)
    return np.asarray(gains / scale[:, None, :])


def _correct(
    out: FloatArray,
    time_us: IntArray,
    nodes: IntArray,
    begins: FloatArray,
    ends: FloatArray,
    variances: FloatArray,
    anew: BoolArray,
) -> None:
    """Move what was foreseen by the corrections between the nodes, and tell the new accuracies.

    Those are of attitude, velocity and place.
    """
    stretch = np.repeat(np.arange(len(nodes) - 1), np.diff(nodes))
    if len(stretch) == 0:
        return
    # A stretch begins at the last sample of the one before.
    start_us = time_us[np.maximum(nodes[:-1] - 1, 0)]
    length = np.maximum(time_us[nodes[1:] - 1] - start_us, 1)
    share = ((time_us - start_us[stretch]) / length[stretch])[:, None]
    # Where something began anew there is nothing to interpolate: what is told then is the filter's.
    cut = np.add.reduceat(anew, nodes[:-1])[stretch] > 0
    share[cut, 0] = anew[cut]
    following = np.where(anew[:, None], begins[stretch + 1], ends[stretch])
    off = (1.0 - share) * begins[stretch] + share * following
    out[:, NAV_QUAT : NAV_QUAT + 4] = _turned(
        off[:, TILT : TILT + 3], out[:, NAV_QUAT : NAV_QUAT + 4]
    )
    # Without a heading, place and velocity are those of the newest fix, and no states.
    aided = np.isfinite(out[:, NAV_POS_STD])
    out[aided, NAV_VEL : NAV_VEL + 3] += off[aided, VEL : VEL + 3]
    if aided.any():
        lat_deg = float(out[np.argmax(aided), NAV_LAT])
        meridian_m, parallel_m = radii_m(lat_deg, 0.0)
        out[aided, NAV_LAT] += np.degrees(off[aided, POS] / meridian_m)
        lon_deg = out[aided, NAV_LON] + np.degrees(off[aided, POS + 1] / parallel_m)
        out[aided, NAV_LON] = wrap_180(lon_deg)
        out[aided, NAV_ALT] -= off[aided, POS + 2]
    variance = (1.0 - share) * variances[stretch] + share * variances[stretch + 1]
    variance[anew] = 0.0
    # The axes are off for a whole flight; averages do not lessen that.
    variance[:, TILT : TILT + 3] += LASTING_RAD**2
    for column, first in ((NAV_ATTITUDE_STD, TILT), (NAV_VEL_STD, VEL), (NAV_POS_STD, POS)):
        beyond = out[:, column : column + 3]
        beyond[:] = np.sqrt(beyond**2 + np.maximum(variance[:, first : first + 3], 0.0))
    attitude_std = out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3]
    flags = out[:, NAV_FLAGS].astype(np.int64)
    flags[attitude_std[:, :2].max(axis=1) >= math.sqrt(LEVEL_VAR)] &= ~ATTITUDE_VALID
    flags[attitude_std[:, 2] >= HEADING_VALID_RAD] &= ~HEADING_VALID
    out[:, NAV_FLAGS] = flags


def _turned(turn: FloatArray, q: FloatArray) -> FloatArray:
    """Turn attitudes by small rotation vectors in NED, shape (n, 3) and (n, 4)."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    w, v = np.cos(0.5 * angle), turn * (0.5 * np.sinc(0.5 * angle / math.pi))
    vector = w * q[:, 1:] + q[:, :1] * v + np.cross(v, q[:, 1:])
    scalar = w * q[:, :1] - np.sum(v * q[:, 1:], axis=1, keepdims=True)
    return np.hstack([scalar, vector])
