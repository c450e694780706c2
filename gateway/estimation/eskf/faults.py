"""Faults of the inertial sensors, and gaps between their samples.

| fault | detected by | remedy |
| --- | --- | --- |
| not finite, out of range, all zero | the value | replaced |
| one sensor repeats its values while the other changes | `STUCK_S` | replaced |
| a single outlier | six times the usual change | replaced |
| both sensors repeat their values | five times the usual time | no sample: a gap |
| a gap | time stamps | bridged from both of its ends, or the attitude is lost |

A missing rate or force is replaced by the last valid one for `HOLD_S`, then by no rotation and
gravity alone.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.integrity import LOST_LEVEL_RAD, lose_attitude
from gateway.estimation.eskf.latency import clear_velocities
from gateway.estimation.eskf.magnetometer import begin_turn
from gateway.estimation.eskf.predict import propagate, rate_of
from gateway.estimation.eskf.rest import is_usual_bias
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import ATT, NEVER_S, POS, VEL, State
from gateway.estimation.record import FloatArray, as_quat, as_vec, write_quat, write_vec
from gateway.geometry import quaternion as quat
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

GYRO_LIMIT_RADPS: Final = 40.0
ACCEL_LIMIT_MPS2: Final = 400.0
"""Limits beyond the largest ranges of such sensors, which are 2000 deg/s and 32 g."""
STUCK_S: Final = 1.0
HOLD_S: Final = 0.2
USUAL_S: Final = 0.5
"""Time constant of the average change from sample to sample."""
TIMES_USUAL: Final = 6.0
LARGEST_CHANGE: Final = ((2.0, 200.0), (10.0, 1000.0))
"""Step and slope of an agile multirotor or a shock: rad/s and rad/s2, m/s2 and m/s3."""
TIMES_USUAL_REPEAT: Final = 5.0
USUAL_REPEAT_S: Final = 5.0
"""Time constant of the average time for which both sensors repeat a sample."""
UNKNOWN_REPEAT_S: Final = 60.0
"""Initial value of that average: a log may repeat each sample until the next."""

GAP_S: Final = 0.5
GAP_STEPS: Final = 2.5
"""Interval, in s and in usual intervals, above which it is a gap; below, it is interpolated."""
LOST_STEPS: Final = 1.5
"""Multiple of the usual interval above which samples in between were lost."""
SLOWEST_STEP_S: Final = 2.0
"""Maximum first estimate of the usual interval: half that of the slowest logs."""
STEP_SHARE: Final = 0.01
"""Weight of the newest interval in the usual one: an average over a hundred samples."""
LONGEST_GAP_S: Final = 60.0
"""Capped: a longer gap adds no information and would destabilise the covariance."""
RATE_TAU_S: Final = 0.3
"""Correlation time of the angular rate, between that of a hand and of a fixed-wing aircraft."""
TURNING_S: Final = 5.0
"""Time constant of the mean square of the rate."""
UNSEEN_MPS2: Final = 3.0
"""Standard deviation of the acceleration in a gap."""
WANDER_RADPS: Final = 0.05
"""Standard deviation of the change of the mean rate in a gap."""


@compiled
def is_within_limits(gyro: Vec3, accel: Vec3) -> bool:
    """Return whether rate and force are finite and possible."""
    return quat.is_below(gyro, GYRO_LIMIT_RADPS) and quat.is_below(accel, ACCEL_LIMIT_MPS2)


@compiled
def change_of(v: Vec3, values: FloatArray, first: int) -> float:
    """Return the length of a vector minus three numbers of an array."""
    return math.sqrt(quat.norm_sq(quat.difference(v, as_vec(values[first : first + 3]))))


@compiled
def is_hanging(s: State, gyro: Vec3, accel: Vec3, moving: bool, dt: float) -> bool:
    """Return whether both sensors have repeated a sample for too long.

    A live sensor does not repeat six numbers, but a log may repeat samples, and an input without
    noise is constant at rest.
    """
    most_s = max(HOLD_S, TIMES_USUAL_REPEAT * s.usual_repeat_s)
    if change_of(gyro, s.imu_last, 0) == 0.0 and change_of(accel, s.imu_last, 3) == 0.0:
        s.repeat_s += dt
        at_rest = is_usual_bias(s, gyro) and not moving
        return bool(s.repeat_s > most_s and not at_rest)
    held_s = s.repeat_s + dt
    if s.repeat_s <= most_s:
        s.usual_repeat_s += held_s / (USUAL_REPEAT_S + held_s) * (held_s - s.usual_repeat_s)
    s.repeat_s = 0.0
    return False


@compiled
def check_sensor(s: State, k: int, v: Vec3, limit: float, other_same: bool, dt: float) -> int:
    """Check the gyroscope (`k` = 0) or the accelerometer (1).

    Returns 0 for a valid value, 1 for a single outlier, and 2 for a fault.
    """
    first = 3 * k
    from_last, from_held = change_of(v, s.imu_last, first), change_of(v, s.imu_held, first)
    same = from_last == 0.0
    # A gap between two equal samples does not count as time of repetition.
    repeated_s = min(dt, gap_limit_s(s))
    s.stuck_s[k] = s.stuck_s[k] + repeated_s if same and not other_same else 0.0
    # A real change also appears in the next sample.
    change = min(from_last, from_held)
    most = LARGEST_CHANGE[k][0] + LARGEST_CHANGE[k][1] * dt + TIMES_USUAL * s.usual_change[k]
    if math.isfinite(change):
        s.usual_change[k] += dt / (USUAL_S + dt) * (min(change, most) - s.usual_change[k])
    if not quat.is_below(v, limit) or s.stuck_s[k] >= STUCK_S:
        return 2
    return 1 if change > most else 0


@compiled
def check_sensors(
    s: State, gyro: Vec3, accel: Vec3, clipped: float, dt: float
) -> tuple[bool, bool]:
    """Return whether gyroscope and accelerometer can be used, and set the fault."""
    same_gyro = change_of(gyro, s.imu_last, 0) == 0.0
    same_accel = change_of(accel, s.imu_last, 3) == 0.0
    gyro_fault = check_sensor(s, 0, gyro, GYRO_LIMIT_RADPS, same_accel, dt)
    accel_fault = check_sensor(s, 1, accel, ACCEL_LIMIT_MPS2, same_gyro, dt)
    s.fault = 1 if gyro_fault == 2 or accel_fault == 2 or clipped != 0.0 else 0
    s.sound_s = s.sound_s + dt if s.fault == 0 else 0.0
    # A bus error changes both sensors, like a reset to zeros; a shock changes the force alone.
    odd = gyro_fault == 1 or quat.norm_sq(gyro) + quat.norm_sq(accel) == 0.0
    good_gyro, good_accel = gyro_fault == 0 and not odd, accel_fault == 0 and not odd
    for k in range(3):
        s.imu_last[k], s.imu_last[3 + k] = gyro[k], accel[k]
        if good_gyro:
            s.imu_held[k] = gyro[k]
        if good_accel:
            s.imu_held[3 + k] = accel[k]
    s.missing_s[0] = 0.0 if good_gyro else s.missing_s[0] + dt
    s.missing_s[1] = 0.0 if good_accel else s.missing_s[1] + dt
    return good_gyro, good_accel


@compiled
def substitutes(s: State) -> tuple[Vec3, Vec3]:
    """Return rate and force for a sample without valid ones."""
    gyro, accel = as_vec(s.gyro_bias_b), as_vec(s.imu_held[3:6])
    if s.missing_s[0] < HOLD_S:
        gyro = as_vec(s.imu_held[0:3])
    if s.missing_s[1] >= HOLD_S:
        gravity = quat.rotate_inverse(as_quat(s.q_nb), (0.0, 0.0, STANDARD_GRAVITY_MPS2))
        accel = quat.difference(as_vec(s.accel_bias_b), gravity)
    return gyro, accel


@compiled
def gap_limit_s(s: State) -> float:
    """Return the longest interval that is not a gap."""
    return max(GAP_S, GAP_STEPS * s.usual_step_s)


@compiled
def end_share_s(unseen_s: float) -> float:
    """Return the effective time of either end of a gap: `tau tanh(T / 2 tau)`."""
    return RATE_TAU_S * math.tanh(0.5 * unseen_s / RATE_TAU_S)


@compiled
def unseen_turn_var(s: State, before: Vec3, after: Vec3, steady: Vec3, unseen_s: float) -> float:
    """Return the variance of the unmeasured rotation between two samples, rad2.

    The rate is an Ornstein-Uhlenbeck process about a steady turn, with the variance of the recent
    motion: its integral, given both ends, has the variance of the rate times
    `2 tau (T - 2 tau tanh(T / 2 tau))`.
    """
    ends_sq = 0.0
    for k in range(3):
        ends_sq += 0.5 * ((before[k] - steady[k]) ** 2 + (after[k] - steady[k]) ** 2)
    spread = 2.0 * RATE_TAU_S * (unseen_s - 2.0 * end_share_s(unseen_s))
    return float(max(s.usual_rate_sq, ends_sq) * spread)


@compiled
def follow_step(s: State, gyro: Vec3, dt: float) -> None:
    """Update the usual interval, and the mean square of the rate."""
    if s.usual_step_s == 0.0:
        s.usual_step_s = min(dt, SLOWEST_STEP_S)
    s.usual_step_s += STEP_SHARE * (min(dt, 2.0 * s.usual_step_s) - s.usual_step_s)
    s.usual_rate_sq += min(dt / TURNING_S, 1.0) * (quat.norm_sq(gyro) / 3.0 - s.usual_rate_sq)


@compiled
def interpolate(
    s: State, before: FloatArray, gyro: Vec3, accel: Vec3, dt: float
) -> tuple[Vec3, Vec3]:
    """Return the mean rate and force of an interval, and add noise where samples were lost.

    A sample is the mean of the usual interval before it; both change linearly over the missing
    samples.
    """
    unseen_s = dt - s.usual_step_s
    if dt < LOST_STEPS * s.usual_step_s or s.sound_s <= dt:
        return gyro, accel
    gyro_before, accel_before = as_vec(before[0:3]), as_vec(before[3:6])
    turned = unseen_turn_var(s, gyro_before, gyro, as_vec(s.gyro_bias_b), unseen_s)
    s.pending_noise[0] += turned
    moved = UNSEEN_MPS2**2 * unseen_s * min(unseen_s, RATE_TAU_S)
    s.pending_noise[1] += moved + 0.25 * unseen_s * unseen_s * turned * quat.norm_sq(accel)
    share = 0.5 * unseen_s / dt
    return quat.part_way(gyro, gyro_before, share), quat.part_way(accel, accel_before, share)


@compiled
def bridge_gap(s: State, p: Gains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Continue after a gap of `dt`: with the steady turn before it and the rates at both ends."""
    propagate(s, p)
    dt = min(dt, LONGEST_GAP_S)
    rested = s.at_rest == 1
    close_gap(s)
    if rested and is_still(s, p, gyro, accel):
        add_gap_variance(s, (WANDER_RADPS * dt) ** 2, 0.0)
        return
    if rested:
        lose_attitude(s, p)
        return
    mean, about, steady = steady_turn(s)
    before = as_vec(s.imu_held[0:3])
    share = 2.0 * end_share_s(dt) / dt
    rate = rate_of(s, quat.part_way(steady, quat.part_way(before, gyro, 0.5), share))
    turned_var = unseen_turn_var(s, before, gyro, steady, dt)
    turned_var += ((WANDER_RADPS + math.sqrt(quat.norm_sq(mean))) * dt) ** 2
    turn = quat.from_rotation_vector(quat.scaled(rate, dt))
    write_quat(s.q_nb, quat.normalise(quat.multiply(as_quat(s.q_nb), turn)))
    write_quat(s.q_ib, quat.normalise(quat.multiply(as_quat(s.q_ib), turn)))
    flown_s = 0.0
    if s.aided == 1:
        # Fixes in the gap have already updated position and velocity.
        flown_s = min(s.time_s - s.fix_s, dt)
        half_rad = 0.5 * about * flown_s
        turn = quat.from_rotation_vector((0.0, 0.0, half_rad))
        # The mean velocity of an arc has the direction of its chord.
        mean = quat.rotate(turn, as_vec(s.vel_n))
        write_vec(s.vel_n, quat.rotate(turn, mean))
        chord = math.sin(half_rad) / half_rad if abs(half_rad) > 1e-6 else 1.0
        for k in range(3):
            s.pos_n[k] += mean[k] * flown_s * (chord if k < 2 else 1.0)
    add_gap_variance(s, turned_var, flown_s)
    if s.lost == 0 and turned_var > LOST_LEVEL_RAD * LOST_LEVEL_RAD:
        lose_attitude(s, p)


@compiled
def steady_turn(s: State) -> tuple[Vec3, float, Vec3]:
    """Return the mean rate before a gap, its part about down, and that part with the bias."""
    bias = as_vec(s.gyro_bias_b)
    mean = quat.difference(as_vec(s.imu_mean[0:3]), bias)
    down_b = quat.rotate_inverse(as_quat(s.q_nb), (0.0, 0.0, 1.0))
    about = down_b[0] * mean[0] + down_b[1] * mean[1] + down_b[2] * mean[2]
    return mean, about, quat.difference(bias, quat.scaled(down_b, -about))


@compiled
def is_still(s: State, p: Gains, gyro: Vec3, accel: Vec3) -> bool:
    """Return whether a sample is close to the means at rest."""
    return bool(
        change_of(gyro, s.imu_mean, 0) < 2.0 * p.rest_gyro_radps
        and change_of(accel, s.imu_mean, 3) < p.rest_accel_mps2
    )


@compiled
def add_gap_variance(s: State, turned_var: float, flown_s: float) -> None:
    """Inflate the variances of attitude, velocity and position after a gap."""
    for k in range(3):
        s.P[ATT + k, ATT + k] += turned_var
        s.P[VEL + k, VEL + k] += (UNSEEN_MPS2 * flown_s) ** 2
        s.P[POS + k, POS + k] += (0.5 * UNSEEN_MPS2 * flown_s * flown_s) ** 2
        for first in (ATT, VEL, POS):
            s.resets[first + k] += 1.0


@compiled
def close_gap(s: State) -> None:
    """Discard the state that needs continuous IMU samples."""
    s.history_count = 0
    clear_velocities(s)
    s.pair_s = NEVER_S
    s.sound_s = s.rest_s = 0.0
    s.at_rest = 0
    begin_turn(s, (0.0, 0.0, 0.0))
