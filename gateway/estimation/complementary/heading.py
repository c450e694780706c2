"""The heading: a scalar filter fed by the compass and by the GPS acceleration.

The level frame of the tilt filter drifts about the vertical with the gyroscope; `heading_rad` is
the turn from it to NED. Its variance makes the compass a first-order filter with a fixed time
constant that starts as a plain mean, and weighs compass against GPS. A field whose strength or
dip is not the usual one is not believed for a minute; a new field that stays the same while the
aircraft turns becomes the usual one.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.kernel_record import as_quat
from gateway.estimation.magfield import STALE_MAG_S, take_field
from gateway.geometry.quaternion import rotate, wrap_pi
from gateway.records import Vec3

UNKNOWN_VAR: Final = 10.0
"""Variance of a heading of which nothing is known, rad2."""
BIAS_HEED: Final = 3.0
"""So much more noise a heading has for the bias."""
LEAST_VAR: Final = 1e-6
"""Rounding must not make a variance negative."""
MATCH_WINDOW_S: Final = 1.0
"""Differences of successive velocities share their noise; over this time it averages out."""
GOOD_VAR: Final = 0.3
"""Up to 30 deg of standard deviation, the GPS acceleration may be turned by the heading."""


@compiled
def is_heading_good(s: ComplementaryState) -> bool:
    """Return whether horizontal vectors may be turned by the heading."""
    return s.heading_known == 1 and s.heading_var < GOOD_VAR


@compiled
def correct_heading(
    s: ComplementaryState, p: ComplementaryGains, measured_rad: float, variance: float
) -> None:
    """Blend one measured heading in, the shortest way round."""
    carry_heading(s)
    if s.heading_known == 0:
        s.heading_rad, s.heading_var, s.heading_known = measured_rad, variance, 1
        s.heading_cov[0] = s.heading_cov[1] = s.heading_cov[2] = 0.0
        return
    spread = s.heading_var + variance
    innovation = wrap_pi(measured_rad - s.heading_rad)
    s.heading_rad = wrap_pi(s.heading_rad + s.heading_var / spread * innovation)
    # The bias heeds a heading less than the heading does: its errors last, and look like a drift.
    limit, heed = p.bias_limit_radps, s.heading_var + BIAS_HEED * variance
    left = (2.0 - spread / heed) / heed
    for k in range(3):
        bias = s.bias_b[k] + s.heading_cov[k] / heed * innovation
        s.bias_b[k] = max(-limit, min(limit, bias))
        for j in range(3):
            s.bias_cov[k, j] -= s.heading_cov[k] * s.heading_cov[j] * left
    for k in range(3):
        s.heading_cov[k] *= variance / spread
    s.heading_var = max(s.heading_var * variance / spread, LEAST_VAR)


@compiled
def carry_heading(s: ComplementaryState) -> None:
    """Let the gyroscope's bias make the heading uncertain, and tied to it, up to now."""
    P, r, c = s.bias_cov, s.down_turn, s.heading_cov
    for k in range(3):
        column = P[k, 0] * r[0] + P[k, 1] * r[1] + P[k, 2] * r[2]
        # With the covariance before this one is carried on: twice it, and the square.
        s.heading_var += r[k] * (column - 2.0 * c[k])
    for k in range(3):
        c[k] -= P[k, 0] * r[0] + P[k, 1] * r[1] + P[k, 2] * r[2]
    s.heading_var = min(max(s.heading_var, LEAST_VAR), UNKNOWN_VAR)
    r[0] = r[1] = r[2] = 0.0


@compiled
def take_mag(s: ComplementaryState, p: ComplementaryGains, mag_b: Vec3) -> None:
    """Correct the heading by one magnetometer sample.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    mag_b : tuple of 3 floats
        Calibrated field in body FRD, uT.
    """
    if s.lost == 1:
        return
    dt = min(s.time_s - s.mag_s, STALE_MAG_S)
    north, east, down = rotate(as_quat(s.q_eb), mag_b)
    norm = math.sqrt(north * north + east * east + down * down)
    weight = take_field(s, p, norm, down)
    if weight <= 0.0:
        return
    declination = s.declination_rad
    if s.heading_known == 0 or math.isfinite(declination):
        s.heading_true = 1 if math.isfinite(declination) else s.heading_true
    measured = -math.atan2(east, north)
    if math.isfinite(declination):
        measured += declination
    correct_heading(s, p, measured, p.heading_noise_rad2s / (dt * weight))


@compiled
def information_of(accel_n: Vec3, dt: float, noise_mps: float) -> float:
    """Return how much the mean acceleration of one interval says of the heading, 1/rad2."""
    power = accel_n[0] * accel_n[0] + accel_n[1] * accel_n[1]
    return power * dt * MATCH_WINDOW_S / (2.0 * noise_mps * noise_mps)


@compiled
def take_match(
    s: ComplementaryState,
    p: ComplementaryGains,
    force_e: Vec3,
    accel_n: Vec3,
    dt: float,
    noise: float,
) -> None:
    """Correct the heading by matching the horizontal force with the GPS acceleration.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    force_e : tuple of 3 floats
        Mean specific force in the level frame, m/s2.
    accel_n : tuple of 3 floats
        Mean acceleration in NED, m/s2.
    dt : float
        Length of the interval, s.
    noise : float
        Of the GPS velocity, m/s.
    """
    if s.heading_known == 1:
        information = information_of(accel_n, dt, noise)
        if information > 0.0:
            s.heading_true = 1
            real = force_e[0] * accel_n[0] + force_e[1] * accel_n[1]
            imag = force_e[0] * accel_n[1] - force_e[1] * accel_n[0]
            correct_heading(s, p, math.atan2(imag, real), 1.0 / information)
