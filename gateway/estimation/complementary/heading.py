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
from gateway.estimation.alignment import collect_match, information_of
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.kernel_record import as_quat
from gateway.estimation.magfield import MIN_FIELD_UT, STALE_MAG_S, compare_field
from gateway.geometry.quaternion import rotate, wrap_pi
from gateway.records import Vec3

UNKNOWN_VAR: Final = 10.0
"""Variance of a heading of which nothing is known, rad2."""
GOOD_VAR: Final = 0.07
"""Up to 15 deg of standard deviation, the GPS acceleration may be turned by the heading."""


@compiled
def is_heading_good(s: ComplementaryState) -> bool:
    """Tell whether horizontal vectors may be turned by the heading."""
    return s.heading_known == 1 and s.heading_var < GOOD_VAR


@compiled
def correct_heading(s: ComplementaryState, measured_rad: float, variance: float) -> None:
    """Blend one measured heading in, the shortest way round."""
    if s.heading_known == 0:
        s.heading_rad, s.heading_var, s.heading_known = measured_rad, variance, 1
        return
    gain = s.heading_var / (s.heading_var + variance)
    s.heading_rad = wrap_pi(s.heading_rad + gain * wrap_pi(measured_rad - s.heading_rad))
    s.heading_var *= 1.0 - gain


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
    dt = s.time_s - s.mag_s
    if dt <= 0.0:
        return
    s.mag_s = s.time_s
    north, east, down = rotate(as_quat(s.q_eb), mag_b)
    norm = math.sqrt(north * north + east * east + down * down)
    if norm < MIN_FIELD_UT:
        return
    dt = min(dt, STALE_MAG_S)
    weight = compare_field(s, p, norm, math.asin(down / norm), dt)
    if weight <= 0.0:
        return
    declination = s.declination_rad
    if s.heading_known == 0 or math.isfinite(declination):
        s.heading_true = 1 if math.isfinite(declination) else s.heading_true
    measured = -math.atan2(east, north)
    if math.isfinite(declination):
        measured += declination
    correct_heading(s, measured, p.heading_noise_rad2s / (dt * weight))


@compiled
def take_match(
    s: ComplementaryState, p: ComplementaryGains, force_e: Vec3, accel_n: Vec3, dt: float
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
    """
    noise = p.gps_velocity_noise_mps
    if s.heading_known == 1:
        information = information_of(accel_n, dt, noise)
        if information > 0.0:
            s.heading_true = 1
            real = force_e[0] * accel_n[0] + force_e[1] * accel_n[1]
            imag = force_e[0] * accel_n[1] - force_e[1] * accel_n[0]
            correct_heading(s, math.atan2(imag, real), 1.0 / information)
    elif collect_match(s, force_e, accel_n, dt, noise):
        s.heading_true = 1
        correct_heading(s, math.atan2(s.match[1], s.match[0]), 1.0 / s.match[2])
