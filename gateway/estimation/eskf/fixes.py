"""GPS fixes as they arrive: recognised, completed, and used to start, restart or update.

A fix is compared with the state at the time it was valid, `L` seconds ago, and its row carries that
state's error to the present one:

    vel_then = vel - att x S + R L accel_bias
    pos_then = pos - L vel + att x (L S - D) - R L^2 / 2 accel_bias

with `S` and `D` the first and second integral of the specific force over the lag. This equals
fusing the fix in time, but for the process noise of the few tenths of a second between.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import (
    GPS_ALT,
    GPS_DECLINATION,
    GPS_DIP,
    GPS_H_ACC,
    GPS_LAT,
    GPS_LON,
    GPS_SPEED_ACC,
    GPS_STRENGTH,
    GPS_USABLE,
    GPS_V_ACC,
    GPS_VEL,
)
from gateway.estimation.eskf.alignment import (
    MAX_PAIR_S,
    MEMORY_S,
    NOISE_MPS,
    PAIR_S,
    TRACK_NOISE_MPS,
    add_velocity,
)
from gateway.estimation.eskf.faults import gap_limit_s
from gateway.estimation.eskf.integrity import check_attitude, lose_attitude
from gateway.estimation.eskf.latency import compare_latencies
from gateway.estimation.eskf.magnetometer import STALE_MAG_S, raise_hard_iron, turn_heading
from gateway.estimation.eskf.predict import look_back, propagate
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    GPS_ERROR,
    GYRO_SCALE,
    NEVER_S,
    POS,
    VEL,
    State,
    reset_state,
    reset_states,
)
from gateway.estimation.eskf.update import (
    clear_row,
    inject,
    innovation_variance,
    restart_baro,
    update_scalar,
)
from gateway.estimation.record import FloatArray, as_quat, as_vec, write_vec
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.geometry.quaternion import body_axes, difference, is_below, norm_sq, scaled
from gateway.records import NAN, Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

FASTEST_MPS: Final = 1000.0
"""A larger velocity is an error."""
BASELINE_S: Final = 2.0 * PAIR_S
"""Positions closer together differ mostly by their noise."""
ZERO_S: Final = 3.0
ZERO_MPS: Final = 2.0
"""Fixes that move so fast for this time contradict a velocity of exactly zero."""
AFTER_GAP_S: Final = 2.0
"""For so long after a gap, corrections of the position are blended in, and fixes, some of which may
have waited, show no latency."""
STATIONARY_MPS: Final = 0.1
"""A receiver at rest reports up to this speed, and may repeat itself."""
SLOWEST_FIXES_S: Final = 1.1
"""Longest usual interval of fixes; a fix without velocity may repeat after that."""
MOVING_MPS: Final = 3.0
"""A level that was found by gravity is discarded at this speed."""
ORIGIN_RENEWAL_M: Final = 5_000.0
"""The origin follows the aircraft, because metres are taken at the radii of the origin."""
AGREE_M: Final = 10.0
"""Rejected fixes within this distance of their own dead reckoning agree."""
AGREE_S: Final = 5.0
"""Rejected fixes further apart in time do not."""
FIRST_VELOCITY_VAR: Final = 0.5**2
NO_VELOCITY_VAR: Final = 5.0**2
"""Of the first velocity with and without one in the fix, m2/s2."""
NOISE_SHARE: Final = 0.2
"""Share of a receiver's accuracy that is noise from fix to fix."""
ERROR_SHARES: Final = (0.7, 0.7, 0.9)
"""Share of it that is slow error, north, east (of a radial accuracy) and down."""
SPEED_SHARES: Final = (0.4, 0.4, 0.8)
"""Share of its speed accuracy that is noise of one axis."""
SLOW_ERROR_MPS: Final = 0.05
SLOW_ERROR_S: Final = 4.0
"""Slow error of GPS velocities where the receiver reports none, and its correlation time."""
LEAST_FIX_INTERVAL_S: Final = 0.05
"""Fixes closer together count as that far apart."""
LEAST_LAG_S: Final = 0.1
"""Over less, a mean acceleration is mostly vibration."""
GLITCH_GATE_SQ: Final = (9.0, 16.0)
MAX_GLITCH: Final = (5.0, 30.0)
"""Gates of velocity and position beyond which an innovation is a glitch, and its largest size."""
GLITCH_S: Final = 10.0
"""Fixes of this time share a glitch."""
GLITCH_FADE_S: Final = 1.0
RECEIVER_LAG_S: Final = 0.2
"""Lag of the receiver's own filter in a manoeuvre."""


@compiled
def update_gps(s: State, p: Gains, arrival_us: int, row: FloatArray) -> None:
    """Use one fix at its arrival; see `columns` for its row."""
    if s.started == 0 or not is_new_fix(s, row):
        return
    learn_declination(s, row)
    set_error_variances(s, p, row)
    arrival_s = (arrival_us - s.base_us) * 1e-6
    reported = as_vec(row[GPS_VEL : GPS_VEL + 3])
    if is_below(reported, FASTEST_MPS) and s.sound_s > AFTER_GAP_S:
        compare_latencies(s, p.gps_latency_s, arrival_s, reported)
    wanted_s = arrival_s - s.gps_latency_s
    pos = position_of(s, row)
    if is_zero_velocity_wrong(s, pos, reported):
        reported = (NAN, NAN, NAN)
    vel, vel_s = complete_velocity(s, wanted_s, pos, reported)
    sound = is_below(vel, FASTEST_MPS)
    if sound:
        write_vec(s.fix_vel, vel)
    if arrival_s - s.imu_s > gap_limit_s(s):
        # Without an IMU the state is that of the fix.
        if s.aided == 1:
            restart_at(s, p, pos, vel, arrival_s - wanted_s)
            s.fix_s = arrival_s
        return
    if sound:
        noise_mps = NOISE_MPS if is_level_sound(reported) else TRACK_NOISE_MPS
        pair_velocity(s, p, vel_s, vel, noise_mps)
    valid_s = look_back(s, wanted_s)
    if sound:
        # Integrals that do not reach back: the fix moves on by its own velocity.
        since_s = valid_s - wanted_s
        pos = (pos[0] + vel[0] * since_s, pos[1] + vel[1] * since_s, pos[2] + vel[2] * since_s)
    north, east = s.pos_n[0] + s.blend_n[0], s.pos_n[1] + s.blend_n[1]
    use_fix(s, p, row, pos, vel, reported, s.time_s - valid_s)
    if s.was_aided == 1 and s.sound_s < AFTER_GAP_S:
        s.blend_n[0], s.blend_n[1] = north - s.pos_n[0], east - s.pos_n[1]


@compiled
def use_fix(
    s: State, p: Gains, row: FloatArray, pos: Vec3, vel: Vec3, reported: Vec3, lag: float
) -> None:
    """Follow, restart at or fuse a fix that is `lag` seconds old."""
    if s.heading_known == 0:
        follow_fix(s, pos, lag)
    elif s.aided == 0:
        restart_at(s, p, pos, vel, lag)
        accept_fix(s)
    else:
        fuse_fix(s, p, row, pos, reported, lag)


@compiled
def is_new_fix(s: State, row: FloatArray) -> bool:
    """Return whether a row is a usable fix that does not repeat the last one.

    A log may hold a fix until the next one, and a receiver may be stuck. A moving receiver is never
    at the same position twice; at rest a repetition may be real.
    """
    lat, lon, vel = row[GPS_LAT], row[GPS_LON], as_vec(row[GPS_VEL : GPS_VEL + 3])
    if row[GPS_USABLE] == 0.0 or not math.isfinite(lat + lon):
        return False
    last, has_velocity = s.fix_last, is_below(vel, FASTEST_MPS)
    repeated = lat == last[0] and lon == last[1]
    if has_velocity:
        repeated = repeated and norm_sq(difference(vel, as_vec(last[2:5]))) == 0.0
    if not repeated:
        last[0], last[1], last[5] = lat, lon, s.time_s
        write_vec(last[2:5], vel)
        return True
    if has_velocity:
        return math.sqrt(norm_sq(vel)) <= STATIONARY_MPS
    return bool(s.time_s - last[5] >= SLOWEST_FIXES_S)


@compiled
def learn_declination(s: State, row: FloatArray) -> None:
    """Take the Earth's field at a fix; a magnetic heading becomes a true one."""
    if math.isfinite(row[GPS_DIP] + row[GPS_STRENGTH]):
        s.earth_field[1], s.earth_field[2] = row[GPS_DIP], row[GPS_STRENGTH]
    if not math.isfinite(row[GPS_DECLINATION]):
        return
    s.earth_field[0] = row[GPS_DECLINATION]
    if s.heading_known == 1 and s.heading_true == 0:
        s.heading_true = 1
        turn_heading(s, s.earth_field[0])


@compiled
def position_of(s: State, row: FloatArray) -> Vec3:
    """Return a fix in metres from the origin, which the first one sets, down positive."""
    if s.has_origin == 0:
        s.origin[0], s.origin[1], s.has_origin = row[GPS_LAT], row[GPS_LON], 1
    elif math.hypot(s.pos_n[0], s.pos_n[1]) > ORIGIN_RENEWAL_M:
        lat, lon = offset_deg(s.origin[0], s.origin[1], 0.0, s.pos_n[0], s.pos_n[1])
        north, east = displacement_m(s.origin[0], s.origin[1], lat, lon, 0.0)
        for from_pos in (s.track_from, s.zero_from):
            from_pos[1] -= north
            from_pos[2] -= east
        s.pos_n[0] -= north
        s.pos_n[1] -= east
        s.origin[0], s.origin[1] = lat, lon
    north, east = displacement_m(s.origin[0], s.origin[1], row[GPS_LAT], row[GPS_LON], 0.0)
    return (north, east, -row[GPS_ALT])


@compiled
def is_level_sound(vel: Vec3) -> bool:
    """Return whether a velocity has sound horizontal components."""
    return is_below((vel[0], vel[1], 0.0), FASTEST_MPS)


@compiled
def is_zero_velocity_wrong(s: State, pos: Vec3, vel: Vec3) -> bool:
    """Return whether the positions contradict a velocity of exactly zero."""
    if vel[0] != 0.0 or vel[1] != 0.0 or vel[2] != 0.0:
        s.zero_from[0], s.zero_velocity_wrong = NEVER_S, 0
        return False
    dt = s.time_s - s.zero_from[0]
    if not 0.0 <= dt < ZERO_S:
        if s.zero_from[0] != NEVER_S:
            way_m = math.hypot(pos[0] - s.zero_from[1], pos[1] - s.zero_from[2])
            s.zero_velocity_wrong = 1 if way_m > ZERO_MPS * dt else 0
        s.zero_from[0] = s.time_s
        write_vec(s.zero_from[1:4], pos)
    return s.zero_velocity_wrong == 1


@compiled
def complete_velocity(s: State, valid_s: float, pos: Vec3, vel: Vec3) -> tuple[Vec3, float]:
    """Return the velocity of a fix, from two positions where it has none, and its time.

    Without heights it does not climb; unknown components are NaN.
    """
    f = s.track_from
    dt = valid_s - f[0]
    if is_below(vel, FASTEST_MPS) or not 0.0 <= dt < BASELINE_S:
        f[0] = valid_s
        track = ((pos[0] - f[1]) / dt, (pos[1] - f[2]) / dt, (pos[2] - f[3]) / dt)
        write_vec(f[1:4], pos)
        if is_below(vel, FASTEST_MPS):
            return vel, valid_s
        known = 0.0 <= dt <= MAX_PAIR_S
        climb = track[2] if known and math.isfinite(track[2]) else 0.0
        if is_level_sound(vel):
            return (vel[0], vel[1], climb), valid_s
        if known and is_level_sound(track):
            return (track[0], track[1], climb), valid_s - 0.5 * dt
    elif is_level_sound(vel):
        return (vel[0], vel[1], 0.0), valid_s
    return (NAN, NAN, NAN), valid_s


@compiled
def pair_velocity(s: State, p: Gains, vel_s: float, vel: Vec3, noise_mps: float) -> None:
    """Add the velocity of a fix to the alignment, and check the attitude by it."""
    unaided = s.aided == 0 and s.pairs == 0.0
    if unaided and s.lost == 0 and math.hypot(vel[0], vel[1]) > MOVING_MPS:
        # The level was found by gravity alone while turns and accelerations imitated it.
        lose_attitude(s, p)
    at_s = look_back(s, vel_s)
    dt = add_velocity(s, p, at_s, vel, as_vec(s.then), noise_mps)
    if dt > 0.0:
        check_attitude(s, p, dt, s.sound_s >= MEMORY_S)


@compiled
def accept_fix(s: State) -> None:
    """Record that a fix was used."""
    s.fix_s = s.time_s
    s.reject_s, s.reject_last[0] = 0.0, NEVER_S


@compiled
def fuse_fix(s: State, p: Gains, row: FloatArray, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Update by a fix; one that is far off is rejected, unless such fixes have long agreed."""
    propagate(s, p)
    start_height(s, p, pos[2] + s.vel_n[2] * lag)
    past_pos, past_vel = past_state(s, lag)
    off_pos = difference(difference(pos, past_pos), as_vec(s.gps_error_n))
    off_vel = difference(vel, past_vel)
    far = math.hypot(off_pos[0], off_pos[1]) >= p.gate_m and is_unlikely(s, p, row, off_pos, lag)
    if far and have_agreed(s, p, pos, vel):
        restart_at(s, p, pos, as_vec(s.fix_vel), lag)
        accept_fix(s)
        return
    update_fix(s, p, row, off_pos, off_vel, lag)
    if not far:
        accept_fix(s)


@compiled
def have_agreed(s: State, p: Gains, pos: Vec3, vel: Vec3) -> bool:
    """Return whether rejected fixes have agreed with one another for the relocking time."""
    last = s.reject_last
    dt = s.time_s - last[0]
    off_m = math.hypot(pos[0] - last[1] - vel[0] * dt, pos[1] - last[2] - vel[1] * dt)
    s.reject_s = s.reject_s + dt if dt < AGREE_S and off_m < AGREE_M else 0.0
    last[0], last[1], last[2] = s.time_s, pos[0], pos[1]
    return bool(s.reject_s > p.gps_relock_s)


@compiled
def follow_fix(s: State, pos: Vec3, lag: float) -> None:
    """Set the position to a fix, moved on by its velocity, while no heading allows fusing it."""
    s.fix_s = s.time_s
    for k in range(3):
        moved = s.fix_vel[k] * lag
        if k < 2 or (s.baro_s == NEVER_S and math.isfinite(pos[2])):
            s.pos_n[k] = pos[k] + (moved if math.isfinite(moved) else 0.0)


@compiled
def restart_at(s: State, p: Gains, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Take position and velocity from one fix, `lag` seconds old; NaN where it has none."""
    propagate(s, p)
    sound = is_below(vel, FASTEST_MPS)
    reset_states(s, VEL, FIRST_VELOCITY_VAR if sound else NO_VELOCITY_VAR)
    write_vec(s.vel_n, vel if sound else (0.0, 0.0, 0.0))
    for k in range(2):
        start_position(s, k, pos[k] + s.vel_n[k] * lag, p.gps_position_var)
    start_height(s, p, pos[2] + s.vel_n[2] * lag)
    s.aided = 1
    if s.was_aided == 0:
        s.was_aided = 1
        reset_states(s, GYRO_SCALE, p.gyro_scale_var)
        raise_hard_iron(s)


@compiled
def start_height(s: State, p: Gains, down_m: float) -> None:
    """Take the height from the first fix that has one."""
    if s.has_height == 1 or not math.isfinite(down_m):
        return
    start_position(s, 2, down_m, p.gps_height_var)
    s.has_height = 1
    if s.baro_s != NEVER_S:
        restart_baro(s, p)


@compiled
def start_position(s: State, k: int, value: float, noise_var: float) -> None:
    """Start one coordinate at a fix, whose slow error it then has, with the opposite sign."""
    error_var = s.gps_error_var[k]
    s.pos_n[k], s.gps_error_n[k] = value, 0.0
    reset_state(s, POS + k, error_var + noise_var)
    reset_state(s, GPS_ERROR + k, error_var)
    s.P[POS + k, GPS_ERROR + k] = s.P[GPS_ERROR + k, POS + k] = -error_var


@compiled
def past_state(s: State, lag: float) -> tuple[Vec3, Vec3]:
    """Return position and velocity `lag` seconds ago, from the present ones and `then`."""
    now, then = s.integrals, s.then
    vel = difference(as_vec(s.vel_n), difference(as_vec(now[3:6]), as_vec(then[3:6])))
    pos = (
        s.pos_n[0] - vel[0] * lag - (now[6] - then[6] - then[3] * lag),
        s.pos_n[1] - vel[1] * lag - (now[7] - then[7] - then[4] * lag),
        s.pos_n[2] - vel[2] * lag - (now[8] - then[8] - then[5] * lag),
    )
    return pos, vel


@compiled
def lag_integrals(s: State, lag: float) -> tuple[Vec3, Vec3]:
    """Return `S` and `D`: the specific force in NED integrated once and twice over the lag."""
    now, then, g = s.integrals, s.then, STANDARD_GRAVITY_MPS2
    once = (now[3] - then[3], now[4] - then[4], now[5] - then[5] - g * lag)
    twice = (
        now[6] - then[6] - then[3] * lag,
        now[7] - then[7] - then[4] * lag,
        now[8] - then[8] - then[5] * lag - 0.5 * g * lag * lag,
    )
    return once, twice


@compiled
def set_error_variances(s: State, p: Gains, row: FloatArray) -> None:
    """Take the slow errors of a fix from the accuracies that the receiver reports."""
    for k in range(3):
        usual = p.gps_error_var if k < 2 else p.gps_height_error_var
        accuracy = row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC]
        s.gps_error_var[k] = reported_variance(usual, accuracy, ERROR_SHARES[k])
        usual = SLOW_ERROR_MPS * SLOW_ERROR_MPS
        slow = reported_variance(usual, row[GPS_SPEED_ACC], SPEED_SHARES[k])
        s.pos_density[k] = 2.0 * SLOW_ERROR_S * slow


@compiled
def reported_variance(variance: float, accuracy: float, share: float) -> float:
    """Return the variance by a reported accuracy, or the usual one where there is none."""
    return (share * accuracy) ** 2 if accuracy > 0.0 else variance


@compiled
def position_variance(s: State, p: Gains, row: FloatArray, k: int, since_s: float) -> float:
    """Return the noise of one coordinate of a fix, m2; its latency varies."""
    usual = p.gps_position_var if k < 2 else p.gps_height_var
    accuracy = row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC]
    white = reported_variance(usual, accuracy, NOISE_SHARE)
    late = p.gps_jitter_sq * s.vel_n[k] * s.vel_n[k]
    return float((white + late) * max(1.0, p.gps_correlation_s / since_s))


@compiled
def velocity_variance(
    s: State, p: Gains, row: FloatArray, accel_n: Vec3, k: int, since_s: float
) -> float:
    """Return the white noise with the long-term effect of one velocity's errors, m2/s2."""
    accuracy = row[GPS_SPEED_ACC]
    usual = p.gps_velocity_var if k < 2 else p.gps_climb_var
    white = reported_variance(usual, accuracy, SPEED_SHARES[k])
    assumed = NOISE_MPS * NOISE_MPS
    if k < 2 and s.time_s - s.mag_used_s > STALE_MAG_S:
        # Without a compass the heading depends on these velocities alone.
        white = max(white, assumed * s.fix_excess)
    white *= max(1.0, p.gps_correlation_s / since_s)
    late = p.gps_jitter_sq * accel_n[k] * accel_n[k]
    level_sq = accel_n[0] * accel_n[0] + accel_n[1] * accel_n[1]
    excess = (s.fix_excess - 1.0) * (assumed + p.gps_jitter_sq * level_sq)
    return max(white + late, excess)


@compiled
def mean_acceleration(s: State, lag: float) -> Vec3:
    """Return the mean acceleration over the lag, m/s2; `then` is overwritten."""
    span = s.time_s - look_back(s, s.time_s - max(lag, LEAST_LAG_S))
    if span <= 0.0:
        return (0.0, 0.0, 0.0)
    gained = difference(as_vec(s.integrals[3:6]), as_vec(s.then[3:6]))
    return (gained[0] / span, gained[1] / span, gained[2] / span)


@compiled
def velocity_row(s: State, k: int, once: Vec3, lag: float) -> None:
    """Write the row of one component of a late velocity."""
    clear_row(s)
    set_attitude(s, k, scaled(once, -1.0))
    s.h[VEL + k] = 1.0
    set_accel_bias(s, k, lag)


@compiled
def position_row(s: State, k: int, once: Vec3, twice: Vec3, lag: float) -> None:
    """Write the row of one component of a late position, which has the slow GPS error."""
    clear_row(s)
    set_attitude(s, k, difference(scaled(once, lag), twice))
    s.h[VEL + k] = -lag
    s.h[POS + k] = 1.0
    s.h[GPS_ERROR + k] = 1.0
    set_accel_bias(s, k, -0.5 * lag * lag)


@compiled
def set_attitude(s: State, k: int, w: Vec3) -> None:
    """Write how `(att x w)[k]` depends on the attitude error."""
    a, b = (k + 1) % 3, (k + 2) % 3
    s.h[ATT + a] = w[b]
    s.h[ATT + b] = -w[a]


@compiled
def set_accel_bias(s: State, k: int, share: float) -> None:
    """Write `share` times row `k` of `R_nb` for the accelerometer bias."""
    x, y, z = body_axes(as_quat(s.q_nb))
    s.h[ACCEL_BIAS] = share * x[k]
    s.h[ACCEL_BIAS + 1] = share * y[k]
    s.h[ACCEL_BIAS + 2] = share * z[k]


@compiled
def is_unlikely(s: State, p: Gains, row: FloatArray, off: Vec3, lag: float) -> bool:
    """Return whether a position is outside the gate, north or east."""
    once, twice = lag_integrals(s, lag)
    worst = 0.0
    for k in range(2):
        position_row(s, k, once, twice, lag)
        total = innovation_variance(s, position_variance(s, p, row, k, p.gps_correlation_s))
        worst = max(worst, off[k] * off[k] / total)
    return worst > p.gate_sq


@compiled
def raise_glitch_variance(s: State, k: int, off: float, variance: float, since_s: float) -> None:
    """Add the variance of a glitch: an innovation outside the gate is shared by several fixes.

    `k` is 0 for velocities and 1 for positions. Taken for errors that are new in each fix, a glitch
    would win over sound inertial sensors. The variance that errs as much in the long run is that of
    one error times the number of fixes that share it.
    """
    off = min(abs(off), MAX_GLITCH[k])
    excess = off * off / GLITCH_GATE_SQ[k] - innovation_variance(s, variance)
    s.glitch[k] = max(s.glitch[k], excess * max(1.0, GLITCH_S / since_s))


@compiled
def update_fix(
    s: State, p: Gains, row: FloatArray, off_pos: Vec3, off_vel: Vec3, lag: float
) -> None:
    """Update by velocity and position of a fix; components that are not finite are left out."""
    once, twice = lag_integrals(s, lag)
    since_s = max(s.time_s - s.update_s, LEAST_FIX_INTERVAL_S)
    s.update_s = s.time_s
    accel_n = mean_acceleration(s, lag)
    faded = math.exp(-since_s / GLITCH_FADE_S)
    s.glitch[0] *= faded
    s.glitch[1] *= faded
    s.glitch[2] = max(norm_sq(accel_n), s.glitch[2] * faded)
    late_var = RECEIVER_LAG_S * RECEIVER_LAG_S * s.glitch[2]
    # The whole fix is checked before any of it is used: a glitch affects all components.
    for k in range(3):
        if math.isfinite(off_vel[k]):
            velocity_row(s, k, once, lag)
            variance = velocity_variance(s, p, row, accel_n, k, since_s)
            raise_glitch_variance(s, 0, off_vel[k], variance + late_var, since_s)
        if math.isfinite(off_pos[k]):
            position_row(s, k, once, twice, lag)
            variance = position_variance(s, p, row, k, since_s)
            raise_glitch_variance(s, 1, off_pos[k], variance, since_s)
    for k in range(3):
        if math.isfinite(off_vel[k]):
            velocity_row(s, k, once, lag)
            variance = velocity_variance(s, p, row, accel_n, k, since_s)
            update_scalar(s, off_vel[k], variance + s.glitch[0], GLITCH_GATE_SQ[0])
        if math.isfinite(off_pos[k]):
            position_row(s, k, once, twice, lag)
            variance = position_variance(s, p, row, k, since_s) + s.glitch[1]
            update_scalar(s, off_pos[k], variance, p.gate_sq)
    inject(s)
