"""The GPS velocity as the reference of the specific force.

From fix to fix the change of velocity is the mean acceleration. Less gravity it is what the
accelerometer must have measured; the difference corrects tilt, heading and sensor biases
together. So neither a banked turn nor a take-off run tilts the horizon, with or without a compass.
Both times are those at which the fixes were valid: the latency costs only its share of gyroscope
drift.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.wahba import PAIR_WINDOW_S
from gateway.estimation.complementary.complementary_state import (
    FORCE,
    HEADING,
    SPEED,
    TILT,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift import carry_drift, start_level
from gateway.estimation.complementary.errors.drift_update import (
    OUTLIER_SIGMA,
    cleared_row,
    correct_drift,
)
from gateway.estimation.complementary.heading import is_heading_good
from gateway.estimation.complementary.tilt import LEVEL_STD_RAD
from gateway.estimation.complementary.unaided import unaided_level_std
from gateway.estimation.kernel_record import as_quat, as_vec, write_vec
from gateway.geometry.quaternion import rotate, rotate_inverse
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

MIN_BASELINE_S: Final = 0.15
"""Fixes closer together are joined: the difference of their velocities is mostly noise."""
MAX_BASELINE_S: Final = 2.5
"""Over a longer gap the mean acceleration contains little about the present attitude."""
JITTER_S: Final = 0.03
"""How much the latency of a fix varies."""
FORCE_NOISE_MPS2: Final = 0.1
"""Error of the accelerometer beside its bias, with a correlation time of a second."""


@compiled
def take_fix_velocity(
    s: ComplementaryState,
    p: ComplementaryGains,
    valid_s: float,
    vel: Vec3,
    force_i: Vec3,
    noise_mps: float,
) -> float:
    """Use the change of the GPS velocity since the last fix as the acceleration.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    valid_s : float
        When the fix was valid.
    vel : tuple of 3 floats
        GPS velocity NED, m/s.
    force_i : tuple of 3 floats
        Integral of the specific force in the inertial frame up to `valid_s`, m/s.
    noise_mps : float
        Of the velocity.

    Returns
    -------
    float
        Length in s of the interval that levelled the attitude; 0 if it did not.
    """
    dt = valid_s - s.fix_valid_s
    if dt < MIN_BASELINE_S:
        return 0.0
    old_force, old_vel = as_vec(s.fix_force_i), as_vec(s.fix_vel)
    write_vec(s.fix_force_i, force_i)
    write_vec(s.fix_vel, vel)
    s.fix_valid_s = valid_s
    unseen_m2ps2, s.unseen_m2ps2 = s.unseen_m2ps2, 0.0
    if dt > MAX_BASELINE_S or s.heading_known == 0:
        return 0.0
    mean = (
        (force_i[0] - old_force[0]) / dt,
        (force_i[1] - old_force[1]) / dt,
        (force_i[2] - old_force[2]) / dt,
    )
    accel = ((vel[0] - old_vel[0]) / dt, (vel[1] - old_vel[1]) / dt, (vel[2] - old_vel[2]) / dt)
    if s.at_rest == 1:
        accel = (0.0, 0.0, 0.0)
    carry_drift(s, p)
    if s.level_by_gps == 0 and is_heading_good(s):
        start_level(s, p, max(LEVEL_STD_RAD, unaided_level_std(s)))
    force = rotate(as_quat(s.q_ei), mean)
    variance = match_variance(s, force, noise_mps) / dt + unseen_m2ps2 / (dt * dt)
    for axis in range(3):
        match_force(s, p, axis, mean, accel, variance)
    if s.at_rest == 0:
        s.heading_true = 1
    return dt if s.level_by_gps == 1 else 0.0


@compiled
def match_variance(s: ComplementaryState, force_e: Vec3, noise_mps: float) -> float:
    """Return the variance of the mean acceleration over one second, m2/s4.

    In a manoeuvre it includes the jitter of the latency.
    """
    steady = FORCE_NOISE_MPS2 * FORCE_NOISE_MPS2 + s.force_density
    if s.level_by_gps == 0:
        steady += (LEVEL_STD_RAD * STANDARD_GRAVITY_MPS2) ** 2
    if s.at_rest == 1:
        return steady
    late_mps = JITTER_S * math.hypot(force_e[0], force_e[1])
    return steady + 2.0 * (noise_mps * noise_mps + late_mps * late_mps) / PAIR_WINDOW_S


@compiled
def match_force(
    s: ComplementaryState,
    p: ComplementaryGains,
    axis: int,
    mean_i: Vec3,
    accel_n: Vec3,
    variance: float,
) -> None:
    """Correct the states by one axis of the force in the level frame.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    axis : int
        0 to 2.
    mean_i : tuple of 3 floats
        Mean specific force in the inertial frame, m/s2.
    accel_n : tuple of 3 floats
        Mean acceleration in NED, m/s2.
    variance : float
        Of the difference along an axis, m2/s4.
    """
    f = unbiased_force(s, mean_i)
    half = -0.5 * s.heading_rad
    accel_e = rotate((math.cos(half), 0.0, 0.0, math.sin(half)), accel_n)
    gravity = STANDARD_GRAVITY_MPS2 if axis == 2 else 0.0
    write_force_row(s, axis, f)
    correct_drift(s, p, accel_e[axis] - gravity - f[axis], variance, OUTLIER_SIGMA, SPEED)


@compiled
def unbiased_force(s: ComplementaryState, force_i: Vec3) -> Vec3:
    """Turn a force in the inertial frame into the level frame, less the accelerometer's bias."""
    b = s.accel_bias_b
    raw, bias = rotate(as_quat(s.q_ei), force_i), rotate(as_quat(s.q_eb), (b[0], b[1], b[2]))
    return (raw[0] - bias[0], raw[1] - bias[1], raw[2] - bias[2])


@compiled
def write_force_row(s: ComplementaryState, axis: int, f: Vec3) -> None:
    """Write how one axis of a force `f` in the level frame depends on the states."""
    row = cleared_row(s)
    if axis == 0:
        row[TILT + 1], row[HEADING] = f[2], -f[1]
    elif axis == 1:
        row[TILT], row[HEADING] = -f[2], f[0]
    else:
        row[TILT], row[TILT + 1] = f[1], -f[0]
    level = (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0)
    in_b = rotate_inverse(as_quat(s.q_eb), level)
    for k in range(3):
        row[FORCE + k] = -in_b[k]
