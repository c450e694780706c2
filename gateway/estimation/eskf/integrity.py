"""Integrity of the attitude: found by gravity or from motion, and checked with both.

| state | condition | next |
| --- | --- | --- |
| lost | without GPS: gravity gives the level | levelled |
| lost | the pairs of GPS velocities give the level | levelled, or heading too |
| levelled | a compass or the pairs give the heading | heading known |
| any | the pairs, or gravity, contradict the attitude for some time | lost |
| any | a gap or a bias step leaves the attitude unknown | lost |
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf import alignment, update
from gateway.estimation.eskf.magnetometer import reset_hard_iron, turn_heading
from gateway.estimation.eskf.predict import NO_HEADING_VAR, propagate
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    GYRO_BIAS,
    GYRO_SCALE,
    VEL,
    State,
    level_variance,
    raise_variance,
    reset_state,
    reset_states,
)
from gateway.estimation.record import as_quat, as_vec, write_quat, write_vec
from gateway.geometry import quaternion as quat
from gateway.units import STANDARD_GRAVITY_MPS2

LOST_LEVEL_VAR: Final = 0.5**2
"""Variance of an unknown level, rad2: about the largest that a linear filter can correct."""
LOST_LEVEL_RAD: Final = 0.35
"""Standard deviation above which an attitude is lost."""
FOUND_LEVEL_RAD: Final = 0.08
FOUND_HEADING_RAD: Final = 0.3
"""Maximum standard deviations of an accepted alignment: the filter is linear within them."""
PATIENCE_S: Final = 8.0
"""Time without an attitude after which the accepted error of the level grows in proportion."""
MISMATCH_LEVEL_RAD: Final = 0.14
MISMATCH_S: Final = 2.0
"""Significant difference of the level from the alignment, and its duration, after which the
attitude is replaced; the limit of the heading is that of its acceptance."""
GRAVITY_MISMATCH_RAD: Final = 0.6
GRAVITY_MISMATCH_S: Final = 5.0
"""The same without GPS, when manoeuvres may look like a tilt."""


@compiled
def lose_attitude(s: State, p: Gains) -> None:
    """Discard the attitude; the position follows the fixes until an attitude is found."""
    s.lost, s.lost_s, s.mismatch_s, s.heading_known = 1, 0.0, 0.0, 0
    alignment.clear_pairs(s)
    begin_attitude(s, p, LOST_LEVEL_VAR, NO_HEADING_VAR)
    # The low-pass contains forces rotated by the discarded attitude, or by an unknown one.
    s.force_lp_s = 0.0


@compiled
def begin_attitude(s: State, p: Gains, level_var: float, heading_var: float) -> None:
    """Reset the covariance of the attitude; position and velocity restart at the next fix."""
    propagate(s, p)
    reset_state(s, ATT, level_var)
    reset_state(s, ATT + 1, level_var)
    # An unknown heading is relative to the start of the filter, and so has no variance.
    reset_state(s, ATT + 2, heading_var if s.heading_known == 1 or s.lost == 1 else 0.0)
    end_aiding(s)
    # The integrals in NED contain the old attitude.
    s.history_count = 0


@compiled
def end_aiding(s: State) -> None:
    """Stop estimating position and velocity."""
    reset_states(s, VEL, 0.0)
    s.vel_n[:] = 0.0
    s.aided = 0


@compiled
def level_by_gravity(s: State, p: Gains, dt: float) -> None:
    """Level by gravity while GPS velocities do not; `dt` is the time since the last call."""
    if s.lost == 1:
        if s.time_s - s.pair_s > alignment.MAX_PAIR_S and s.force_lp_s > dt:
            find_level(s, p, dt)
        return
    north, east, down = update.gravity_force_n(s)
    off = math.atan2(math.hypot(north, east), -down)
    std = math.sqrt(level_variance(s) + update.gravity_variance(s, p) / STANDARD_GRAVITY_MPS2**2)
    wrong = (
        off > max(GRAVITY_MISMATCH_RAD, alignment.MISMATCH_SIGMA * std)
        and update.sustained_sq(s) == 0.0
    )
    s.mismatch_s = s.mismatch_s + dt if wrong else 0.0
    if s.mismatch_s > GRAVITY_MISMATCH_S or level_variance(s) > LOST_LEVEL_RAD**2:
        lose_attitude(s, p)
        return
    update.update_gravity(s, p, dt)


@compiled
def find_level(s: State, p: Gains, dt: float) -> None:
    """Rotate the attitude to make the filtered force vertical, and accept it if accurate enough."""
    s.lost_s += dt
    north, east, down = update.gravity_force_n(s)
    level = math.hypot(north, east)
    if level > 0.0:
        angle = math.atan2(level, -down)
        turn = quat.from_rotation_vector((-angle * east / level, angle * north / level, 0.0))
        write_quat(s.q_nb, quat.normalise(quat.multiply(turn, as_quat(s.q_nb))))
    begin_attitude(s, p, LOST_LEVEL_VAR, NO_HEADING_VAR)
    update.update_gravity(s, p, 2.0 * p.gravity_tau_s)
    if level_variance(s) < 2.0 * (FOUND_LEVEL_RAD * max(1.0, s.lost_s / PATIENCE_S)) ** 2:
        s.lost = 0
        reset_state(s, ATT + 2, 0.0)


@compiled
def check_attitude(s: State, p: Gains, dt: float, sound: bool) -> None:
    """Compare the attitude with the alignment after a new pair of `dt` seconds."""
    bias_var = 0.5 * (s.P[GYRO_BIAS, GYRO_BIAS] + s.P[GYRO_BIAS + 1, GYRO_BIAS + 1])
    noise = alignment.align(s, math.sqrt(bias_var))
    if sound and noise > 0.0:
        s.fix_excess += s.pairs / (s.pairs + alignment.ENOUGH_PAIRS) * (noise - s.fix_excess)
    level, heading = s.aligned_std[0], s.aligned_std[1]
    if s.lost == 1:
        s.lost_s += dt
        if level < FOUND_LEVEL_RAD * max(1.0, s.lost_s / PATIENCE_S):
            replace_attitude(s, p)
        return
    s.mismatch_s = s.mismatch_s + dt if differs_from_alignment(s) else 0.0
    if s.mismatch_s > MISMATCH_S:
        if s.was_aided == 1:
            discard_calibration(s, p)
        replace_attitude(s, p)
    elif s.heading_known == 0 and level < FOUND_LEVEL_RAD and heading < FOUND_HEADING_RAD:
        turn_heading(s, alignment.heading_difference(as_quat(s.aligned_q_nb), as_quat(s.q_nb)))
        reset_state(s, ATT + 2, heading * heading)
        s.heading_known = s.heading_true = 1


@compiled
def differs_from_alignment(s: State) -> bool:
    """Return whether alignment and attitude differ significantly."""
    found, q_nb = as_quat(s.aligned_q_nb), as_quat(s.q_nb)
    allowed = alignment.MISMATCH_SIGMA * math.sqrt(s.aligned_std[0] ** 2 + level_variance(s))
    if alignment.level_difference(found, q_nb) > max(MISMATCH_LEVEL_RAD, allowed):
        return True
    if s.heading_known == 0 or s.aligned_std[1] > FOUND_HEADING_RAD:
        return False
    allowed = alignment.MISMATCH_SIGMA * math.sqrt(s.aligned_std[1] ** 2 + s.P[ATT + 2, ATT + 2])
    return abs(alignment.heading_difference(found, q_nb)) > max(FOUND_HEADING_RAD, allowed)


@compiled
def replace_attitude(s: State, p: Gains) -> None:
    """Replace the attitude by that of the alignment, with its heading if known."""
    found = as_quat(s.aligned_q_nb)
    heading_std = s.aligned_std[1]
    s.lost, s.mismatch_s = 0, 0.0
    s.heading_known = 1 if heading_std < FOUND_HEADING_RAD else 0
    if s.heading_known == 1:
        s.heading_true = 1
    else:
        turn_rad = alignment.heading_difference(as_quat(s.q_nb), found)
        found = quat.normalise(
            quat.multiply(quat.from_rotation_vector((0.0, 0.0, turn_rad)), found)
        )
    write_quat(s.q_nb, found)
    require_bias_variance(s, p.gyro_bias_change_radps)
    begin_attitude(s, p, s.aligned_std[0] ** 2, heading_std * heading_std)


@compiled
def require_bias_variance(s: State, std: float) -> None:
    """Raise the variance of the gyroscope bias to that of a standard deviation, rad/s."""
    for k in range(3):
        more = std * std - s.P[GYRO_BIAS + k, GYRO_BIAS + k]
        raise_variance(s, GYRO_BIAS + k, max(more, 0.0))


@compiled
def discard_calibration(s: State, p: Gains) -> None:
    """Reset the sensor errors that were estimated with a wrong attitude."""
    reset_accel_bias(s, p)
    reset_hard_iron(s, p)
    s.gyro_scale_b[:] = 0.0
    if s.rest_seen > 0:
        write_vec(s.gyro_bias_b, as_vec(s.rest_bias_b))
    reset_states(s, GYRO_BIAS, gyro_bias_var(s, p))
    reset_states(s, GYRO_SCALE, p.gyro_scale_var)


@compiled
def reset_accel_bias(s: State, p: Gains) -> None:
    """Reset the accelerometer bias."""
    propagate(s, p)
    s.accel_bias_b[:] = 0.0
    reset_states(s, ACCEL_BIAS, accel_bias_var(s, p))


@compiled
def reset_gyro_bias(s: State, p: Gains) -> None:
    """Reset the gyroscope bias, and that of the last rest."""
    propagate(s, p)
    s.gyro_bias_b[:] = 0.0
    s.rest_bias_b[:] = 0.0
    s.rest_seen = 0
    reset_states(s, GYRO_BIAS, gyro_bias_var(s, p))


@compiled
def gyro_bias_var(s: State, p: Gains) -> float:
    """Return the variance of the gyroscope bias before it is measured, rad2/s2."""
    return (
        p.gyro_bias_uncalibrated_var if s.uncalibrated & 1 and s.rest_seen == 0 else p.gyro_bias_var
    )


@compiled
def accel_bias_var(s: State, p: Gains) -> float:
    """Return the variance of the accelerometer bias before it is measured, m2/s4."""
    return p.accel_bias_uncalibrated_var if s.uncalibrated & 2 else p.accel_bias_var
