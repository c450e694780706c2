"""GPS fixes: the first heading, starts and restarts, and the update by a late fix."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment import collect_match
from gateway.estimation.columns import GPS_DECLINATION, GPS_LAT, GPS_LON, GPS_USABLE
from gateway.estimation.eskf.covariance import propagate
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import EskfState
from gateway.estimation.eskf.measure import (
    lag_integrals,
    place_distance_sq,
    set_wander_variance,
    update_by_fix,
)
from gateway.estimation.eskf.start import (
    relock_at,
    restart_at,
    start_heading_by_match,
    turn_heading,
)
from gateway.estimation.history import recall
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.estimation.local_position import (
    NEVER_S,
    fix_position,
    fix_velocity,
    is_relocked,
    move_origin,
    past_state,
)
from gateway.estimation.sensor_faults import is_sound
from gateway.records import Vec3

MIN_BASELINE_S: Final = 0.15
MAX_BASELINE_S: Final = 2.5
"""Interval of two fixes whose velocities tell an acceleration."""
STEP_NOISE_MPS: Final = 0.2
"""Noise of the step from one velocity to the next, in which slow errors cancel."""
ZERO: Final = (0.0, 0.0, 0.0)


@compiled
def take_gps(s: EskfState, p: EskfGains, time_us: int, row: FloatArray) -> None:
    """Take in one fix at its arrival.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    time_us : int
        Arrival on the gateway clock.
    row : ndarray, shape (GPS_COLUMNS,)
        See `columns`.
    """
    if s.started == 0 or row[GPS_USABLE] == 0.0:
        return
    learn_declination(s, row[GPS_DECLINATION])
    set_wander_variance(s, p, row)
    then = s.then
    wanted_s = (time_us - s.base_us) * 1e-6 - p.gps_latency_s
    valid_s = recall(s.ring, s.ring_count, wanted_s, s.time_s, s.integrals, then)
    lag = s.time_s - valid_s
    move_origin(s, row[GPS_LAT], row[GPS_LON])
    pos, vel = fix_position(s, row), fix_velocity(row)
    told_velocity = is_sound(vel, 1000.0)
    if s.heading_known == 0:
        if told_velocity:
            match_heading(s, valid_s, vel, (then[3], then[4], then[5]))
        if s.heading_known == 0:
            follow_fix(s, pos, vel)
            return
    if s.aided == 0:
        restart_at(s, p, pos, vel if told_velocity else ZERO, lag)
        accept(s, vel)
        return
    fuse_fix(s, p, row, pos, vel, lag)


@compiled
def fuse_fix(s: EskfState, p: EskfGains, row: FloatArray, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Update by a fix that lies near, reject one that does not, relock on those that insist."""
    propagate(s, p)
    past_pos, past_vel = past_state(s, s.then, lag)
    once, twice = lag_integrals(s, s.then, lag)
    w = s.wander_n
    off_pos = (
        pos[0] - past_pos[0] - w[0],
        pos[1] - past_pos[1] - w[1],
        pos[2] - past_pos[2] - w[2],
    )
    off_vel = (vel[0] - past_vel[0], vel[1] - past_vel[1], vel[2] - past_vel[2])
    unlikely = place_distance_sq(s, p, row, off_pos, once, twice, lag) > p.gate_sq
    off_m = math.hypot(off_pos[0], off_pos[1])
    note_contradiction(s, off_m if unlikely else 0.0)
    if not unlikely or off_m < p.gate_m:
        update_by_fix(s, p, row, off_pos, off_vel, once, twice, lag)
        accept(s, vel)
    elif is_relocked(s, p.gps_relock_s, pos, vel):
        relock_at(s, p, pos, vel if is_sound(vel, 1000.0) else ZERO, lag)
        accept(s, vel)


@compiled
def note_contradiction(s: EskfState, off_m: float) -> None:
    """Note how far off the fixes are: two in a row, for one alone may be nonsense."""
    s.contradiction_m = min(off_m, s.off_last_m)
    s.off_last_m = off_m


@compiled
def accept(s: EskfState, vel: Vec3) -> None:
    """Note that a fix was used."""
    s.fix_s = s.time_s
    write_vec(s.fix_vel, vel)
    s.reject_s, s.reject_last[0] = 0.0, NEVER_S


@compiled
def follow_fix(s: EskfState, pos: Vec3, vel: Vec3) -> None:
    """Show a fix as it is while it cannot be fused: without a heading."""
    write_vec(s.fix_vel, vel)
    s.fix_s = s.time_s
    s.pos_n[0], s.pos_n[1] = pos[0], pos[1]
    if s.baro_known == 0:
        s.pos_n[2] = pos[2]


@compiled
def match_heading(s: EskfState, valid_s: float, vel: Vec3, integral: Vec3) -> None:
    """Collect the match of GPS and inertial accelerations; it may give the first heading."""
    dt = valid_s - s.fix_valid_s
    if dt < MIN_BASELINE_S:
        return
    old, force = as_vec(s.fix_vel), as_vec(s.fix_force)
    write_vec(s.fix_force, integral)
    s.fix_valid_s = valid_s
    if dt > MAX_BASELINE_S:
        return
    accel = ((vel[0] - old[0]) / dt, (vel[1] - old[1]) / dt, (vel[2] - old[2]) / dt)
    mean = ((integral[0] - force[0]) / dt, (integral[1] - force[1]) / dt, 0.0)
    if collect_match(s, mean, accel, dt, STEP_NOISE_MPS):
        start_heading_by_match(s, math.atan2(s.match[1], s.match[0]), 1.0 / s.match[2])


@compiled
def learn_declination(s: EskfState, declination_rad: float) -> None:
    """Turn a magnetic heading to true north when the declination becomes known."""
    if not math.isfinite(declination_rad):
        return
    if s.heading_known == 1 and s.heading_true == 0:
        turn_heading(s, declination_rad)
        s.heading_true = 1
    s.declination_rad = declination_rad
