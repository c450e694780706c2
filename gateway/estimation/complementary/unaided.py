"""The level without GPS: for how long gravity is averaged, and how far the level is off.

What pulls beside gravity tilts the average, and a drift of the gyroscope lets it fall behind. What
flies cannot pull one way for long: an acceleration `a` that turns about in the time `T` tilts the
low-pass of the time constant `tau` by `2 a / g (T / tau)**2`, a drift `b` by `b tau`. So nothing
that pulls makes the average short; the harder it pulls, the longer the gyroscope is trusted. At
rest nothing pulls, and what has just left it may, until it moves as a hand does.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.wahba import TURN_S
from gateway.estimation.complementary.complementary_state import (
    FORCE,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift import (
    ATTITUDE_WALK_RAD2PS,
    FORCE_BIAS_MPS2,
    SCALE_SHARE,
    TURN_WALK_RAD,
    bias_std,
)
from gateway.estimation.complementary.tilt import begin_pull
from gateway.estimation.filtering.hidden_pull import (
    flight_share,
    hidden_level_var,
    watch_hidden_pull,
)
from gateway.estimation.filtering.uncalibrated import gyro_bias_var
from gateway.estimation.kernel_record import as_quat, as_vec
from gateway.estimation.rest import REST_TAU_S
from gateway.geometry.quaternion import rotate, rotate_inverse
from gateway.units import STANDARD_GRAVITY_MPS2

PULL_MEMORY_S: Final = 20.0
"""What has pulled in this time is to be expected."""
PULL_TAU_S: Final = 1.5
"""What a hand does averages out in this time."""
HAND_MPS2: Final = 0.2
"""A hand pulls less over it: recorded ones up to 0.15, a hovering quadrotor up to 0.7."""
TILTED_SQ: Final = 8.0
"""Up to two standard deviations about both axes, what seems to pull is a level that is off."""
EXPECTED_MPS2: Final = 0.3
"""All else has to be expected to pull by this, however long it has not."""


@compiled
def watch_level(s: ComplementaryState, p: ComplementaryGains, dt: float) -> None:
    """Note what pulls, by GPS or without, and choose the time constant of gravity's low-pass.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    dt : float
        Time since the last call, s.
    """
    share, tau, g = dt / PULL_MEMORY_S, s.gravity_tau_s, STANDARD_GRAVITY_MPS2
    x, y, z = as_vec(s.rate_b)
    s.unaided_radps += share * (math.sqrt(x * x + y * y + z * z) - s.unaided_radps)
    watch_scaled(s, dt)
    drift_sq = level_drift_sq(s)
    pull_sq = unaided_pull_sq(s, drift_sq, dt)
    s.unaided_pull_sq += share * (pull_sq - s.unaided_pull_sq)
    drift = math.sqrt(drift_sq) / tau
    expected_sq = expected_pull_sq(s, pull_sq, dt)
    if s.by_gps == 1:
        s.level_shown = 1
    watch_hidden_pull(s, as_quat(s.q_eb), as_vec(s.rate_b), s.unaided_pulled == 1, dt)
    # Here the sum of both errors is least.
    best = (4.0 * TURN_S**2 * math.sqrt(expected_sq) / (g * drift)) ** (1.0 / 3.0)
    s.gravity_tau_s = tau = max(p.tau_accel_s, best)
    passed = min(1.0, 2.0 * (TURN_S / tau) ** 2) / g
    tilted = 0.0 if s.at_rest == 1 else passed * passed * max(pull_sq, s.unaided_pull_sq)
    faded = math.exp(-2.0 * dt / tau)
    if s.at_rest == 1 and s.force_lp_s < s.rest_s + REST_TAU_S:
        # The average is of this rest alone.
        faded = 0.0
    s.unaided_level_sq = tilted + faded * max(s.unaided_level_sq - tilted, 0.0)


@compiled
def expected_pull_sq(s: ComplementaryState, pull_sq: float, dt: float) -> float:
    """Return the square of what is to be expected to pull: at rest nothing, m2/s4.

    A flight pulls hardest where it begins. Were the average still short then, it would take the
    take-off run for gravity.
    """
    if s.at_rest == 1:
        s.unaided_hand_s, s.unaided_pulled = 0.0, 0
        return 0.0
    tilted_sq = TILTED_SQ * STANDARD_GRAVITY_MPS2**2 * s.unaided_level_sq
    if pull_sq > HAND_MPS2**2 + tilted_sq:
        s.unaided_pulled = 1
    if s.unaided_pulled == 0:
        s.unaided_hand_s += dt
    share = flight_share(s.unaided_pulled, s.unaided_hand_s)
    return float(max(s.unaided_pull_sq, (share * EXPECTED_MPS2) ** 2))


@compiled
def level_drift_sq(s: ComplementaryState) -> float:
    """Return the variance by which gravity's low-pass falls behind, about one axis, rad2."""
    tau, bias_sq = s.gravity_tau_s, bias_std(s) ** 2
    if s.level_shown == 0:
        bias_sq = gyro_bias_var(s, bias_sq)
    walk = ATTITUDE_WALK_RAD2PS + TURN_WALK_RAD * s.unaided_radps + s.rate_density
    scaled_sq = 0.0
    for k in range(3):
        scaled_sq += 0.5 * (s.unaided_scaled[0, k] ** 2 + s.unaided_scaled[1, k] ** 2)
    return bias_sq * tau * tau + walk * tau + (SCALE_SHARE * tau) ** 2 * scaled_sq


@compiled
def watch_scaled(s: ComplementaryState, dt: float) -> None:
    """Low-pass what the scale of each axis of the gyroscope acts on: turns to and fro cancel."""
    q, share = as_quat(s.q_eb), min(dt / s.gravity_tau_s, 1.0)
    for k in range(2):
        axis = rotate_inverse(q, (1.0 - k, float(k), 0.0))
        for j in range(3):
            s.unaided_scaled[k, j] += share * (axis[j] * s.rate_b[j] - s.unaided_scaled[k, j])


@compiled
def unaided_pull_sq(s: ComplementaryState, drift_sq: float, dt: float) -> float:
    """Return the square of what pulls beside gravity, less what drift explains, m2/s4."""
    if s.by_gps == 1:
        begin_pull(s)
        return 0.0 if s.at_rest == 1 else s.pull_mps2 * s.pull_mps2
    mean = rotate(as_quat(s.q_ei), as_vec(s.force_mean_i))
    pull_sq = 0.0
    for k in range(2):
        s.unaided_pull[k] += dt / PULL_TAU_S * (mean[k] - s.unaided_pull[k])
        pull_sq += s.unaided_pull[k] ** 2
    bias_sq = min(s.drift_cov[FORCE, FORCE], FORCE_BIAS_MPS2**2)
    explained = bias_sq + STANDARD_GRAVITY_MPS2**2 * drift_sq
    return float(max(pull_sq - 2.0 * explained, 0.0))


@compiled
def unaided_level_std(s: ComplementaryState) -> float:
    """Return how far the low-pass of gravity is off upright, about one axis, rad."""
    # A Butterworth low-pass lets white noise through as `exp(-t / tau)` does.
    rough_sq = 0.5 * s.force_density / s.gravity_tau_s
    force_sq = (s.drift_cov[FORCE, FORCE] + rough_sq) / STANDARD_GRAVITY_MPS2**2
    return math.sqrt(force_sq + level_drift_sq(s) + s.unaided_level_sq + hidden_level_var(s))
