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
from gateway.estimation.complementary.drift import carry_drift, correct_drift, heading_variance
from gateway.estimation.kernel_record import as_quat
from gateway.estimation.magfield import STALE_MAG_S, take_field
from gateway.geometry.quaternion import rotate, wrap_pi
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG

MAG_NOISE_DEG: Final = 3.2
"""Error of the compass that is another within a second or so."""
UNAIDED_NOISE_DEGPMPS2: Final = 10.0
"""What it adds that turns tilt the horizon where there is no GPS, by the dip of the field."""
JITTER_S: Final = 0.03
"""How much the latency of a fix varies."""
SLOW_MPS: Final = 5.0
"""A slower aircraft turns no faster."""
MATCH_WINDOW_S: Final = 0.33
"""Differences of successive velocities share their noise; over this time it averages out."""
GOOD_VAR: Final = 0.3
"""Up to 30 deg of standard deviation, the GPS acceleration may be turned by the heading."""


@compiled
def is_heading_good(s: ComplementaryState) -> bool:
    """Return whether horizontal vectors may be turned by the heading."""
    return s.heading_known == 1 and heading_variance(s) < GOOD_VAR


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
    carry_drift(s, p)
    if s.heading_known == 0:
        s.heading_rad, s.heading_known = wrap_pi(measured), 1
    innovation = wrap_pi(measured - s.compass_rad - s.heading_rad)
    unaided = UNAIDED_NOISE_DEGPMPS2 * s.turning_mps2 if s.by_gps == 0 else 0.0
    density = (MAG_NOISE_DEG**2 + unaided**2) * RAD_PER_DEG**2
    correct_drift(s, p, (0.0, 0.0, 0.0, 1.0, 1.0), innovation, density / (dt * weight))


@compiled
def match_variance(s: ComplementaryState, force_e: Vec3, dt: float, noise_mps: float) -> float:
    """Return how uncertain a heading is that one interval's mean acceleration tells, rad2.

    The accelerometer tells how strong that was; the acceleration by GPS is, in straight flight,
    but its noise. In a turn the latency counts, by how much it varies.
    """
    pull = math.hypot(force_e[0], force_e[1])
    turn = pull / max(math.hypot(s.vel_n[0], s.vel_n[1]), SLOW_MPS)
    seen = 2.0 * noise_mps * noise_mps / (pull * pull * MATCH_WINDOW_S)
    return (seen + (JITTER_S * turn) ** 2) / dt


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
    power = force_e[0] ** 2 + force_e[1] ** 2
    if s.heading_known == 0 or power <= 0.0:
        return
    s.heading_true = 1
    carry_drift(s, p)
    half = -0.5 * s.heading_rad
    told = rotate((math.cos(half), 0.0, 0.0, math.sin(half)), accel_n)
    across = force_e[0] * told[1] - force_e[1] * told[0]
    innovation = max(-1.0, min(1.0, across / power))
    variance = match_variance(s, force_e, dt, noise)
    correct_drift(s, p, (0.0, 0.0, 0.0, 1.0, 0.0), innovation, variance)
