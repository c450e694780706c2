"""Beginnings: of the filter, its sensors, heading, position and velocity; and after a gap."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_latency import begin_latency, forget_velocities
from gateway.estimation.alignment.gps_velocity import FASTEST_MPS, forget_way
from gateway.estimation.alignment.review import (
    BROUGHT_BACK_RAD,
    GAP_LOST_RAD,
    GAP_TILT_RATE,
)
from gateway.estimation.alignment.wahba import carry_frame
from gateway.estimation.compass_lag import begin_lag
from gateway.estimation.eskf.covariance import NO_HEADING_VAR, propagate, renew, update_scalar
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
    BARO_BIAS,
    GYRO_BIAS,
    GYRO_SCALE,
    POS,
    STATES,
    TILT,
    VEL,
    WANDER,
    EskfState,
)
from gateway.estimation.eskf.iron import forget_iron, start_iron_search
from gateway.estimation.eskf.level_doubt import doubt_level, forget_accel_bias
from gateway.estimation.eskf.measure import compass_row
from gateway.estimation.eskf.recovery import lose_attitude, turn_heading
from gateway.estimation.filtering.sample_clock import (
    LONGEST_SILENCE_S,
    begin_clock,
    end_silence,
    is_end_told,
    is_rest_silent,
    is_turn_lost,
    silent_rate,
    silent_variance,
)
from gateway.estimation.filtering.uncalibrated import gyro_bias_var, note_flags
from gateway.estimation.kernel_record import (
    FloatArray,
    as_quat,
    as_vec,
    fill,
    write_quat,
    write_vec,
)
from gateway.estimation.local_position import NEVER_S
from gateway.estimation.magfield import UNCALIBRATED_IRON_UT
from gateway.estimation.rest_bias import forget_shown_bias
from gateway.estimation.sensor_faults import is_sound, is_start
from gateway.geometry.quaternion import (
    from_euler,
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
)
from gateway.records import NAN, Vec3

FIRST_VELOCITY_VAR: Final = 0.5**2
NO_VELOCITY_VAR: Final = 5.0**2
GAP_REST_RATE: Final = 0.02
GAP_HAND_RATE: Final = 0.3
"""What flies goes straight on, but a hand turns as it likes."""
GAP_ACCEL_MPS2: Final = 3.0
UNAIDED_SCALE: Final = 0.01
"""Before the first fix each axis of the gyroscope is taken to be off scale by this share, a third
of an MPU6050's tolerance; the level tells it as the motion turns."""


@compiled
def start(s: EskfState, p: EskfGains) -> None:
    """Set a fresh state."""
    write_quat(s.q_nb, (1.0, 0.0, 0.0, 0.0))
    for k in range(3):
        s.P[GYRO_BIAS + k, GYRO_BIAS + k] = p.gyro_bias_var
        s.P[ACCEL_BIAS + k, ACCEL_BIAS + k] = p.accel_bias_var
        s.P[GYRO_SCALE + k, GYRO_SCALE + k] = UNAIDED_SCALE * UNAIDED_SCALE
        s.wander_var[k] = p.gps_wander_var if k < 2 else p.gps_height_wander_var
        s.P[WANDER + k, WANDER + k] = s.wander_var[k]
        s.rate_b[k] = NAN
    s.declination_rad = p.declination_rad
    s.earth_dip_rad = NAN
    s.left_iron_ut = math.sqrt(p.mag_bias_var)
    begin_latency(s, p.gps_latency_s)
    begin_lag(s)
    forget_times(s)


@compiled
def forget_times(s: EskfState) -> None:
    """Drop all that is tied to the clock."""
    s.mag_s = s.mag_used_s = s.fix_s = s.weighed_s = NEVER_S
    s.pair_s = s.baro_s = s.pseudo_s = NEVER_S
    s.reject_last[0] = NEVER_S
    forget_velocities(s)
    forget_way(s)
    s.reject_s = s.rest_s = 0.0
    s.ring_count = s.at_rest = 0


@compiled
def note_calibration(s: EskfState, p: EskfGains, row: FloatArray) -> None:
    """Note what a sample's row says of the calibration of its sensors.

    Once one is calibrated, what was found of its error is out of it.
    """
    mag, gyro, accel = note_flags(s, row)
    if mag and s.mag_uncalibrated == 1:
        s.left_iron_ut = max(s.left_iron_ut, UNCALIBRATED_IRON_UT)
    elif mag:
        s.left_iron_ut = math.sqrt(p.mag_bias_var)
        forget_iron(s, p)
    if gyro:
        forget_gyro_bias(s, p)
    if accel and s.aided_before == 1:
        forget_accel_bias(s, p)


@compiled
def forget_gyro_bias(s: EskfState, p: EskfGains) -> None:
    """Know nothing of the gyroscope's bias."""
    propagate(s, p)
    fill(s.gyro_bias_b, 0.0)
    forget_shown_bias(s)
    for k in range(GYRO_BIAS, GYRO_BIAS + 3):
        renew(s, k, gyro_bias_var(s, p.gyro_bias_var))


@compiled
def begin(s: EskfState, p: EskfGains, time_us: int, gyro: Vec3, accel: Vec3) -> None:
    """Start at the first sound sample, level by its specific force."""
    if not is_start(s, gyro, accel):
        return
    begin_clock(s, time_us, gyro, accel)
    roll = math.atan2(-accel[1], -accel[2])
    pitch = math.atan2(accel[0], math.hypot(accel[1], accel[2]))
    write_quat(s.q_nb, from_euler(roll, pitch, 0.0))
    write_quat(s.q_ib, (1.0, 0.0, 0.0, 0.0))
    # One sample may be anything: the alignment finds the level within the first seconds.
    lose_attitude(s, p)


@compiled
def start_heading_by_compass(
    s: EskfState, p: EskfGains, field_n: Vec3, turn_rad: float, variance: float
) -> None:
    """Take the heading from the compass: it has the tilt's error, through the field's dip."""
    propagate(s, p)
    turn_heading(s, turn_rad)
    renew(s, TILT + 2, NO_HEADING_VAR)
    compass_row(s, field_n)
    update_scalar(s, 0.0, variance, p.gate_sq)
    s.heading_known, s.compass_share = 1, 1.0


@compiled
def restart_at(s: EskfState, p: EskfGains, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Take position and velocity from one fix alone.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    pos, vel : tuple of 3 floats
        The fix, metres from the origin and m/s; NaN what it does not tell.
    lag : float
        Its age, s.
    """
    propagate(s, p)
    told = is_sound(vel, FASTEST_MPS)
    vel = vel if told else (0.0, 0.0, 0.0)
    for k in range(3):
        renew(s, VEL + k, FIRST_VELOCITY_VAR if told else NO_VELOCITY_VAR)
        s.vel_n[k] = vel[k]
    for k in range(2):
        start_position(s, k, pos[k] + vel[k] * lag, p.gps_position_var)
    start_height(s, p, pos[2] + vel[2] * lag)
    s.aided = s.level_shown = 1
    fill(s.assumed_bias, 0.0)
    fill(s.assumed_scale, 0.0)
    if s.aided_before == 0:
        s.aided_before = 1
        for k in range(3):
            renew(s, GYRO_SCALE + k, p.gyro_scale_var)
        doubt_level(s, p)
        start_iron_search(s, p)
    s.off_last_m = s.contradiction_m = s.contradiction_mps = 0.0
    s.doubt_vel_sq = s.doubt_pos_sq = 0.0


@compiled
def start_height(s: EskfState, p: EskfGains, down_m: float) -> None:
    """Take the height from the first fix that tells one."""
    if s.has_height == 1 or not math.isfinite(down_m):
        return
    start_position(s, 2, down_m, p.gps_height_var)
    s.has_height, s.height_off_s = 1, 0.0
    if s.baro_known == 1:
        restart_baro(s, p)


@compiled
def restart_baro(s: EskfState, p: EskfGains) -> None:
    """Take the barometer's offset from the present height."""
    propagate(s, p)
    s.baro_bias_m = s.pos_n[2] - s.baro_down_m
    s.renewals[BARO_BIAS] += 1.0
    for j in range(STATES):
        s.P[BARO_BIAS, j] = s.P[POS + 2, j]
        s.P[j, BARO_BIAS] = s.P[j, POS + 2]
    s.P[BARO_BIAS, BARO_BIAS] = s.P[POS + 2, POS + 2] + p.baro_var


@compiled
def set_covariance(s: EskfState, i: int, j: int, covariance: float) -> None:
    """Set one covariance."""
    s.P[i, j] = s.P[j, i] = covariance


@compiled
def start_position(s: EskfState, k: int, value: float, noise_var: float) -> None:
    """Start one coordinate at a fix: the fix's slow error is then its own, reversed."""
    wander_var = s.wander_var[k]
    s.pos_n[k], s.wander_n[k] = value, 0.0
    renew(s, POS + k, wander_var + noise_var)
    renew(s, WANDER + k, wander_var)
    set_covariance(s, POS + k, WANDER + k, -wander_var)


@compiled
def end_dead_reckoning(s: EskfState, p: EskfGains) -> None:
    """Give position and velocity up; from here on the velocity only keeps the attitude level."""
    propagate(s, p)
    s.aided = 0
    s.unaided_sq = 0.5 * (s.vel_n[0] ** 2 + s.vel_n[1] ** 2)
    for k in range(3):
        renew(s, VEL + k, p.unaided_var + s.unaided_sq)
        s.vel_n[k] = 0.0


@compiled
def bridge_gap(s: EskfState, p: EskfGains, dt: float) -> None:
    """Go on after a silence: on in the same turn, and less sure; lost where it turned."""
    dt = min(dt, LONGEST_SILENCE_S)
    still = is_rest_silent(s)
    rate = silent_rate(s, as_vec(s.gyro_bias_b))
    turning = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    turned_rad = GAP_REST_RATE if still else wander_rate(s) + turning
    turn_rad = rotate(as_quat(s.q_nb), rate)[2] * dt
    turn_on(s, turn_rad)
    s.silent_turn_rad += turn_rad
    go_straight_on(s, p, silent_variance(s, turned_rad, dt), dt)
    s.rest_unsure = 1 if still else 0
    if is_turn_lost(s, still):
        lose_attitude(s, p)


@compiled
def bridge_silence(s: EskfState, p: EskfGains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Go on at the sample that ends a silence, `dt` after the last sample or fix."""
    if not is_end_told(s, gyro, accel):
        bridge_gap(s, p, dt)
        return
    q_nb, bias_b = as_quat(s.q_nb), as_vec(s.gyro_bias_b)
    mean, std = end_silence(s, q_nb, bias_b, gyro, wander_rate(s))
    if std > (BROUGHT_BACK_RAD if s.aided == 1 else GAP_LOST_RAD):
        bridge_gap(s, p, dt)
        if s.lost == 0:
            lose_attitude(s, p)
        return
    dt = min(dt, LONGEST_SILENCE_S)
    turn_rad = rotate(q_nb, silent_rate(s, bias_b))[2] * dt
    turn_on(s, turn_rad)
    turn_heading(s, -turn_rad - s.silent_turn_rad)
    rate = rate_of(s, mean)
    carry_frame(s, rate, s.gap_s)
    turn = from_rotation_vector((rate[0] * s.gap_s, rate[1] * s.gap_s, rate[2] * s.gap_s))
    write_quat(s.q_nb, normalise(multiply(as_quat(s.q_nb), turn)))
    go_straight_on(s, p, max(std * std - s.silent_rad * s.silent_rad, 0.0), dt)
    s.rest_unsure = 0
    s.silent_s = s.silent_rad = s.silent_turn_rad = 0.0
    write_vec(s.gyro_held, gyro)
    write_vec(s.accel_held, accel)


@compiled
def rate_of(s: EskfState, gyro: Vec3) -> Vec3:
    """Return the angular rate of what the gyroscope reads, without its bias and scale, rad/s."""
    b, e = s.gyro_bias_b, s.gyro_scale_b
    return (
        gyro[0] - b[0] - e[0] * gyro[0],
        gyro[1] - b[1] - e[1] * gyro[1],
        gyro[2] - b[2] - e[2] * gyro[2],
    )


@compiled
def wander_rate(s: EskfState) -> float:
    """Return by how much it may turn in a silence beside the turn that it was in, rad/s."""
    return GAP_TILT_RATE if s.aided == 1 else GAP_HAND_RATE


@compiled
def go_straight_on(s: EskfState, p: EskfGains, turned_var: float, dt: float) -> None:
    """Let place and velocity go on in a silence, and be less sure of all."""
    propagate(s, p)
    s.sound_s = 0.0
    before_sq = s.silent_s * s.silent_s
    s.silent_s += dt
    silent_sq = s.silent_s * s.silent_s
    for k in range(3):
        if s.aided == 1:
            s.pos_n[k] += s.vel_n[k] * dt
        s.P[TILT + k, TILT + k] += turned_var
        s.P[VEL + k, VEL + k] += GAP_ACCEL_MPS2**2 * (silent_sq - before_sq)
        s.P[POS + k, POS + k] += (0.5 * GAP_ACCEL_MPS2) ** 2 * (silent_sq**2 - before_sq**2)
        for first in (TILT, VEL, POS):
            s.renewals[first + k] += 1.0
    s.ring_count = 0
    s.pair_s = NEVER_S
    s.rest_s = 0.0
    s.at_rest = 0


@compiled
def turn_on(s: EskfState, turn_rad: float) -> None:
    """Turn attitude and velocity about down: a turn that was flown goes on."""
    half = 0.5 * turn_rad
    turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    write_quat(s.q_nb, normalise(multiply(turn, as_quat(s.q_nb))))
    write_vec(s.vel_n, rotate(turn, as_vec(s.vel_n)))
