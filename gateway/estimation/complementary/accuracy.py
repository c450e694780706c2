"""How accurate the estimate is: what the Kalman filter of `drift` does not say by itself.

Attitude: the filter's covariance, or, while gravity levels, what gravity's low-pass lets through.
Place and speed: as accurate as the fixes, and between them off by the acceleration that the errors
of tilt and heading let through. That acceleration keeps its direction for as long as an outage
lasts, so its errors add up rather than average out.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.review import GAP_S
from gateway.estimation.columns import GPS_H_ACC
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.drift import (
    HEADING,
    TILT,
    carry_drift,
    expected_variance,
)
from gateway.estimation.complementary.manoeuvre import (
    JITTER_S,
    unbiased_force,
    write_force_row,
)
from gateway.estimation.complementary.navigation import REST_DECAY_S
from gateway.estimation.complementary.unaided import unaided_level_std, watch_level
from gateway.estimation.filtering.receiver_noise import lasting_noise_sq
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.estimation.reference import NO_DECLINATION_RAD
from gateway.units import STANDARD_GRAVITY_MPS2

STEP_S: Final = 0.1
"""The accuracy is carried on this often."""
LOST_RAD: Final = 0.5
"""Standard deviation of a tilt that is lost."""
ANY_HEADING_RAD: Final = math.pi / math.sqrt(3.0)
"""The same of a heading that may be any."""
FIX_M: Final = 1.0
"""Error of a fix along an axis, where the receiver tells none."""
AXIS_SHARE: Final = math.sqrt(0.5)
"""Of a horizontal accuracy, along one axis."""


@compiled
def watch_accuracy(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Carry the standard deviations on, every `STEP_S`."""
    dt = s.time_s - s.accuracy_s
    if 0.0 <= dt < STEP_S:
        return
    s.accuracy_s = s.time_s
    dt = dt if 0.0 < dt < GAP_S else STEP_S
    if s.lost == 0:
        watch_level(s, p, dt)
    carry_drift(s, p)
    write_attitude_std(s)
    if s.at_rest == 1:
        kept = math.exp(-dt / REST_DECAY_S)
        s.fix_speed_mps *= kept
        s.pushed_speed_mps *= kept
        s.pushed_rough_sq *= kept * kept
    else:
        s.pushed_speed_mps += acceleration_std(s, dt) * dt
        s.pushed_rough_sq += s.force_density * dt
    write_vec(s.accuracy_force_i, as_vec(s.integrals))
    s.pushed_place_m += pushed_speed(s) * dt
    tell_place(s)


@compiled
def tell_place(s: ComplementaryState) -> None:
    """Put the accuracy of place and speed together."""
    gone_m = s.fix_speed_mps * (s.time_s - s.fix_s)
    s.told_place_m = math.sqrt(s.fix_place_m**2 + gone_m**2 + s.pushed_place_m**2)
    s.told_speed_mps = math.hypot(s.fix_speed_mps, pushed_speed(s))


@compiled
def pushed_speed(s: ComplementaryState) -> float:
    """Return the error of the speed since the last fix, by errors that last and by noise, m/s."""
    return math.sqrt(s.pushed_speed_mps**2 + s.pushed_rough_sq)


@compiled
def acceleration_std(s: ComplementaryState, dt: float) -> float:
    """Return the error of the level acceleration along one axis in the last `dt` seconds, m/s2."""
    if s.lost == 1 or s.level_by_gps == 0:
        return STANDARD_GRAVITY_MPS2 * math.sqrt(0.5 * (s.told_std[0] ** 2 + s.told_std[1] ** 2))
    now, old = s.integrals, s.accuracy_force_i
    force = unbiased_force(
        s, ((now[0] - old[0]) / dt, (now[1] - old[1]) / dt, (now[2] - old[2]) / dt)
    )
    variance = 0.0
    for axis in range(2):
        write_force_row(s, axis, force)
        variance += 0.5 * expected_variance(s)
    return math.sqrt(variance)


@compiled
def write_attitude_std(s: ComplementaryState) -> None:
    """Write the standard deviations about north, east and down."""
    P, told = s.drift_cov, s.told_std
    if s.lost == 1:
        told[0] = told[1] = LOST_RAD
    elif s.level_by_gps == 1:
        sine, cosine = math.sin(s.heading_rad), math.cos(s.heading_rad)
        a, b, c = P[TILT, TILT], P[TILT + 1, TILT + 1], P[TILT, TILT + 1]
        both = 2.0 * sine * cosine * c
        told[0] = math.sqrt(max(cosine * cosine * a + sine * sine * b - both, 0.0))
        told[1] = math.sqrt(max(sine * sine * a + cosine * cosine * b + both, 0.0))
        s.unaided_level_sq = max(a, b)
    else:
        told[0] = told[1] = unaided_level_std(s)
    heading_var = P[HEADING, HEADING]
    if s.level_by_gps == 0:
        # A field that is turned by a wrong tilt points elsewhere, the more the steeper it is.
        heading_var += (told[0] * math.tan(s.mag_dip_ref)) ** 2
    if s.heading_true == 0:
        heading_var += NO_DECLINATION_RAD * NO_DECLINATION_RAD
    told[2] = min(math.sqrt(heading_var), ANY_HEADING_RAD)


@compiled
def settle_place(
    s: ComplementaryState, p: ComplementaryGains, row: FloatArray, noise_mps: float
) -> None:
    """Bring place and speed to the accuracy of a fix, by the share that it was blended with.

    The error of its place is slow and does not average out, that of its velocity does, but for what
    lasts.
    """
    dt = s.time_s - s.fix_s
    share = 1.0 - math.exp(-dt / p.tau_position_s)
    h_acc = row[GPS_H_ACC]
    fix_m = h_acc * AXIS_SHARE if h_acc > 0.0 else FIX_M
    late_m = JITTER_S * math.hypot(s.vel_n[0], s.vel_n[1])
    s.fix_place_m = s.told_place_m + share * (math.hypot(fix_m, late_m) - s.told_place_m)
    lasting_sq = lasting_noise_sq(s, s.pull_mps2 * s.pull_mps2, dt)
    noise_mps = math.sqrt(max(noise_mps * noise_mps, lasting_sq))
    s.fix_speed_mps = math.hypot((1.0 - share) * s.told_speed_mps, share * noise_mps)
    s.pushed_place_m = s.pushed_speed_mps = s.pushed_rough_sq = 0.0
    s.told_place_m, s.told_speed_mps = s.fix_place_m, s.fix_speed_mps
