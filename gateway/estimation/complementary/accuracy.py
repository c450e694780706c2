"""How accurate the estimate is: what the Kalman filter of `drift` does not say by itself.

Attitude: the filter's covariance, or, while gravity levels, what gravity's low-pass lets through.
Place and speed: as accurate as the fixes, and between them pushed by the acceleration that the
errors of tilt, heading and accelerometer let through: their covariance with these tells how such
errors add up on a straight way, and cancel in turns.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.review import GAP_S
from gateway.estimation.columns import GPS_H_ACC
from gateway.estimation.complementary.complementary_state import (
    HEADING,
    PLACE,
    SPEED,
    TILT,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift import begin_state, carry_drift
from gateway.estimation.complementary.errors.drift_update import cleared_row, push_state
from gateway.estimation.complementary.manoeuvre import (
    JITTER_S,
    unbiased_force,
    write_force_row,
)
from gateway.estimation.complementary.navigation import REST_DECAY_S
from gateway.estimation.complementary.unaided import unaided_level_std, watch_level
from gateway.estimation.filtering.covariance_scale import scale_state
from gateway.estimation.filtering.receiver_noise import lasting_noise_sq
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.estimation.magfield import usual_dip
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
REST_MPS: Final = 0.05
"""What is taken for rest may be this fast."""
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
    if s.lost == 1 or s.level_by_gps == 0:
        push_place_unaided(s, dt)
    else:
        push_place(s, dt)
    if s.at_rest == 1:
        fade_speed(s, dt)
    write_vec(s.accuracy_force_i, as_vec(s.integrals))
    tell_place(s)


@compiled
def push_place(s: ComplementaryState, dt: float) -> None:
    """Let the errors of attitude and accelerometer push the speed, and that the place."""
    now, old = s.integrals, s.accuracy_force_i
    force = unbiased_force(
        s, ((now[0] - old[0]) / dt, (now[1] - old[1]) / dt, (now[2] - old[2]) / dt)
    )
    for k in range(2):
        cleared_row(s)[SPEED + k] = 1.0
        push_state(s, PLACE + k, dt)
        if s.at_rest == 0:
            write_force_row(s, k, force)
            push_state(s, SPEED + k, dt)
            s.drift_cov[SPEED + k, SPEED + k] += s.force_density * dt


@compiled
def push_place_unaided(s: ComplementaryState, dt: float) -> None:
    """Do the same where gravity holds the level, or nothing: its error is taken to last."""
    P = s.drift_cov
    pull = STANDARD_GRAVITY_MPS2 * math.sqrt(0.5 * (s.told_std[0] ** 2 + s.told_std[1] ** 2))
    for k in range(2):
        speed = math.sqrt(P[SPEED + k, SPEED + k])
        place = math.sqrt(P[PLACE + k, PLACE + k]) + speed * dt
        if s.at_rest == 0:
            speed += pull * dt
        begin_state(s, SPEED + k, speed * speed + s.force_density * dt)
        begin_state(s, PLACE + k, place * place)


@compiled
def fade_speed(s: ComplementaryState, dt: float) -> None:
    """Be as sure of the speed as one can be of what stands."""
    kept = math.exp(-dt / REST_DECAY_S)
    for k in range(2):
        scale_state(s.drift_cov, SPEED + k, kept)
        s.drift_cov[SPEED + k, SPEED + k] += (1.0 - kept * kept) * REST_MPS * REST_MPS


@compiled
def tell_place(s: ComplementaryState) -> None:
    """Tell the accuracy of place and speed."""
    write_level_std(s, SPEED, s.told_speed_mps)
    write_level_std(s, PLACE, s.told_place_m)


@compiled
def write_level_std(s: ComplementaryState, first: int, told: FloatArray) -> None:
    """Turn two states of the level frame north and east, and write their standard deviations."""
    P = s.drift_cov
    sine, cosine = math.sin(s.heading_rad), math.cos(s.heading_rad)
    a, b = P[first, first], P[first + 1, first + 1]
    both = 2.0 * sine * cosine * P[first, first + 1]
    told[0] = math.sqrt(max(cosine * cosine * a + sine * sine * b - both, 0.0))
    told[1] = math.sqrt(max(sine * sine * a + cosine * cosine * b + both, 0.0))


@compiled
def write_attitude_std(s: ComplementaryState) -> None:
    """Write the standard deviations about north, east and down."""
    P, told = s.drift_cov, s.told_std
    if s.lost == 1:
        told[0] = told[1] = LOST_RAD
    elif s.level_by_gps == 1:
        write_level_std(s, TILT, told)
        s.unaided_level_sq = max(P[TILT, TILT], P[TILT + 1, TILT + 1])
    else:
        told[0] = told[1] = unaided_level_std(s)
    heading_var = P[HEADING, HEADING]
    if s.level_by_gps == 0:
        # A field that is turned by a wrong tilt points elsewhere, the more the steeper it is.
        heading_var += (told[0] * math.tan(usual_dip(s))) ** 2
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
    P, dt = s.drift_cov, s.time_s - s.fix_s
    share = 1.0 - math.exp(-dt / p.tau_position_s)
    speed_share = 1.0 - math.exp(-dt / p.tau_velocity_s)
    h_acc = row[GPS_H_ACC]
    fix_m = h_acc * AXIS_SHARE if h_acc > 0.0 else FIX_M
    fix_m = math.hypot(fix_m, JITTER_S * math.hypot(s.vel_n[0], s.vel_n[1]))
    lasting_sq = lasting_noise_sq(s, s.pull_mps2 * s.pull_mps2, dt)
    noise_mps = math.sqrt(max(noise_mps * noise_mps, lasting_sq))
    for k in range(2):
        place = math.sqrt(P[PLACE + k, PLACE + k])
        scale_state(P, PLACE + k, 1.0 - share)
        P[PLACE + k, PLACE + k] = (place + share * (fix_m - place)) ** 2
        scale_state(P, SPEED + k, 1.0 - speed_share)
        P[SPEED + k, SPEED + k] += (speed_share * noise_mps) ** 2
    tell_place(s)


@compiled
def doubt_place(s: ComplementaryState, off_m: float) -> None:
    """Be no surer of the place than fixes that are off by `off_m` allow."""
    for k in range(2):
        s.drift_cov[PLACE + k, PLACE + k] = max(s.drift_cov[PLACE + k, PLACE + k], off_m * off_m)
