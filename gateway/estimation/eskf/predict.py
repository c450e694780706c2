"""Prediction: the nominal state at each IMU sample, the covariance every `COVARIANCE_INTERVAL_S`.

With the attitude error in NED, `R` the integral of `R_nb`, `f` that of the specific force in NED
and `dt` the time, the error state obeys [1]_

    att' = att - R gyro_bias - R diag(rate) gyro_scale
    vel' = vel + att x f - R accel_bias
    pos' = pos + vel dt

Corrections of the watched states, the biases and the barometer's offset, are white if the model is
correct. A bias that steps or drifts, or a barometer that is stuck, is repeatedly corrected in one
direction: the significant part of the recent corrections becomes process noise [2]_.

References
----------
.. [1] J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, section 7.2.
.. [2] R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE
   Transactions on Automatic Control 15, 1970.
.. [3] D. Laidig and T. Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation
   and magnetic disturbance rejection", Information Fusion 91, 2023.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import FRESH_GPS_S
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    BARO_OFFSET,
    GAINED,
    GPS_CLIMB,
    GPS_ERROR,
    GYRO_BIAS,
    GYRO_SCALE,
    HARD_IRON,
    HISTORY_LENGTH,
    INTEGRALS,
    MOVED,
    MOVING_STATES,
    POS,
    STATES,
    VEL,
    WATCHED,
    State,
    limit_variance,
    raise_variance,
    scale_state,
    watched_state,
)
from gateway.estimation.record import FloatArray, as_quat, as_vec, write_quat, write_vec
from gateway.geometry import quaternion as quat
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

COVARIANCE_INTERVAL_S: Final = 0.02
"""Interval of the covariance's propagation; measurements propagate it in between."""
ACCELERATION_S: Final = 1.0
"""Time for which an acceleration keeps its body axis, and its scale error the sign."""
NO_HEADING_VAR: Final = 3.0
"""Variance of an unknown heading: that of a uniform angle, `pi^2 / 3`, rad2."""
BIAS_MEMORY_S: Final = 20.0
"""Time constant of the sum of corrections of the gyroscope bias."""
BIAS_CHANCE_SQ: Final = 6.0
"""Squared sum, in variances, above which it is significant: chi-squared with 1 degree, 98.6 %."""
ACCEL_CHANCE_SQ: Final = 25.0
"""The same for the accelerometer, whose vertical corrections are also due to GPS and barometer."""
LIMIT_VARS: Final = (1.0, 25.0)
"""Largest raised variances of the accelerometer bias, m2/s4: a scale error of a tenth, and of the
barometer's offset, m2."""
BIAS_RAISE_S: Final = 0.3
ACCEL_RAISE_S: Final = 0.5
BARO_RAISE_S: Final = 6.0
"""Times in which the significant part is added to the variances. The barometer's offset is slow,
because height corrections in one direction may also be due to a bad accelerometer."""
BAD_ACCEL_SQ: Final = 36.0
"""Squared sum, in variances, above which the accelerometer is degraded."""
USUAL_BIAS_MPS2: Final = 0.8
"""Largest bias of a sound accelerometer: 80 mg, the tolerance of an MPU6050."""
BLEND_S: Final = 1.0
"""Time constant with which a corrected position is blended in after a gap."""
STEP_LIMIT: Final = 1e4
"""Squared change from sample to sample above which it is a fault; NaN compares false."""
MEANS_S: Final = 0.05
"""Interval of means above which they contain no vibration, but differ by the motion."""
HISTORY_INTERVAL_S: Final = 0.005
"""Interval of the stored integrals, which are interpolated; faster samples share a slot."""
CLIMB_DENSITY: Final = 4.0
"""Random walk of the height without GPS, m2/s: a climb of 2 m/s that lasts for a second."""


@compiled
def rate_of(s: State, gyro: Vec3) -> Vec3:
    """Return the angular rate without bias and scale error, rad/s."""
    b, e = s.gyro_bias_b, s.gyro_scale_b
    return (
        (1.0 - e[0]) * (gyro[0] - b[0]),
        (1.0 - e[1]) * (gyro[1] - b[1]),
        (1.0 - e[2]) * (gyro[2] - b[2]),
    )


@compiled
def integrate(s: State, p: Gains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Advance the nominal state by one sample, and collect the terms of the propagation.

    Midpoint rule: the force is rotated by the attitude in the middle of the interval.
    """
    rate = rate_of(s, gyro)
    write_vec(s.rate_b, rate)
    half = quat.from_rotation_vector(quat.scaled(rate, 0.5 * dt))
    q_i = quat.multiply(as_quat(s.q_ib), half)
    write_quat(s.q_ib, quat.normalise(quat.multiply(q_i, half)))
    q = quat.multiply(as_quat(s.q_nb), half)
    write_quat(s.q_nb, quat.normalise(quat.multiply(q, half)))
    axes = quat.body_axes(q)
    x, y, z = axes
    f = quat.difference(accel, as_vec(s.accel_bias_b))
    force_i = quat.rotate(q_i, f)
    accel_sq = 0.0
    for k in range(3):
        force = x[k] * f[0] + y[k] * f[1] + z[k] * f[2]
        s.pending_force_n[k] += force * dt
        for i in range(3):
            s.pending_rotation[k, i] += axes[i][k] * dt
            s.pending_rotation_gyro[k, i] += axes[i][k] * rate[i] * dt
        a = force + STANDARD_GRAVITY_MPS2 if k == 2 else force
        accel_sq += a * a
        s.integrals[MOVED + k] += (s.integrals[GAINED + k] + 0.5 * a * dt) * dt
        s.integrals[GAINED + k] += a * dt
        s.integrals[k] += force_i[k] * dt
        if s.aided == 1:
            s.pos_n[k] += (s.vel_n[k] + 0.5 * a * dt) * dt
            s.vel_n[k] += a * dt
        elif k < 2 and s.time_s - s.fix_s < FRESH_GPS_S and math.isfinite(s.fix_vel[k]):
            # Without a heading, fixes cannot be fused: extrapolate the position by its velocity.
            s.pos_n[k] += s.fix_vel[k] * dt
    for k in range(2):
        s.blend_n[k] -= min(1.0, dt / BLEND_S) * s.blend_n[k]
    s.pending_noise[0] += p.gyro_turn_var * (dt * math.sqrt(quat.norm_sq(rate)))
    s.pending_noise[1] += p.accel_scale_sq * ACCELERATION_S * accel_sq * dt
    s.pending_s += dt
    follow_gravity(s, p, force_i, dt)


@compiled
def add_vibration(s: State, p: Gains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Add vibration noise, measured by second differences of the samples, in which motion is small.

    The second difference contains the noise of three samples, that of the middle one twice: six
    variances on each of three axes.
    """
    gyro_sq = accel_sq = 0.0
    for k in range(3):
        change = gyro[k] - s.imu_before[k]
        gyro_sq += (change - s.imu_change[k]) ** 2
        s.imu_change[k] = change
        change = accel[k] - s.imu_before[3 + k]
        accel_sq += (change - s.imu_change[3 + k]) ** 2
        s.imu_change[3 + k] = change
        s.imu_before[k], s.imu_before[3 + k] = gyro[k], accel[k]
    vibrating = dt < MEANS_S or s.means == 0
    if vibrating and gyro_sq < STEP_LIMIT and accel_sq < STEP_LIMIT:
        share = dt * dt / 18.0
        s.pending_noise[0] += p.gyro_vibration_sq * share * gyro_sq
        s.pending_noise[1] += p.accel_vibration_sq * share * accel_sq


@compiled
def follow_gravity(s: State, p: Gains, force_i: Vec3, dt: float) -> None:
    """Low-pass the force in the gyroscope frame, where gravity is constant [3]_.

    It starts as a mean, so that the first sample does not have the weight of a time constant.
    """
    s.force_lp_s += dt
    share = min(1.0, dt / min(p.gravity_tau_s, s.force_lp_s))
    slow = min(1.0, dt / min(2.0 * p.gravity_tau_s, s.force_lp_s))
    deviation_sq = 0.0
    for k in range(3):
        s.force_lp_i[0, k] += share * (force_i[k] - s.force_lp_i[0, k])
        s.force_lp_i[1, k] += share * (s.force_lp_i[0, k] - s.force_lp_i[1, k])
        deviation_sq += (s.force_lp_i[0, k] - s.force_lp_i[1, k]) ** 2
    s.force_dev_sq += slow * (deviation_sq - s.force_dev_sq)


@compiled
def store_integrals(s: State) -> None:
    """Store the present integrals."""
    newest = (s.history_count - 1) % HISTORY_LENGTH
    if s.history_count > 0 and s.time_s - s.history[newest, 0] < HISTORY_INTERVAL_S:
        return
    slot = s.history_count % HISTORY_LENGTH
    s.history[slot, 0] = s.time_s
    for k in range(INTEGRALS):
        s.history[slot, 1 + k] = s.integrals[k]
    s.history_count += 1


@compiled
def look_back(s: State, time_s: float) -> float:
    """Interpolate the integrals of a past time into `then`; return the time actually found."""
    count = s.history_count
    if time_s >= s.time_s or count == 0:
        for k in range(INTEGRALS):
            s.then[k] = s.integrals[k]
        return float(s.time_s)
    oldest = max(0, count - HISTORY_LENGTH)
    low, high = oldest, count
    while low < high:
        middle = (low + high) // 2
        if s.history[middle % HISTORY_LENGTH, 0] <= time_s:
            low = middle + 1
        else:
            high = middle
    if low == oldest:
        for k in range(INTEGRALS):
            s.then[k] = s.history[oldest % HISTORY_LENGTH, 1 + k]
        return float(s.history[oldest % HISTORY_LENGTH, 0])
    before, after = (low - 1) % HISTORY_LENGTH, low % HISTORY_LENGTH
    t0 = s.history[before, 0]
    t1 = s.time_s if low == count else s.history[after, 0]
    share = (time_s - t0) / (t1 - t0) if t1 > t0 else 0.0
    for k in range(INTEGRALS):
        end = s.integrals[k] if low == count else s.history[after, 1 + k]
        s.then[k] = s.history[before, 1 + k] + share * (end - s.history[before, 1 + k])
    return time_s


@compiled
def propagate(s: State, p: Gains) -> None:
    """Propagate the covariance over the pending time: `F P F^T + Q`."""
    dt = s.pending_s
    if dt <= 0.0:
        return
    apply_transition(s, s.P, STATES)
    mirror(s.P)
    apply_transition(s, s.P, MOVING_STATES)
    symmetrise(s.P)
    angle_var, velocity_var = s.pending_noise[0], s.pending_noise[1]
    kept = math.exp(-dt / p.gps_error_s)
    for k in range(3):
        s.P[ATT + k, ATT + k] += angle_var + p.gyro_noise_density * dt
        s.P[GYRO_BIAS + k, GYRO_BIAS + k] += p.gyro_bias_walk_density * dt
        s.P[ACCEL_BIAS + k, ACCEL_BIAS + k] += p.accel_bias_walk_density * dt
        s.P[HARD_IRON + k, HARD_IRON + k] += p.hard_iron_walk_density * dt
        if s.aided == 1:
            s.P[VEL + k, VEL + k] += velocity_var + p.accel_noise_density * dt
            s.P[POS + k, POS + k] += s.pos_density[k] * dt
        scale_state(s.P, GPS_ERROR + k, kept)
        s.P[GPS_ERROR + k, GPS_ERROR + k] += s.gps_error_var[k] * (1.0 - kept * kept)
        s.gps_error_n[k] *= kept
    if s.aided == 0:
        s.P[POS + 2, POS + 2] += CLIMB_DENSITY * dt
    speed_sq = quat.norm_sq(as_vec(s.vel_n))
    s.P[BARO_OFFSET, BARO_OFFSET] += (
        p.baro_walk_density + p.baro_dynamic_density * speed_sq * speed_sq
    ) * dt
    kept = math.exp(-dt / p.gps_climb_error_s)
    scale_state(s.P, GPS_CLIMB, kept)
    s.P[GPS_CLIMB, GPS_CLIMB] += s.gps_climb_error_var * (1.0 - kept * kept)
    s.gps_climb_error_mps *= kept
    limit_variance(s.P, ATT + 2, NO_HEADING_VAR)
    follow_bias_steps(s, p, dt)
    s.pending_s = 0.0
    s.pending_noise[:] = 0.0
    s.pending_force_n[:] = 0.0
    s.pending_rotation[:] = 0.0
    s.pending_rotation_gyro[:] = 0.0


@compiled
def apply_transition(s: State, P: FloatArray, columns: int) -> None:
    """Multiply the first columns of `P` by the transition matrix from the left."""
    R, W, dt, f = s.pending_rotation, s.pending_rotation_gyro, s.pending_s, s.pending_force_n
    if s.aided == 1:
        for k in range(3):
            add_row(P, POS + k, dt, VEL + k, columns)
            a, b = (k + 1) % 3, (k + 2) % 3
            add_row(P, VEL + k, f[b], ATT + a, columns)
            add_row(P, VEL + k, -f[a], ATT + b, columns)
            for i in range(3):
                add_row(P, VEL + k, -R[k, i], ACCEL_BIAS + i, columns)
    for k in range(3):
        for i in range(3):
            add_row(P, ATT + k, -R[k, i], GYRO_BIAS + i, columns)
            add_row(P, ATT + k, -W[k, i], GYRO_SCALE + i, columns)


@compiled
def add_row(P: FloatArray, to: int, factor: float, row: int, columns: int) -> None:
    """Add a multiple of one row to another, in its first columns."""
    for j in range(columns):
        P[to, j] += factor * P[row, j]


@compiled
def mirror(P: FloatArray) -> None:
    """Transpose the product from the left in place, for the product from the right.

    The second product changes only the columns of the moving states. Their rows keep final values:
    the covariances with the other states.
    """
    for j in range(MOVING_STATES):
        for i in range(j + 1, STATES):
            upper = P[j, i]
            if i < MOVING_STATES:
                P[j, i] = P[i, j]
            P[i, j] = upper


@compiled
def symmetrise(P: FloatArray) -> None:
    """Remove the asymmetry due to rounding, which would grow without bound in long flights.

    Only the moving states have it: the covariances with the others are copies, and an update
    subtracts a symmetric product.
    """
    for i in range(MOVING_STATES):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@compiled
def unexpected_density(s: State, k: int) -> float:
    """Return the process noise of a watched state beyond the model, its unit squared per s.

    The accelerometer's grows with its variance, to follow a new scale error within seconds.
    """
    chance_sq = ACCEL_CHANCE_SQ if 3 <= k < 6 else BIAS_CHANCE_SQ
    excess = max(s.bias_sum[k] ** 2 / chance_sq - s.bias_sum_var[k], 0.0)
    if k < 3:
        return float(excess / BIAS_RAISE_S)
    if k == WATCHED - 1 or excess == 0.0:
        return float(excess / BARO_RAISE_S)
    bias_var = s.P[GYRO_BIAS + k, GYRO_BIAS + k]
    return float(excess / s.bias_sum_var[k] * bias_var / ACCEL_RAISE_S)


@compiled
def is_accel_degraded(s: State) -> bool:
    """Return whether the accelerometer bias is unusual, or was corrected in one direction."""
    unusual = False
    for k in range(3):
        unusual = unusual or abs(s.accel_bias_b[k]) > USUAL_BIAS_MPS2
        unusual = unusual or s.bias_sum[3 + k] ** 2 > BAD_ACCEL_SQ * s.bias_sum_var[3 + k]
    return unusual


@compiled
def follow_bias_steps(s: State, p: Gains, dt: float) -> None:
    """Raise the variances of the watched states by the significant part of their sums.

    The sums fade; they start once a known attitude was corrected for `BIAS_MEMORY_S`.
    """
    for k in range(WATCHED):
        i = watched_state(k)
        most = p.gyro_bias_var if k < 3 else LIMIT_VARS[k // 3 - 1]
        limit = max(most - s.P[i, i], 0.0)
        raise_variance(s, i, min(unexpected_density(s, k) * dt, limit))
    known = s.lost == 0 and s.heading_known == 1
    s.bias_watch_s = min(s.bias_watch_s + dt, BIAS_MEMORY_S) if known else 0.0
    if min(s.bias_watch_s, s.sound_s) < BIAS_MEMORY_S:
        s.bias_sum[:] = 0.0
        s.bias_sum_var[:] = 0.0
        return
    kept = math.exp(-dt / BIAS_MEMORY_S)
    for k in range(WATCHED):
        s.bias_sum[k] *= kept
        s.bias_sum_var[k] *= kept * kept
