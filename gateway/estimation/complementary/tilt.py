"""Gyroscope integration and the level correction by gravity.

The specific force is turned into the inertial frame of the gyroscope, where gravity stands still,
and low-passed there [1]_: a filter in the body frame would lag behind every turn. What the filter
lets through is gravity; the shortest turn that brings it upright corrects roll and pitch.

References
----------
.. [1] D. Laidig and T. Seel, "VQF: Highly accurate IMU orientation estimation with bias
   estimation and magnetic disturbance rejection", Information Fusion 91, 2023.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import ComplementaryState
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec, write_quat, write_vec
from gateway.geometry.quaternion import (
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
    rotate_inverse,
)
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

LEVEL_STD_RAD: Final = 0.05
"""Error of a level that came from gravity."""


@compiled
def low_pass(
    y: FloatArray, rate: FloatArray, old: FloatArray, k: int, u: float, cutoff: float, dt: float
) -> None:
    """Advance one channel of a second-order Butterworth low-pass by the trapezoidal rule.

    Parameters
    ----------
    y, rate, old : ndarray
        Output, its derivative and the last input, changed at index `k`.
    k : int
        The channel.
    u : float
        Newest input.
    cutoff : float
        Angular cutoff frequency in rad/s.
    dt : float
        Time step in s, of any length.
    """
    h = 0.5 * dt
    damping, stiffness = math.sqrt(2.0) * cutoff, cutoff * cutoff
    pull = stiffness * (u + old[k] - 2.0 * y[k])
    kept = 1.0 - h * damping - h * h * stiffness
    new = (kept * rate[k] + h * pull) / (1.0 + h * damping + h * h * stiffness)
    y[k] += h * (rate[k] + new)
    rate[k] = new
    old[k] = u


@compiled
def cutoff_radps(tau_s: float) -> float:
    """Give the Butterworth low-pass the same area of step response as `exp(-t / tau)`."""
    return math.sqrt(2.0) / tau_s


@compiled
def strapdown(s: ComplementaryState, gyro: Vec3, dt: float) -> None:
    """Integrate the angular rate: eq. 13 with a rotation vector."""
    b, e = s.bias_b, s.scale_b
    rate = (
        (1.0 - e[0]) * (gyro[0] - b[0]),
        (1.0 - e[1]) * (gyro[1] - b[1]),
        (1.0 - e[2]) * (gyro[2] - b[2]),
    )
    write_vec(s.rate_b, rate)
    turn = from_rotation_vector((rate[0] * dt, rate[1] * dt, rate[2] * dt))
    write_quat(s.q_ib, normalise(multiply(as_quat(s.q_ib), turn)))


@compiled
def refresh(s: ComplementaryState) -> None:
    """Put the parts of the attitude together: heading, level, gyroscope."""
    level = multiply(as_quat(s.q_ei), as_quat(s.q_ib))
    write_quat(s.q_eb, level)
    half = 0.5 * s.heading_rad
    write_quat(s.q_nb, normalise(multiply((math.cos(half), 0.0, 0.0, math.sin(half)), level)))


@compiled
def take_gravity(s: ComplementaryState, force_i: Vec3, tau_s: float, dt: float) -> None:
    """Feed one observation of minus gravity to the low-pass and level the attitude by it.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    force_i : tuple of 3 floats
        Specific force less acceleration in the inertial frame, m/s2.
    tau_s : float
        Time constant.
    dt : float
        Time that the observation stands for, s.
    """
    s.force_lp_s += dt
    if s.force_lp_s < tau_s:
        weight = dt / s.force_lp_s
        for k in range(3):
            s.force_lp_i[k] += weight * (force_i[k] - s.force_lp_i[k])
            s.force_in_i[k], s.force_lp_rate_i[k] = s.force_lp_i[k], 0.0
    else:
        cutoff = cutoff_radps(tau_s)
        for k in range(3):
            low_pass(s.force_lp_i, s.force_lp_rate_i, s.force_in_i, k, force_i[k], cutoff, dt)
    level(s)


@compiled
def level(s: ComplementaryState) -> None:
    """Turn the level frame the shortest way so that the low-passed force points up."""
    x, y, z = rotate(as_quat(s.q_ei), as_vec(s.force_lp_i))
    norm = math.sqrt(x * x + y * y + z * z)
    if norm < 1.0:
        return
    x, y, z = x / norm, y / norm, z / norm
    w = math.sqrt(max(0.5 * (1.0 - z), 1e-6))
    correction = (w, -0.5 * y / w, 0.5 * x / w, 0.0)
    write_quat(s.q_ei, normalise(multiply(normalise(correction), as_quat(s.q_ei))))
    s.tilt_sum[0] -= y
    s.tilt_sum[1] += x


@compiled
def hold_level(s: ComplementaryState) -> None:
    """Let gravity's low-pass go on from the present level."""
    begin_pull(s)
    for k in range(3):
        s.force_lp_i[k] = s.force_in_i[k] = s.force_mean_i[k]
        s.force_lp_rate_i[k] = 0.0
    s.tilt_sum[0] = s.tilt_sum[1] = 0.0


@compiled
def doubt_held_level(s: ComplementaryState, variance: float) -> None:
    """Be less sure of a level that gravity holds, after a turn unseen of a variance in rad2."""
    if s.level_by_gps == 0:
        s.unaided_level_sq += variance
    if variance > LEVEL_STD_RAD**2:
        hold_level(s)
        # As sure of the level as a mean over so long.
        s.force_lp_s = s.gravity_tau_s / (1.0 + variance / LEVEL_STD_RAD**2)


@compiled
def begin_pull(s: ComplementaryState) -> None:
    """Let the mean force begin with the gravity of the present level, and nothing that pulls."""
    gravity = rotate_inverse(as_quat(s.q_ei), (0.0, 0.0, -STANDARD_GRAVITY_MPS2))
    write_vec(s.force_mean_i, gravity)
    s.unaided_pull[0] = s.unaided_pull[1] = 0.0
