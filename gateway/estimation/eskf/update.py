"""The measurement update, and the measurements other than GPS and compass.

A measurement of several numbers is a group of scalar updates, so no matrix is inverted. For each
number the row `h` of the measurement matrix is written, `update_scalar` adds the correction to the
error `dx` of the group, and at the end `inject` applies it to the nominal state.

| measurement | model | function |
| --- | --- | --- |
| gravity, without GPS | `0 = (f_n + att x f_n - R accel_bias)` north, east | `update_gravity` |
| rest | `mean gyro = gyro_bias`, `0 = vel` | `update_rest` |
| barometer | `baro_down + baro_offset = pos_down` | `update_height` |
| fix | see `fix_model` | `fix_model.update_fix` |
| magnetic heading | see `magnetometer.heading_row` | `magnetometer.update_heading` |

References
----------
.. [1] J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, chapters 6 and 7
   (global attitude error).
.. [2] D. Simon, "Optimal State Estimation", 2006, section 10.3 (Schmidt-Kalman filter).
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.predict import propagate
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
    POS,
    STATES,
    VEL,
    WATCHED,
    State,
    watched_state,
)
from gateway.estimation.record import as_quat, as_vec, write_quat
from gateway.geometry import quaternion as quat
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

REST_GATE_SQ: Final = 4.0
"""Squared gate, two standard deviations, because the rate at rest may be a slow turn."""
GRAVITY_TOLERANCE: Final = 0.02
"""Deviation of the mean force from gravity, as a share, above which it is an acceleration: the
scale error of an MPU6050."""
LEVEL_INTERVAL_S: Final = 0.1
"""Interval of the measurements that replace GPS."""
REST_VELOCITY_VAR: Final = 0.2**2
"""Variance of the velocity of a vehicle with an idling engine, m2/s2."""
REST_RATE_VAR: Final = 0.002**2
"""Variance of the mean rate at rest, with the noise of an idling engine, rad2/s2."""


@compiled
def clear_row(s: State) -> None:
    """Clear the row of the measurement matrix and the considered states."""
    s.h[:] = 0.0
    s.considered[:] = 0.0


@compiled
def consider(s: State, first: int, count: int) -> None:
    """Exclude states from this update, but include their uncertainty [2]_."""
    s.considered[first : first + count] = 1.0


@compiled
def set_accel_bias(s: State, k: int, share: float) -> None:
    """Write `share` times row `k` of `R_nb` for the accelerometer bias."""
    axes = quat.body_axes(as_quat(s.q_nb))
    for i in range(3):
        s.h[ACCEL_BIAS + i] = share * axes[i][k]


@compiled
def innovation_variance(s: State, variance: float) -> float:
    """Compute `P h`, and return `h^T P h` plus the variance of the measurement."""
    P, Ph = s.P, s.Ph
    Ph[:] = 0.0
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

    With the innovation `e`, minus `h dx` of the group's earlier rows, and its variance
    `S = h P h^T + variance`, the gain is `K = P h^T / S`; then `dx' = dx + K e` and
    `P' = P - K S K^T` ([1]_, section 6.1). Considered states have no gain, and the covariance among
    them does not change [2]_.

    An innovation outside the gate inflates `S` until it is on the gate, `e^2 = gate_sq S`: an
    outlier has little effect, while a lasting difference is corrected in the end.
    """
    for j in range(STATES):
        innovation -= s.h[j] * s.dx[j]
    total = max(innovation_variance(s, variance), innovation * innovation / gate_sq)
    # The other rows cannot distinguish the accelerometer bias from tilt.
    vertical = s.h[VEL + 2] != 0.0 or s.h[POS + 2] != 0.0
    for k in range(WATCHED):
        i = watched_state(k)
        tests = k < 3 or (vertical if i != BARO_OFFSET else s.h[i] != 0.0)
        if tests and s.considered[i] == 0.0:
            column = s.Ph[i]
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
    """Apply the corrections of a group of updates to the nominal state: `q(att) * q_nb` [1]_."""
    d = s.dx
    turn = quat.from_rotation_vector((d[ATT], d[ATT + 1], d[ATT + 2]))
    write_quat(s.q_nb, quat.normalise(quat.multiply(turn, as_quat(s.q_nb))))
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
    s.gps_climb_error_mps += d[GPS_CLIMB]
    d[:] = 0.0


@compiled
def gravity_force_n(s: State) -> Vec3:
    """Return the low-pass filtered force, rotated to NED by the present attitude, m/s2."""
    force_b = quat.rotate_inverse(as_quat(s.q_ib), as_vec(s.force_lp_i[1]))
    return quat.rotate(as_quat(s.q_nb), force_b)


@compiled
def sustained_sq(s: State) -> float:
    """Return the square of the horizontal acceleration that a mean force beyond gravity implies."""
    bias_std = math.sqrt(s.P[ACCEL_BIAS, ACCEL_BIAS])
    most = (1.0 + GRAVITY_TOLERANCE) * STANDARD_GRAVITY_MPS2 + bias_std
    return float(max(quat.norm_sq(as_vec(s.force_lp_i[1])) - most * most, 0.0))


@compiled
def gravity_variance(s: State, p: Gains) -> float:
    """Return the variance of one horizontal axis of the filtered force, m2/s4."""
    settling = 2.0 * p.gravity_tau_s / s.force_lp_s
    motion = p.gravity_motion_sq * (1.0 + settling * settling) * s.force_dev_sq
    return p.gravity_noise_var + motion + sustained_sq(s)


@compiled
def update_gravity(s: State, p: Gains, dt: float) -> None:
    """Level by the direction of the filtered force, whose errors are correlated in time.

    Without acceleration the true force in NED, `f_n + att x f_n - R accel_bias`, has no horizontal
    part. The accelerometer bias cannot be distinguished from tilt here, so it is only considered:
    the covariance of the level includes it, and the first fixes separate the two.
    """
    propagate(s, p)
    north, east, down = gravity_force_n(s)
    variance = gravity_variance(s, p) * max(1.0, 2.0 * p.gravity_tau_s / dt)
    for k in range(2):
        clear_row(s)
        consider(s, ACCEL_BIAS, 3)
        consider(s, ATT + 2, 1)
        s.h[ATT + 1 - k] = down if k == 0 else -down
        set_accel_bias(s, k, -1.0)
        update_scalar(s, -north if k == 0 else -east, variance, p.gate_sigma_sq)
    inject(s)


@compiled
def update_rest(s: State, p: Gains) -> None:
    """Update by rest: the mean rate is the gyroscope's bias, and the velocity is zero."""
    propagate(s, p)
    for k in range(3):
        clear_row(s)
        s.h[GYRO_BIAS + k] = 1.0
        update_scalar(s, s.gyro_mean[k] - s.gyro_bias_b[k], REST_RATE_VAR, REST_GATE_SQ)
    if s.aided == 1:
        for k in range(3):
            clear_row(s)
            s.h[VEL + k] = 1.0
            update_scalar(s, -s.vel_n[k], REST_VELOCITY_VAR, p.gate_sigma_sq)
    inject(s)


@compiled
def update_height(s: State, p: Gains) -> None:
    """Update by the barometer: its depth plus the offset is the position below the origin."""
    propagate(s, p)
    clear_row(s)
    s.h[POS + 2] = 1.0
    s.h[BARO_OFFSET] = -1.0
    update_scalar(
        s, s.baro_down_m + s.baro_offset_m - s.pos_n[2], p.baro_noise_var, p.gate_sigma_sq
    )
    inject(s)


@compiled
def restart_baro(s: State, p: Gains) -> None:
    """Set the barometer's offset from the present height."""
    propagate(s, p)
    s.baro_offset_m = s.pos_n[2] - s.baro_down_m
    s.resets[BARO_OFFSET] += 1.0
    for j in range(STATES):
        s.P[BARO_OFFSET, j] = s.P[POS + 2, j]
        s.P[j, BARO_OFFSET] = s.P[j, POS + 2]
    s.P[BARO_OFFSET, BARO_OFFSET] = s.P[POS + 2, POS + 2] + p.baro_noise_var
