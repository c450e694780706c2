"""GPS fixes as they arrive: when they are blended, believed anew, or left out; and silences."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_velocity import (
    FASTEST_MPS,
    WAY_NOISE_MPS,
    is_velocity_told,
    velocity_noise,
    velocity_of_fix,
)
from gateway.estimation.alignment.review import BROUGHT_BACK_RAD, GAP_LOST_RAD, GAP_TILT_RATE
from gateway.estimation.columns import GPS_SPEED_ACC
from gateway.estimation.complementary.accuracy import doubt_place, settle_place
from gateway.estimation.complementary.complementary_output import (
    DEAD_RECKONING_MAX_S,
)
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.bias import update_bias_at_rest
from gateway.estimation.complementary.errors.drift import doubt_sensors, raise_attitude_variance
from gateway.estimation.complementary.manoeuvre import take_fix_velocity
from gateway.estimation.complementary.navigation import (
    blend_fix,
    doubt_height,
    is_plausible,
    restart_at,
)
from gateway.estimation.complementary.reorientation import (
    begin_level,
    lose_attitude,
    review_attitude,
)
from gateway.estimation.complementary.tilt import doubt_held_level, hold_level, refresh, strapdown
from gateway.estimation.filtering.fix_intake import (
    accept_fix,
    is_fix_told,
    is_flown_unaided,
    learn_earth_field,
    look_back,
    pair_with,
    place_fix,
    wanted_time_s,
)
from gateway.estimation.filtering.sample_clock import (
    LONGEST_SILENCE_S,
    end_silence,
    is_end_told,
    is_rest_silent,
    is_turn_lost,
    silence_before,
    silent_rate,
    silent_variance,
)
from gateway.estimation.kernel_record import (
    FloatArray,
    as_quat,
    as_vec,
    write_vec,
)
from gateway.estimation.local_position import NEVER_S, is_relocked, past_state
from gateway.estimation.sensor_faults import is_sound
from gateway.geometry.angle import wrap_pi
from gateway.geometry.quaternion import rotate
from gateway.records import Vec3

SPATIAL_SHARE: Final = math.sqrt(1.0 / 3.0)
"""Of the accuracy of a velocity in space, along one axis."""


@compiled
def bridge_gap(s: ComplementaryState, p: ComplementaryGains, dt: float) -> None:
    """Go on after a silence: on in the same turn, level anew from here; lost where it turned."""
    dt = min(dt, LONGEST_SILENCE_S)
    still = is_rest_silent(s)
    rate = silent_rate(s, as_vec(s.bias_b))
    turning = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    turn_rad = rotate(as_quat(s.q_nb), rate)[2] * dt
    go_straight_on(s, turn_rad, dt)
    s.silent_turn_rad += turn_rad
    s.heading_rad = wrap_pi(s.heading_rad + turn_rad)
    raise_attitude_variance(s, math.sqrt(silent_variance(s, GAP_TILT_RATE + turning, dt)))
    if is_turn_lost(s, still):
        lose_attitude(s, p)
    refresh(s)


@compiled
def bridge_silence(
    s: ComplementaryState, p: ComplementaryGains, gyro: Vec3, accel: Vec3, dt: float
) -> None:
    """Go on at the sample that ends a silence, `dt` after the last sample or fix."""
    if not is_end_told(s, gyro, accel):
        bridge_gap(s, p, dt)
        return
    q_nb, bias_b = as_quat(s.q_nb), as_vec(s.bias_b)
    mean, std = end_silence(s, q_nb, bias_b, gyro, GAP_TILT_RATE)
    if std > (BROUGHT_BACK_RAD if s.level_by_gps == 1 else GAP_LOST_RAD):
        bridge_gap(s, p, dt)
        if s.lost == 0:
            lose_attitude(s, p)
        return
    go_straight_on(s, rotate(q_nb, silent_rate(s, bias_b))[2] * dt, dt)
    s.heading_rad = wrap_pi(s.heading_rad - s.silent_turn_rad)
    strapdown(s, mean, s.gap_s)
    refresh(s)
    more_sq = max(std * std - s.silent_rad * s.silent_rad, 0.0)
    raise_attitude_variance(s, math.sqrt(more_sq))
    s.silent_rad = s.silent_turn_rad = 0.0
    write_vec(s.gyro_held, gyro)
    write_vec(s.accel_held, accel)
    if s.lost == 0:
        hold_level(s)
        s.force_lp_s = s.gravity_tau_s
        doubt_held_level(s, std * std)


@compiled
def go_straight_on(s: ComplementaryState, turn_rad: float, dt: float) -> None:
    """Let place and velocity go on in a silence; level, pairs and history begin anew."""
    s.sound_s = 0.0
    s.pair_s = NEVER_S
    half = 0.5 * turn_rad
    for k in range(3):
        s.pos_n[k] += s.vel_n[k] * dt
    write_vec(s.vel_n, rotate((math.cos(half), 0.0, 0.0, math.sin(half)), as_vec(s.vel_n)))
    begin_level(s)


@compiled
def take_gps(s: ComplementaryState, p: ComplementaryGains, time_us: int, row: FloatArray) -> None:
    """Take in one fix at its arrival.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    time_us : int
        Arrival on the gateway clock.
    row : ndarray, shape (GPS_COLUMNS,)
        See `columns`.
    """
    if not is_fix_told(s, row):
        return
    s.heading_rad += learn_earth_field(s, row)
    wanted_s = wanted_time_s(s, p, time_us, row)
    silent_s = silence_before(s, wanted_s)
    if silent_s > 0.0:
        bridge_gap(s, p, silent_s)
    valid_s = look_back(s, wanted_s)
    lag = s.time_s - valid_s
    pos, told = place_fix(s, row)
    pos = doubt_height(s, pos)
    vel, at_s = velocity_of_fix(s, valid_s, pos, told)
    align(s, p, at_s, vel, velocity_noise(told))
    look_back(s, wanted_s)
    past = past_state(s, s.then, lag)
    noise_mps = reported_noise(p, row) if is_velocity_told(told) else WAY_NOISE_MPS
    if not is_sound(told, FASTEST_MPS):
        told = velocity_from_position(s, pos, past)
    if not blend_or_restart(s, p, row, pos, told, past, lag):
        return
    settle_place(s, p, row, noise_mps)
    accept_fix(s)
    s.clipped_mps = 0.0
    if is_sound(vel, FASTEST_MPS) and s.lost == 0:
        at_s = look_back(s, at_s)
        interval = take_fix_velocity(s, p, at_s, vel, as_vec(s.then), noise_mps)
        if interval > 0.0 and s.at_rest == 1:
            update_bias_at_rest(s, p, interval)
    refresh(s)


@compiled
def reported_noise(p: ComplementaryGains, row: FloatArray) -> float:
    """Return the noise of a fix's velocity along an axis: as set, or what the receiver tells.

    What is set is the least: a receiver knows its noise, and not by how much it lags in manoeuvres.
    """
    told = SPATIAL_SHARE * row[GPS_SPEED_ACC]
    return float(told if told > p.gps_velocity_noise_mps else p.gps_velocity_noise_mps)


@compiled
def align(
    s: ComplementaryState, p: ComplementaryGains, at_s: float, vel: Vec3, noise_mps: float
) -> None:
    """Give the velocity of a fix to the alignment, and review the attitude by it."""
    if not is_sound(vel, FASTEST_MPS):
        return
    if s.time_s - s.fix_s > DEAD_RECKONING_MAX_S and is_flown_unaided(s, vel):
        doubt_sensors(s, p)
        lose_attitude(s, p)
    dt = pair_with(s, at_s, vel, noise_mps)
    if dt > 0.0:
        review_attitude(s, p, dt)


@compiled
def velocity_from_position(s: ComplementaryState, pos: Vec3, past: tuple[Vec3, Vec3]) -> Vec3:
    """Return a velocity from the position alone, for a receiver that reports none.

    A place that nothing flies to in the time tells no velocity.
    """
    share = 0.0 if s.fix_s == NEVER_S else 0.5 / max(s.time_s - s.fix_s, 0.5)
    (p0, p1, p2), (v0, v1, v2) = past
    way = (share * (pos[0] - p0), share * (pos[1] - p1), share * (pos[2] - p2))
    if math.hypot(way[0], way[1]) > FASTEST_MPS:
        return past[1]
    return (v0 + way[0], v1 + way[1], v2 + way[2])


@compiled
def blend_or_restart(
    s: ComplementaryState,
    p: ComplementaryGains,
    row: FloatArray,
    pos: Vec3,
    vel: Vec3,
    past: tuple[Vec3, Vec3],
    lag: float,
) -> bool:
    """Blend a plausible fix, start anew at the first and after a lasting disagreement."""
    if s.fix_s == NEVER_S or s.lost == 1:
        restart_at(s, pos, vel, lag)
        return True
    off_m = math.hypot(pos[0] - past[0][0], pos[1] - past[0][1])
    off_mps = math.hypot(vel[0] - past[1][0], vel[1] - past[1][1])
    if is_plausible(s, p, row, off_m, off_mps):
        blend_fix(s, p, pos, vel, past, lag)
        return True
    if is_relocked(s, p.gps_relock_s, pos, vel):
        s.fix_valid_s = NEVER_S
        restart_at(s, pos, vel, lag)
        return True
    if s.reject_s > 0.0:
        # They agree with one another: either may be wrong.
        doubt_place(s, off_m)
    return False
