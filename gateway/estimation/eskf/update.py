"""The measurement update: one number at a time, gated, with the states that must not change.

A measurement of several numbers is several scalar updates, so no matrix is inverted. `h` is the row
of the measurement matrix; innovations are reduced by what earlier rows of the same group have
explained, and `inject` moves the group's corrections into the nominal state.

References
----------
.. [1] J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, chapters 6 and 7
   (global attitude error).
.. [2] D. Simon, "Optimal State Estimation", 2006, section 9.1 (Schmidt-Kalman filter).
"""

import math
from typing import Final

from gateway.compiled import compiled
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
from gateway.estimation.record import FloatArray, as_quat, fill, write_quat
from gateway.geometry.quaternion import from_rotation_vector, multiply, normalise

NO_GATE_SQ: Final = 1e12
"""A gate that no innovation reaches."""


@compiled
def begin_row(s: State) -> None:
    """Clear the row of the measurement matrix and the considered states."""
    fill(s.h, 0.0)
    fill(s.considered, 0.0)


@compiled
def consider(s: State, first: int, count: int) -> None:
    """Keep states as they are in this update, while their uncertainty counts [2]_."""
    fill(s.considered[first : first + count], 1.0)


@compiled
def innovation_variance(s: State, variance: float) -> float:
    """Compute `P h`, and return `h^T P h` plus the variance of the measurement."""
    P, Ph = s.P, s.Ph
    fill(Ph, 0.0)
    for j in range(STATES):
        factor = s.h[j]
        if factor != 0.0:
            for i in range(STATES):
                Ph[i] += factor * P[j, i]
    total = variance
    for i in range(STATES):
        total += s.h[i] * s.Ph[i]
    return total


@compiled
def update_scalar(s: State, innovation: float, variance: float, gate_sq: float) -> None:
    """Update by one number, measured minus predicted.

    An innovation outside the gate inflates the measurement's variance until it is on the gate: an
    outlier has little effect, while a lasting difference is followed in the end.
    """
    for j in range(STATES):
        innovation -= s.h[j] * s.dx[j]
    total = max(innovation_variance(s, variance), innovation * innovation / gate_sq)
    for k in range(3):
        if s.considered[GYRO_BIAS + k] == 0.0:
            column = s.Ph[GYRO_BIAS + k]
            s.bias_sum[k] += column * innovation / total
            s.bias_sum_var[k] += column * column / total
    P, u, considered, std = s.P, s.Ph, s.considered, math.sqrt(total)
    for i in range(STATES):
        u[i] /= std
    for i in range(STATES):
        factor = u[i]
        if considered[i] == 0.0:
            s.dx[i] += factor * innovation / std
            for j in range(STATES):
                P[i, j] -= factor * u[j]
        else:
            for j in range(STATES):
                P[i, j] -= (1.0 - considered[j]) * factor * u[j]


@compiled
def inject(s: State) -> None:
    """Move the corrections of a group of updates into the nominal state."""
    d = s.dx
    turn = from_rotation_vector((d[ATT], d[ATT + 1], d[ATT + 2]))
    write_quat(s.q_nb, normalise(multiply(turn, as_quat(s.q_nb))))
    for k in range(3):
        s.vel_n[k] += d[VEL + k]
        s.pos_n[k] += d[POS + k]
        s.gyro_bias_b[k] += d[GYRO_BIAS + k]
        s.accel_bias_b[k] += d[ACCEL_BIAS + k]
        s.gps_error_n[k] += d[GPS_ERROR + k]
        s.hard_iron_b[k] += d[HARD_IRON + k]
        s.gyro_scale_b[k] += d[GYRO_SCALE + k]
    s.baro_offset_m += d[BARO_OFFSET]
    s.mag_latency_s += d[MAG_LATENCY]
    fill(d, 0.0)


@compiled
def level_variance(s: State) -> float:
    """Return the variance of roll and pitch together, rad2."""
    return float(s.P[ATT, ATT] + s.P[ATT + 1, ATT + 1])


@compiled
def reset_state(s: State, k: int, variance: float) -> None:
    """Give one state a new variance, uncorrelated with the others."""
    s.resets[k] += 1.0
    for j in range(STATES):
        s.P[k, j] = 0.0
        s.P[j, k] = 0.0
    s.P[k, k] = variance


@compiled
def raise_variance(s: State, k: int, more: float) -> None:
    """Add to the variance of one state outside the process model."""
    s.P[k, k] += more
    s.raised[k] += more


@compiled
def scale_state(P: FloatArray, k: int, share: float) -> None:
    """Scale a row and a column of a covariance; the correlations stay."""
    for j in range(STATES):
        P[k, j] *= share
        P[j, k] *= share


@compiled
def limit_variance(P: FloatArray, k: int, most: float) -> None:
    """Limit the variance of one state; the correlations stay."""
    if P[k, k] > most:
        scale_state(P, k, math.sqrt(most / P[k, k]))
