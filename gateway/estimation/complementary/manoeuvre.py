"""The GPS velocity as the reference of the specific force.

From fix to fix the velocity tells the mean acceleration. Taken out of the mean specific force it
leaves gravity, so neither a banked turn nor a take-off run tilts the horizon; and matched with
its horizontal part it tells the heading, compass or none. Everything happens between the two
times at which the fixes were valid: the latency costs nothing but its share of gyroscope drift.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.drift import level_time_s
from gateway.estimation.complementary.heading import is_heading_good, take_match
from gateway.estimation.complementary.tilt import take_gravity
from gateway.estimation.kernel_record import as_quat, as_vec, write_vec
from gateway.geometry.quaternion import rotate, rotate_inverse
from gateway.records import Vec3

MIN_BASELINE_S: Final = 0.15
"""Fixes closer together are joined: the difference of their velocities is mostly noise."""
MAX_BASELINE_S: Final = 2.5
"""Over a longer gap the mean acceleration says little about the attitude now."""


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
    if dt > MAX_BASELINE_S:
        return 0.0
    mean = (
        (force_i[0] - old_force[0]) / dt,
        (force_i[1] - old_force[1]) / dt,
        (force_i[2] - old_force[2]) / dt,
    )
    accel = ((vel[0] - old_vel[0]) / dt, (vel[1] - old_vel[1]) / dt, (vel[2] - old_vel[2]) / dt)
    take_match(s, p, rotate(as_quat(s.q_ei), mean), accel, dt, noise_mps)
    if not is_heading_good(s):
        return 0.0
    half = -0.5 * s.heading_rad
    in_e = rotate((math.cos(half), 0.0, 0.0, math.sin(half)), accel)
    in_i = rotate_inverse(as_quat(s.q_ei), in_e)
    gravity = (mean[0] - in_i[0], mean[1] - in_i[1], mean[2] - in_i[2])
    take_gravity(s, gravity, level_time_s(s, p), dt)
    return dt
