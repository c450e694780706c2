"""Processing of GPS fixes: checked, completed, and used to start, restart or update."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation import columns as col
from gateway.estimation.eskf import alignment, fix_model
from gateway.estimation.eskf.faults import gap_limit_s
from gateway.estimation.eskf.integrity import check_attitude, lose_attitude
from gateway.estimation.eskf.latency import compare_latencies
from gateway.estimation.eskf.magnetometer import raise_hard_iron, turn_heading
from gateway.estimation.eskf.predict import look_back, propagate
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    GPS_ERROR,
    GYRO_SCALE,
    NEVER_S,
    POS,
    VEL,
    State,
    reset_state,
    reset_states,
)
from gateway.estimation.eskf.update import inject, restart_baro, update_scalar
from gateway.estimation.record import FloatArray, as_vec, write_vec
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.geometry.quaternion import difference, is_below, norm_sq
from gateway.records import NAN, Vec3

FASTEST_MPS: Final = 1000.0
"""Velocity above which it is an error."""
BASELINE_S: Final = 2.0 * alignment.PAIR_S
"""Least interval of positions for a velocity: closer ones differ mostly by noise."""
ZERO_S: Final = 3.0
ZERO_MPS: Final = 2.0
"""Speed and time of moving fixes that contradict a velocity of exactly zero."""
AFTER_GAP_S: Final = 2.0
"""Time after a gap in which position corrections are blended in and latency is not estimated."""
STATIONARY_MPS: Final = 0.1
"""Maximum reported speed of a receiver at rest, which may repeat a fix."""
SLOWEST_FIXES_S: Final = 1.1
"""Longest usual interval of fixes, after which a fix without velocity may be repeated."""
MOVING_MPS: Final = 3.0
"""Speed at which a level found by gravity is discarded."""
ORIGIN_RENEWAL_M: Final = 5_000.0
"""Distance after which the origin is moved, because metres are computed with its radii."""
AGREE_M: Final = 10.0
"""Maximum distance of rejected fixes that agree from their own dead reckoning."""
AGREE_S: Final = 5.0
"""Maximum interval of rejected fixes that agree."""
FIRST_VELOCITY_VAR: Final = 0.5**2
NO_VELOCITY_VAR: Final = 5.0**2
"""Variances of the first velocity with and without one in the fix, m2/s2."""


@compiled
def update_gps(s: State, p: Gains, arrival_us: int, row: FloatArray) -> None:
    """Use one fix at its arrival; see `columns` for its row."""
    if s.started == 0 or not is_new_fix(s, row):
        return
    learn_declination(s, row)
    fix_model.set_error_variances(s, p, row)
    arrival_s = (arrival_us - s.base_us) * 1e-6
    reported = as_vec(row[col.GPS_VEL : col.GPS_VEL + 3])
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
        # Without an IMU, the state is that of the fix.
        if s.aided == 1:
            s.aided = s.has_height = 0
            restart_at(s, p, pos, vel, arrival_s - wanted_s)
            s.fix_s = arrival_s
        return
    if sound:
        noise_mps = alignment.NOISE_MPS if is_level_sound(reported) else alignment.TRACK_NOISE_MPS
        pair_velocity(s, p, vel_s, vel, noise_mps)
    valid_s = look_back(s, wanted_s)
    if sound:
        # The integrals do not reach back far enough: extrapolate the fix by its own velocity.
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
    """Copy, restart at or fuse a fix that is `lag` seconds old."""
    if s.heading_known == 0:
        follow_fix(s, p, row, pos, lag)
    elif s.aided == 0:
        restart_at(s, p, pos, vel, lag)
        accept_fix(s)
    else:
        fuse_fix(s, p, row, pos, reported, lag)


@compiled
def is_new_fix(s: State, row: FloatArray) -> bool:
    """Return whether a row is a usable fix that does not repeat the last one.

    A log may repeat a fix until the next one, and a receiver may be stuck. A moving receiver never
    reports the same position twice; at rest a repetition may be real.
    """
    lat, lon, vel = row[col.GPS_LAT], row[col.GPS_LON], as_vec(row[col.GPS_VEL : col.GPS_VEL + 3])
    if row[col.GPS_USABLE] == 0.0 or not math.isfinite(lat + lon):
        return False
    has_velocity = is_below(vel, FASTEST_MPS)
    repeated = lat == s.newest_lat_deg and lon == s.newest_lon_deg
    if has_velocity:
        repeated = repeated and norm_sq(difference(vel, as_vec(s.newest_vel))) == 0.0
    if not repeated:
        s.newest_lat_deg, s.newest_lon_deg, s.newest_s = lat, lon, s.time_s
        write_vec(s.newest_vel, vel)
        return True
    if has_velocity:
        return math.sqrt(norm_sq(vel)) <= STATIONARY_MPS
    return bool(s.time_s - s.newest_s >= SLOWEST_FIXES_S)


@compiled
def learn_declination(s: State, row: FloatArray) -> None:
    """Set the Earth's field at a fix, and convert a magnetic heading to a true one."""
    if math.isfinite(row[col.GPS_DIP] + row[col.GPS_STRENGTH]):
        s.earth_dip_rad, s.earth_norm_ut = row[col.GPS_DIP], row[col.GPS_STRENGTH]
    if not math.isfinite(row[col.GPS_DECLINATION]):
        return
    s.declination_rad = row[col.GPS_DECLINATION]
    if s.heading_known == 1 and s.heading_true == 0:
        s.heading_true = 1
        turn_heading(s, s.declination_rad)


@compiled
def position_of(s: State, row: FloatArray) -> Vec3:
    """Return a fix in metres from the origin, down positive; the first fix sets the origin."""
    if s.has_origin == 0:
        s.origin[0], s.origin[1], s.has_origin = row[col.GPS_LAT], row[col.GPS_LON], 1
    elif math.hypot(s.pos_n[0], s.pos_n[1]) > ORIGIN_RENEWAL_M:
        lat, lon = offset_deg(s.origin[0], s.origin[1], 0.0, s.pos_n[0], s.pos_n[1])
        north, east = displacement_m(s.origin[0], s.origin[1], lat, lon, 0.0)
        for from_n in (s.track_pos_n, s.zero_pos_n):
            from_n[0] -= north
            from_n[1] -= east
        s.pos_n[0] -= north
        s.pos_n[1] -= east
        s.origin[0], s.origin[1] = lat, lon
    north, east = displacement_m(s.origin[0], s.origin[1], row[col.GPS_LAT], row[col.GPS_LON], 0.0)
    return (north, east, -row[col.GPS_ALT])


@compiled
def is_level_sound(vel: Vec3) -> bool:
    """Return whether the horizontal components of a velocity are valid."""
    return is_below((vel[0], vel[1], 0.0), FASTEST_MPS)


@compiled
def is_zero_velocity_wrong(s: State, pos: Vec3, vel: Vec3) -> bool:
    """Return whether the positions contradict a velocity of exactly zero."""
    if vel[0] != 0.0 or vel[1] != 0.0 or vel[2] != 0.0:
        s.zero_s, s.zero_velocity_wrong = NEVER_S, 0
        return False
    dt = s.time_s - s.zero_s
    if not 0.0 <= dt < ZERO_S:
        if s.zero_s != NEVER_S:
            way_m = math.hypot(pos[0] - s.zero_pos_n[0], pos[1] - s.zero_pos_n[1])
            s.zero_velocity_wrong = 1 if way_m > ZERO_MPS * dt else 0
        s.zero_s = s.time_s
        write_vec(s.zero_pos_n, pos)
    return s.zero_velocity_wrong == 1


@compiled
def complete_velocity(s: State, valid_s: float, pos: Vec3, vel: Vec3) -> tuple[Vec3, float]:
    """Return the velocity of a fix and its time; from two positions if the fix has no velocity.

    Without heights the climb is zero; unknown components are NaN.
    """
    f = s.track_pos_n
    dt = valid_s - s.track_s
    if is_below(vel, FASTEST_MPS) or not 0.0 <= dt < BASELINE_S:
        s.track_s = valid_s
        track = ((pos[0] - f[0]) / dt, (pos[1] - f[1]) / dt, (pos[2] - f[2]) / dt)
        write_vec(f, pos)
        if is_below(vel, FASTEST_MPS):
            return vel, valid_s
        known = 0.0 <= dt <= alignment.MAX_PAIR_S
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
    """Add the velocity of a fix to the alignment, and check the attitude with it."""
    unaided = s.aided == 0 and s.pairs == 0.0
    if unaided and s.lost == 0 and math.hypot(vel[0], vel[1]) > MOVING_MPS:
        # The level was found by gravity alone, which turns and accelerations may have distorted.
        lose_attitude(s, p)
    at_s = look_back(s, vel_s)
    dt = alignment.add_velocity(s, p, at_s, vel, as_vec(s.then), noise_mps)
    if dt > 0.0:
        check_attitude(s, p, dt, s.sound_s >= alignment.MEMORY_S)


@compiled
def accept_fix(s: State) -> None:
    """Record that a fix was used."""
    s.fix_s = s.time_s
    s.reject_s, s.rejected_s = 0.0, NEVER_S


@compiled
def fuse_fix(s: State, p: Gains, row: FloatArray, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Update by a fix; an outlier is rejected, unless such fixes have agreed for long."""
    propagate(s, p)
    start_height(s, p, pos[2] + s.vel_n[2] * lag)
    past_pos, past_vel = fix_model.past_state(s, lag)
    off_pos = difference(difference(pos, past_pos), as_vec(s.gps_error_n))
    past_vel = (past_vel[0], past_vel[1], past_vel[2] + s.gps_climb_error_mps)
    off_vel = difference(vel, past_vel)
    far = math.hypot(off_pos[0], off_pos[1]) >= p.gate_m and fix_model.is_unlikely(
        s, p, row, off_pos, lag
    )
    agreed = far and have_agreed(s, p, pos, vel)
    if agreed:
        restart_at(s, p, pos, as_vec(s.fix_vel), lag)
    else:
        fix_model.update_fix(s, p, row, off_pos, off_vel, lag)
    if agreed or not far:
        accept_fix(s)


@compiled
def have_agreed(s: State, p: Gains, pos: Vec3, vel: Vec3) -> bool:
    """Return whether rejected fixes have agreed with one another for the relocking time."""
    last = s.rejected_pos_n
    dt = s.time_s - s.rejected_s
    off_m = math.hypot(pos[0] - last[0] - vel[0] * dt, pos[1] - last[1] - vel[1] * dt)
    s.reject_s = s.reject_s + dt if dt < AGREE_S and off_m < AGREE_M else 0.0
    s.rejected_s, last[0], last[1] = s.time_s, pos[0], pos[1]
    return bool(s.reject_s > p.gps_relock_s)


@compiled
def follow_fix(s: State, p: Gains, row: FloatArray, pos: Vec3, lag: float) -> None:
    """Set the position to an extrapolated fix, which cannot be fused without a heading.

    Its height moves the height and the offset of the barometer as one of many.
    """
    since_s = max(s.time_s - s.fix_s, fix_model.LEAST_FIX_INTERVAL_S)
    s.fix_s = s.time_s
    for k in range(2):
        s.pos_n[k] = pos[k] + (s.fix_vel[k] * lag if math.isfinite(s.fix_vel[k]) else 0.0)
    down_m = pos[2] + (s.fix_vel[2] * lag if math.isfinite(s.fix_vel[2]) else 0.0)
    if s.has_height == 0:
        start_height(s, p, down_m)
    elif math.isfinite(down_m):
        propagate(s, p)
        fix_model.position_row(s, 2, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
        off_m = down_m - s.pos_n[2] - s.gps_error_n[2]
        update_scalar(s, off_m, fix_model.position_variance(s, p, row, 2, since_s), p.gate_sigma_sq)
        inject(s)


@compiled
def restart_at(s: State, p: Gains, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Set position and velocity from one fix, `lag` seconds old; NaN for missing components.

    A climb that is estimated already is kept.
    """
    propagate(s, p)
    sound = is_below(vel, FASTEST_MPS)
    for k in range(3 - s.aided):
        reset_state(s, VEL + k, FIRST_VELOCITY_VAR if sound else NO_VELOCITY_VAR)
        s.vel_n[k] = vel[k] if sound else 0.0
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
    """Set the height from the first fix that has one."""
    if s.has_height == 1 or not math.isfinite(down_m):
        return
    start_position(s, 2, down_m, p.gps_height_var)
    s.has_height = 1
    if s.baro_s != NEVER_S:
        restart_baro(s, p)


@compiled
def start_position(s: State, k: int, value: float, noise_var: float) -> None:
    """Start one coordinate at a fix; its error is the slow error with the opposite sign."""
    error_var = s.gps_error_var[k]
    s.pos_n[k], s.gps_error_n[k] = value, 0.0
    reset_state(s, POS + k, error_var + noise_var)
    reset_state(s, GPS_ERROR + k, error_var)
    s.P[POS + k, GPS_ERROR + k] = s.P[GPS_ERROR + k, POS + k] = -error_var
