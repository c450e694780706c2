"""Forward pass of the smoother: the filter, and its prediction from node to node.

At each node a copy of the filter continues by inertial samples alone. At the next node the two
differ by the corrections of all measurements in between, late fixes included, in whatever order
they came. With the transition of the copy, a Rauch-Tung-Striebel smoother needs nothing else.
"""

import math
from typing import Final

import numpy as np

from gateway.compiled import array_at, compiled, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.columns import (
    ATTITUDE_VALID,
    CLIPPED,
    GPS_COLUMNS,
    HEADING_VALID,
    IMU_COLUMNS,
    NAV_ATTITUDE_STD,
    NAV_COLUMNS,
    NAV_FLAGS,
    NAV_POS_STD,
    NAV_VEL_STD,
    imu_vectors,
)
from gateway.estimation.eskf.filter import (
    FLOAT,
    GAINS_LAYOUT,
    INT,
    STATE_LAYOUT,
    move,
    row_at,
    take_baro,
    take_imu,
)
from gateway.estimation.eskf.fixes import take_gps
from gateway.estimation.eskf.output import write_output, write_position
from gateway.estimation.eskf.predict import COVARIANCE_S, apply_transition, propagate
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    BARO_OFFSET,
    GPS_ERROR,
    GYRO_BIAS,
    GYRO_SCALE,
    HARD_IRON,
    MAG_LATENCY,
    POS,
    STATES,
    VEL,
    State,
)
from gateway.estimation.record import FloatArray, as_quat
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import multiply

STATE_SIZE: Final = STATE_LAYOUT.itemsize
MATRIX: Final = STATES * STATES
BYTE: Final = np.dtype(np.uint8)


@compiled
def predict_copy(s: State, p: Gains, F: FloatArray) -> None:
    """Propagate the copy's covariance and the transition."""
    apply_transition(s, F, STATES)
    kept = math.exp(-s.pending_s / p.gps_error_s)
    for j in range(STATES):
        for k in range(3):
            F[GPS_ERROR + k, j] *= kept
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


@compiled
def end_stretch(s: State, copy: State, F: FloatArray, predicted: FloatArray) -> None:
    """Write the predicted covariance, and cut the transition of states that were reset.

    So are states that are not estimated without GPS: velocity and position, and what is only
    considered then.
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
def is_reset(s: State, copy: State) -> bool:
    """Return whether a part of the filter has been reset since the copy was made."""
    for k in range(STATES):
        if s.resets[k] != copy.resets[k]:
            return True
    return bool(s.started != copy.started)


@compiled
def move_copy(s: State, p: Gains, time_us: int, row: FloatArray, used: bool, F: FloatArray) -> None:
    """Move the copy by one IMU sample, if the filter has used it."""
    if s.started == 0 or time_us <= s.time_us:
        return
    s.time_us, s.time_s = time_us, (time_us - s.base_us) * 1e-6
    if not used:
        return
    gyro, accel, _ = imu_vectors(row)
    dt, s.imu_s = s.time_s - s.imu_s, s.time_s
    move(s, p, gyro, accel, row[CLIPPED], dt)
    if s.pending_s >= COVARIANCE_S:
        predict_copy(s, p, F)


@compiled
def share_raised(s: State, copy: State) -> None:
    """Raise variances of the copy as those of the filter."""
    for k in range(STATES):
        copy.P[k, k] += s.raised[k] - copy.raised[k]
        copy.raised[k] = s.raised[k]


@compiled
def write_row(s: State, copy: State, p: Gains, reset: bool, row: FloatArray) -> None:
    """Write the prediction, and of its standard deviations what the covariance does not contain.

    Where the filter was reset, its own output stands.
    """
    chosen = s if reset else copy
    write_output(chosen, p, row)
    if s.aided == 0:
        write_position(s, row)
    flags = int(row[NAV_FLAGS]) | (ATTITUDE_VALID if chosen.started == 1 else 0)
    if chosen.heading_known == 1 and chosen.heading_true == 1:
        flags |= HEADING_VALID
    row[NAV_FLAGS] = float(flags)
    if reset:
        return
    for k in range(3):
        row[NAV_ATTITUDE_STD + k] = beyond(row[NAV_ATTITUDE_STD + k], copy.P[ATT + k, ATT + k])
        row[NAV_VEL_STD + k] = beyond(row[NAV_VEL_STD + k], copy.P[VEL + k, VEL + k])
        row[NAV_POS_STD + k] = beyond(row[NAV_POS_STD + k], copy.P[POS + k, POS + k])


@compiled
def beyond(std: float, variance: float) -> float:
    """Return the part of a standard deviation beyond a variance; NaN stays."""
    rest = std * std - variance
    return 0.0 if rest < 0.0 else math.sqrt(rest)


@EntryPoint
def run_forward(
    states: int,
    gains: int,
    node_count: int,
    nodes_at: int,
    imu_count: int,
    imu_times_us: int,
    imu_rows: int,
    baro_count: int,
    baro_times_us: int,
    baro_alts_m: int,
    gps_count: int,
    gps_times_us: int,
    gps_rows: int,
    outputs: int,
    covariances: int,
    transitions: int,
    predictions: int,
    corrections: int,
    resets: int,
) -> None:
    """Run the filter, and a copy of it from each node to the next; all arguments are addresses.

    `states` are two records, `nodes` the index of the first sample of each stretch and the end.
    Written are the output rows, and by stretch the covariance at its begin, the transition, the
    predicted covariance and the correction; by sample whether the filter was reset.
    """
    s = record_at(states, STATE_LAYOUT)
    copy = record_at(states + STATE_SIZE, STATE_LAYOUT)
    both = array_at(states, (2, STATE_SIZE), BYTE)
    p = record_at(gains, GAINS_LAYOUT)
    nodes = array_at(nodes_at, (node_count,), INT)
    imu_time_us = array_at(imu_times_us, (imu_count,), INT)
    baro_time_us = array_at(baro_times_us, (baro_count,), INT)
    baro_alt_m = array_at(baro_alts_m, (baro_count,), FLOAT)
    gps_time_us = array_at(gps_times_us, (gps_count,), INT)
    was_reset = array_at(resets, (imu_count,), BYTE)
    baros = fixes = 0
    for k in range(node_count - 1):
        P = array_at(covariances + 8 * k * MATRIX, (STATES, STATES), FLOAT)
        F = array_at(transitions + 8 * k * MATRIX, (STATES, STATES), FLOAT)
        propagate(s, p)
        for i in range(STATES):
            for j in range(STATES):
                P[i, j] = s.P[i, j]
                F[i, j] = 1.0 if i == j else 0.0
        for i in range(STATE_SIZE):
            both[1, i] = both[0, i]
        for i in range(nodes[k], nodes[k + 1]):
            now_us, row = imu_time_us[i], row_at(imu_rows, i, IMU_COLUMNS)
            while baros < baro_count and baro_time_us[baros] <= now_us:
                take_baro(s, p, baro_alt_m[baros])
                baros += 1
            while fixes < gps_count and gps_time_us[fixes] <= now_us:
                take_gps(s, p, gps_time_us[fixes], row_at(gps_rows, fixes, GPS_COLUMNS))
                fixes += 1
            take_imu(s, p, now_us, row)
            move_copy(copy, p, now_us, row, s.imu_s == s.time_s, F)
            share_raised(s, copy)
            reset = is_reset(s, copy)
            was_reset[i] = 1 if reset else 0
            write_row(s, copy, p, reset, row_at(outputs, i, NAV_COLUMNS))
        propagate(s, p)
        predict_copy(copy, p, F)
        predicted = array_at(predictions + 8 * k * MATRIX, (STATES, STATES), FLOAT)
        end_stretch(s, copy, F, predicted)
        correction(s, copy, row_at(corrections, k, STATES))
