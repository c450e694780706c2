"""The Kalman filter over a log, and beside it what it would have foreseen from node to node.

At each node a second state is copied off the filter and moves on by the inertial samples alone.
At the next node the two differ by what the measurements between have taught: late fixes, compass
and barometer alike, whatever the order in which they came. With the transition that the copy went
through, this is all that a smoother needs.
"""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import address_of, array_at, compiled, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.columns import (
    CLIPPED,
    GPS_COLUMNS,
    IMU_COLUMNS,
    NAV_ATTITUDE_STD,
    NAV_COLUMNS,
    NAV_FLAGS,
    NAV_POS_STD,
    NAV_VEL_STD,
    imu_vectors,
)
from gateway.estimation.eskf.covariance import apply_transition, propagate
from gateway.estimation.eskf.eskf_kernels import COVARIANCE_S, KERNELS, move, take_imu
from gateway.estimation.eskf.eskf_output import write_output, write_place
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
    BARO_BIAS,
    GYRO_BIAS,
    GYRO_SCALE,
    MAG_BIAS,
    POS,
    STATES,
    TILT,
    VEL,
    WANDER,
    EskfState,
)
from gateway.estimation.eskf.iron import board_var, standing_field_var
from gateway.estimation.flagbits import ATTITUDE_VALID, HEADING_VALID
from gateway.estimation.kernel_record import FloatArray, IntArray, as_quat, layout
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import multiply

BoolArray = NDArray[np.bool_]

SHOWN: Final = 2
FLOAT: Final = np.dtype(np.float64)
INT: Final = np.dtype(np.int64)
BOOL: Final = np.dtype(np.bool_)
STATE_LAYOUT: Final = layout(EskfState)
GAINS_LAYOUT: Final = layout(EskfGains)

take_earlier: Final = KERNELS.earlier


@compiled
def foresee(s: EskfState, p: EskfGains, F: FloatArray) -> None:
    """Propagate the copy's covariance, and the transition with it."""
    apply_transition(s, F, STATES)
    kept = math.exp(-s.pending_s / p.gps_wander_s)
    for j in range(STATES):
        for k in range(3):
            F[WANDER + k, j] *= kept
    propagate(s, p)


@compiled
def learned(s: EskfState, copy: EskfState, d: FloatArray) -> None:
    """Tell by how much the filter's state is another than the one foreseen."""
    c = as_quat(copy.q_nb)
    q = multiply(as_quat(s.q_nb), (c[0], -c[1], -c[2], -c[3]))
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    angle = 2.0 * math.atan2(sine, abs(q[0]))
    share = math.copysign(angle / sine if sine > 1e-12 else 2.0, q[0])
    north, east = displacement_m(copy.origin_lat, copy.origin_lon, s.origin_lat, s.origin_lon, 0.0)
    for k in range(3):
        d[TILT + k] = share * q[1 + k]
        d[VEL + k] = s.vel_n[k] - copy.vel_n[k]
        moved = north if k == 0 else (east if k == 1 else 0.0)
        d[POS + k] = s.pos_n[k] + moved - copy.pos_n[k]
        d[GYRO_BIAS + k] = s.gyro_bias_b[k] - copy.gyro_bias_b[k]
        d[ACCEL_BIAS + k] = s.accel_bias_b[k] - copy.accel_bias_b[k]
        d[WANDER + k] = s.wander_n[k] - copy.wander_n[k]
        d[MAG_BIAS + k] = s.mag_bias_b[k] - copy.mag_bias_b[k]
        d[GYRO_SCALE + k] = s.gyro_scale_b[k] - copy.gyro_scale_b[k]
    d[BARO_BIAS] = s.baro_bias_m - copy.baro_bias_m


@compiled
def begin_node(s: EskfState, p: EskfGains, P: FloatArray, F: FloatArray) -> None:
    """Keep the covariance of a node; the transition from it begins as none."""
    propagate(s, p)
    for i in range(STATES):
        for j in range(STATES):
            P[i, j] = s.P[i, j]
            F[i, j] = 1.0 if i == j else 0.0


@compiled
def end_node(s: EskfState, copy: EskfState, F: FloatArray, foreseen: FloatArray) -> None:
    """Keep the covariance foreseen; of what began anew the stretch's begin tells nothing.

    Nor does it of a place that follows the fixes, which is no state, nor of a scale without GPS,
    which a pass of its own has told: what is left of it is noise to a stretch.
    """
    for i in range(STATES):
        for j in range(STATES):
            foreseen[i, j] = copy.P[i, j]
    for i in range(STATES):
        shown_by_gps = POS <= i < POS + 3 or GYRO_SCALE <= i < GYRO_SCALE + 3
        unfiltered = shown_by_gps and min(s.aided, copy.aided) == 0
        if unfiltered or copy.started == 0 or s.renewals[i] != copy.renewals[i]:
            for j in range(STATES):
                F[i, j] = foreseen[i, j] = foreseen[j, i] = 0.0
            foreseen[i, i] = 1.0


@compiled
def is_renewed(s: EskfState, copy: EskfState) -> bool:
    """Return whether a part of the filter's state began anew since the copy was made."""
    for k in range(STATES):
        if s.renewals[k] != copy.renewals[k]:
            return True
    return bool(s.started != copy.started)


@compiled
def share_doubt(s: EskfState, copy: EskfState) -> None:
    """Let the copy doubt the gyroscope's bias and the iron as the filter does."""
    for k in range(3):
        copy.P[GYRO_BIAS + k, GYRO_BIAS + k] += s.bias_raised[k] - copy.bias_raised[k]
        copy.bias_raised[k] = s.bias_raised[k]
        copy.P[MAG_BIAS + k, MAG_BIAS + k] += s.iron_raised[k] - copy.iron_raised[k]
        copy.iron_raised[k] = s.iron_raised[k]


@compiled
def flag_begun(s: EskfState, row: FloatArray) -> None:
    """Flag an attitude and a heading that have begun as valid, however unsure they are."""
    flags = int(row[NAV_FLAGS])
    if s.started == 1:
        flags |= ATTITUDE_VALID
    if s.heading_known == 1 and s.heading_true == 1:
        flags |= HEADING_VALID
    row[NAV_FLAGS] = float(flags)


@compiled
def keep_unmodelled(s: EskfState, row: FloatArray) -> None:
    """Leave of the standard deviations told only what is no state and no lasting doubt."""
    for column, first in ((NAV_ATTITUDE_STD, TILT), (NAV_VEL_STD, VEL), (NAV_POS_STD, POS)):
        for k in range(3):
            beyond = row[column + k] ** 2 - s.P[first + k, first + k]
            if first + k == TILT + 2:
                beyond -= standing_field_var(s) + board_var(s)
            # NaN, which is told of what is not known, stays.
            row[column + k] = 0.0 if beyond < 0.0 else math.sqrt(beyond)


@compiled
def move_copy(s: EskfState, p: EskfGains, time_us: int, row: FloatArray, F: FloatArray) -> None:
    """Move the copy on by one IMU sample, and by nothing else."""
    dt = (time_us - s.time_us) * 1e-6
    if s.started == 0 or dt <= 0.0:
        return
    s.time_us, s.time_s = time_us, (time_us - s.base_us) * 1e-6
    gyro, accel, _ = imu_vectors(row)
    move(s, gyro, accel, row[CLIPPED], dt)
    if s.pending_s >= COVARIANCE_S:
        foresee(s, p, F)


def run_forward(
    states: NDArray[np.void],
    p: EskfGains,
    nodes: IntArray,
    imu_time_us: IntArray,
    imu: FloatArray,
    baro_time_us: IntArray,
    baro_alt_m: FloatArray,
    gps_time_us: IntArray,
    gps: FloatArray,
    out: FloatArray,
    P: FloatArray,
    F: FloatArray,
    foreseen: FloatArray,
    d: FloatArray,
    anew: BoolArray,
    shown: FloatArray,
    doubt: FloatArray,
    on_compass: FloatArray,
) -> None:
    """Run the filter, and a copy of it from each node to the next.

    Parameters
    ----------
    states : array of 2 records of EskfState
        The filter's, and memory for the copy.
    p : EskfGains
        Constants.
    nodes : ndarray of int, shape (m + 1,)
        Index of the sample at which each of m stretches begins; the end of the last.
    imu_time_us, imu, baro_time_us, baro_alt_m, gps_time_us, gps : ndarray
        See `SampleLog`.
    out : ndarray, shape (n, NAV_COLUMNS)
        Filled with what the copy tells, of the standard deviations only what is to be added to
        those of the states; see `keep_unmodelled`. Where the filter began anew, with what that
        tells: it may begin once more before the stretch ends, as lost and found.
    P, F, foreseen : ndarray, shape (m, STATES, STATES)
        Filled: the covariance at each node, the transition to the next, the covariance foreseen.
    d : ndarray, shape (m, STATES)
        Filled: what the measurements of each stretch have taught.
    anew : ndarray of bool, shape (n,)
        Filled: whether a part of the filter's state began anew in the stretch up to this sample.
    shown : ndarray, shape (m, SHOWN)
        What is known beforehand of flight without GPS, by stretch: `unaided_sq` and `flies`. Filled
        with what this pass has shown.
    doubt : ndarray, shape (m + 1,)
        Filled: `standing_field_var` at each node and at the end, rad2.
    on_compass : ndarray, shape (m + 1,)
        Filled: `compass_share` there.
    """
    log = (imu_time_us, imu, baro_time_us, baro_alt_m, gps_time_us, gps)
    samples = [np.ascontiguousarray(part) for part in log]
    arrays = (nodes, *samples, out, P, F, foreseen, d, anew, shown, doubt, on_compass)
    taken = np.zeros(2, np.int64)
    counts = (len(nodes) - 1, len(imu_time_us), len(baro_time_us), len(gps_time_us))
    forward(*counts, *map(address_of, (states, p, taken, *arrays)))


@EntryPoint
def forward(
    node_count: int,
    imu_count: int,
    baro_count: int,
    gps_count: int,
    states_at: int,
    gains: int,
    taken_at: int,
    nodes_at: int,
    imu_times_us: int,
    imu_rows: int,
    baro_times_us: int,
    baro_alts_m: int,
    gps_times_us: int,
    gps_rows: int,
    out_at: int,
    P_at: int,
    F_at: int,
    foreseen_at: int,
    d_at: int,
    anew_at: int,
    shown_at: int,
    doubt_at: int,
    on_compass_at: int,
) -> None:
    """Do `run_forward` on arrays by their addresses."""
    states, p = array_at(states_at, (2,), STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    nodes, taken = array_at(nodes_at, (node_count + 1,), INT), array_at(taken_at, (2,), INT)
    imu_time_us = array_at(imu_times_us, (imu_count,), INT)
    imu = array_at(imu_rows, (imu_count, IMU_COLUMNS), FLOAT)
    baro_time_us = array_at(baro_times_us, (baro_count,), INT)
    baro_alt_m = array_at(baro_alts_m, (baro_count,), FLOAT)
    gps_time_us = array_at(gps_times_us, (gps_count,), INT)
    gps = array_at(gps_rows, (gps_count, GPS_COLUMNS), FLOAT)
    out = array_at(out_at, (imu_count, NAV_COLUMNS), FLOAT)
    P = array_at(P_at, (node_count, STATES, STATES), FLOAT)
    F = array_at(F_at, (node_count, STATES, STATES), FLOAT)
    foreseen = array_at(foreseen_at, (node_count, STATES, STATES), FLOAT)
    d, anew = array_at(d_at, (node_count, STATES), FLOAT), array_at(anew_at, (imu_count,), BOOL)
    shown = array_at(shown_at, (node_count, SHOWN), FLOAT)
    doubt = array_at(doubt_at, (node_count + 1,), FLOAT)
    on_compass = array_at(on_compass_at, (node_count + 1,), FLOAT)
    _pass(
        states, p, taken, nodes, imu_time_us, imu, baro_time_us, baro_alt_m, gps_time_us, gps,
        out, P, F, foreseen, d, anew, shown, doubt, on_compass,
    )  # fmt: skip


@compiled
def _pass(
    states: Any,
    p: EskfGains,
    taken: IntArray,
    nodes: IntArray,
    imu_time_us: IntArray,
    imu: FloatArray,
    baro_time_us: IntArray,
    baro_alt_m: FloatArray,
    gps_time_us: IntArray,
    gps: FloatArray,
    out: FloatArray,
    P: FloatArray,
    F: FloatArray,
    foreseen: FloatArray,
    d: FloatArray,
    anew: BoolArray,
    shown: FloatArray,
    doubt: FloatArray,
    on_compass: FloatArray,
) -> None:
    """Do `run_forward`; `taken` counts the heights and the fixes that were used."""
    s, copy = states[0], states[1]
    for k in range(nodes.shape[0] - 1):
        s.unaided_sq = max(s.unaided_sq, shown[k, 0])
        s.flies = max(s.flies, int(shown[k, 1]))
        begin_node(s, p, P[k], F[k])
        doubt[k], on_compass[k] = standing_field_var(s), s.compass_share
        states[1] = states[0]
        # Whether the fixes or the velocity were wrong, the other end tells.
        copy.contradiction_mps = 0.0
        for i in range(nodes[k], nodes[k + 1]):
            now = imu_time_us[i]
            take_earlier(s, p, now, taken, baro_time_us, baro_alt_m, gps_time_us, gps)
            take_imu(s, p, now, imu[i])
            move_copy(copy, p, now, imu[i], F[k])
            share_doubt(s, copy)
            anew[i] = is_renewed(s, copy)
            told = s if anew[i] else copy
            write_output(told, out[i])
            if s.aided == 0:
                # The place is no state then: it is that of the newest fix.
                write_place(s, out[i])
            flag_begun(told, out[i])
            if not anew[i]:
                keep_unmodelled(told, out[i])
        propagate(s, p)
        foresee(copy, p, F[k])
        end_node(s, copy, F[k], foreseen[k])
        learned(s, copy, d[k])
        flown = s.aided == 0 and s.at_rest == 0
        shown[k, 0] = s.unaided_sq if flown else 0.0
        shown[k, 1] = s.flies if flown else 0.0
    last = nodes.shape[0] - 1
    doubt[last], on_compass[last] = standing_field_var(s), s.compass_share
