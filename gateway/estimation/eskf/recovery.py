"""An attitude that is lost, and one that the alignment has found."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.review import (
    GRAVITY_PAIR_S,
    find,
    is_to_be_taken,
    lose,
    tells_heading,
)
from gateway.estimation.alignment.wahba import HAND_MPS, align_by_gravity, heading_difference
from gateway.estimation.eskf.covariance import NO_HEADING_VAR, level_variance, propagate, renew
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    GYRO_BIAS,
    GYRO_SCALE,
    TILT,
    VEL,
    EskfState,
)
from gateway.estimation.eskf.iron import forget_iron
from gateway.estimation.eskf.level_doubt import forget_accel_bias
from gateway.estimation.filtering.hidden_pull import forget_level
from gateway.estimation.filtering.uncalibrated import gyro_bias_var
from gateway.estimation.kernel_record import as_quat, as_vec, write_quat
from gateway.estimation.magfield import begin_turn
from gateway.estimation.rest import SHAKEN
from gateway.estimation.rest_bias import BIAS_CHANGE_RADPS
from gateway.geometry.quaternion import multiply, normalise
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

ENOUGH_HEADING_RAD: Final = 0.3
"""A heading no surer than this is a beginning: the fixes that follow tell it."""
LOST_TILT_VAR: Final = 0.5**2
HAND_VAR: Final = (0.5 * HAND_MPS) ** 2
"""Of each axis of the velocity where an attitude begins in a hand's motion."""
PULLED_LEVEL_VAR: Final = 0.2**2
"""A level is found no less sure than this, or it would be lost again at once."""
OWN_FRAME_VAR: Final = 0.0
"""While no heading is known, it is counted from where the filter began: that it knows."""


@compiled
def raise_bias_variance(s: EskfState, std: float) -> None:
    """Believe the gyroscope's bias no more firmly than to a standard deviation in rad/s."""
    for k in range(3):
        more = max(std * std - s.P[GYRO_BIAS + k, GYRO_BIAS + k], 0.0)
        s.P[GYRO_BIAS + k, GYRO_BIAS + k] += more
        s.bias_raised[k] += more


@compiled
def begin_attitude(s: EskfState, p: EskfGains, level_var: float, heading_var: float) -> None:
    """Begin the covariance of an attitude; place and velocity begin at the next fix."""
    propagate(s, p)
    renew(s, TILT, level_var)
    renew(s, TILT + 1, level_var)
    s.force_turn_var = 0.0
    renew(s, TILT + 2, heading_var)
    s.compass_share = 0.0
    for k in range(3):
        renew(s, VEL + k, max(HAND_VAR, s.unaided_sq))
        s.vel_n[k] = 0.0
    s.hand_sq = HAND_VAR
    s.aided = 0
    # The integrals in NED stand in the old attitude.
    s.ring_count = 0


@compiled
def turn_heading(s: EskfState, turn_rad: float) -> None:
    """Turn the whole attitude about down."""
    half = 0.5 * turn_rad
    turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    write_quat(s.q_nb, normalise(multiply(turn, as_quat(s.q_nb))))
    s.renewals[TILT + 2] += 1.0
    # The integrals stand in the old heading.
    s.ring_count = 0


@compiled
def lose_attitude(s: EskfState, p: EskfGains) -> None:
    """Give the attitude up; the place follows the fixes until the alignment has found another."""
    lose(s)
    if s.aided == 0:
        forget_level(s)
    begin_attitude(s, p, LOST_TILT_VAR, NO_HEADING_VAR)


@compiled
def take_rest_bias(s: EskfState, p: EskfGains) -> None:
    """Begin anew with the bias that a rest has shown: the one before has turned the attitude."""
    lose_attitude(s, p)
    for k in range(3):
        s.gyro_bias_b[k] = s.gyro_rest[k]
        renew(s, GYRO_BIAS + k, BIAS_CHANGE_RADPS * BIAS_CHANGE_RADPS)
    begin_turn(s, (0.0, 0.0, 0.0))
    forget_iron(s, p)


@compiled
def check_rest(s: EskfState, p: EskfGains, gyro: Vec3, accel: Vec3) -> None:
    """Give the attitude up where a rest has ended during a silence: it may be any by now."""
    if s.rest_unsure == 0:
        return
    s.rest_unsure = 0
    turned, pulled = 0.0, 0.0
    for k in range(3):
        turned += (gyro[k] - s.gyro_lp[k]) ** 2
        pulled += (accel[k] - s.accel_lp[k]) ** 2
    if turned > (SHAKEN * p.rest_gyro_radps) ** 2 or pulled > p.rest_accel_mps2**2:
        lose_attitude(s, p)


@compiled
def watch_gravity(s: EskfState, p: EskfGains) -> None:
    """Look at gravity where GPS tells no velocity."""
    dt = align_by_gravity(s, s.time_s, as_vec(s.integrals), GRAVITY_PAIR_S, True)
    if dt > 0.0:
        review_attitude(s, p, dt)


@compiled
def review_attitude(s: EskfState, p: EskfGains, dt: float) -> None:
    """Compare the attitude with the alignment after a new pair of `dt` seconds."""
    level_told = math.sqrt(level_variance(s))
    heading_told = math.sqrt(s.P[TILT + 2, TILT + 2])
    bias = math.sqrt(0.5 * (s.P[GYRO_BIAS, GYRO_BIAS] + s.P[GYRO_BIAS + 1, GYRO_BIAS + 1]))
    if not is_to_be_taken(s, as_quat(s.q_nb), level_told, heading_told, bias, dt):
        if tells_heading(s, ENOUGH_HEADING_RAD):
            turn_heading(s, heading_difference(as_quat(s.found_q_nb), as_quat(s.q_nb)))
            renew(s, TILT + 2, s.heading_std * s.heading_std)
            s.compass_share = 0.0
            s.heading_known = s.heading_true = 1
        return
    if s.lost == 0 and s.aided_before == 1:
        doubt_sensors(s, p)
    write_quat(s.q_nb, find(s, as_quat(s.q_nb), ENOUGH_HEADING_RAD))
    if s.heading_known == 1:
        s.heading_true = 1
    heading_var = s.heading_std * s.heading_std if s.heading_known == 1 else OWN_FRAME_VAR
    raise_bias_variance(s, BIAS_CHANGE_RADPS)
    begin_attitude(s, p, found_level_var(s), heading_var)


@compiled
def doubt_sensors(s: EskfState, p: EskfGains) -> None:
    """Forget what the sensors have shown with GPS by an attitude that was wrong."""
    forget_accel_bias(s, p)
    forget_iron(s, p)
    for k in range(3):
        s.gyro_scale_b[k] = 0.0
        renew(s, GYRO_BIAS + k, gyro_bias_var(s, p.gyro_bias_var))
        renew(s, GYRO_SCALE + k, p.gyro_scale_var)


@compiled
def found_level_var(s: EskfState) -> float:
    """Return the variance of a level that the alignment has found, rad2.

    By gravity alone, a flight that changes its velocity in the time of the pairs leans the mean
    force by as much: two velocities of the size that has shown itself, an axis each.
    """
    told = s.level_std * s.level_std
    if s.by_gps == 1:
        return told
    span = STANDARD_GRAVITY_MPS2 * max(s.gathered_s, GRAVITY_PAIR_S)
    return max(told, min(2.0 * s.unaided_sq / (span * span), PULLED_LEVEL_VAR))
