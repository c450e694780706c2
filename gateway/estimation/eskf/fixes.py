"""GPS fixes: the first heading, starts and restarts, and the update by a late fix."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_velocity import (
    FASTEST_MPS,
    velocity_noise,
    velocity_of_fix,
)
from gateway.estimation.eskf.covariance import propagate
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import POS, EskfState
from gateway.estimation.eskf.late_fix import (
    lag_integrals,
    place_distance_sq,
    place_variance,
    set_wander_variance,
    update_by_fix,
)
from gateway.estimation.eskf.recovery import lose_attitude, review_attitude, turn_heading
from gateway.estimation.eskf.start import (
    bridge_gap,
    restart_at,
    start_height,
)
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
from gateway.estimation.filtering.sample_clock import silence_before
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.estimation.local_position import BARO_STALE_S, is_relocked, past_state
from gateway.estimation.sensor_faults import is_sound
from gateway.records import Vec3

HELD_S: Final = 60.0
"""A height that barometer and fixes have agreed on is held against fixes for so long at most."""
LONGEST_S: Final = 1.0
"""A fix speaks for no longer than this."""


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
    if not is_fix_told(s, row):
        return
    turn_rad = learn_earth_field(s, row)
    if turn_rad != 0.0:
        turn_heading(s, turn_rad)
    set_wander_variance(s, p, row)
    wanted_s = wanted_time_s(s, p, time_us, row)
    silent_s = silence_before(s, wanted_s)
    if silent_s > 0.0:
        bridge_gap(s, p, silent_s)
    valid_s = look_back(s, wanted_s)
    lag = s.time_s - valid_s
    pos, vel = place_fix(s, row)
    align(s, p, valid_s, pos, vel)
    look_back(s, wanted_s)
    if s.heading_known == 0:
        follow_fix(s, pos, lag)
    elif s.aided == 0:
        restart_at(s, p, pos, as_vec(s.fix_vel), lag)
        accept_fix(s)
    else:
        fuse_fix(s, p, row, pos, vel, lag)


@compiled
def align(s: EskfState, p: EskfGains, valid_s: float, pos: Vec3, told: Vec3) -> None:
    """Give the velocity of a fix to the alignment, and heed what that says."""
    vel, at_s = velocity_of_fix(s, valid_s, pos, told)
    if not is_sound(vel, FASTEST_MPS):
        return
    write_vec(s.fix_vel, vel)
    if s.aided == 0 and is_flown_unaided(s, vel):
        lose_attitude(s, p)
    dt = pair_with(s, at_s, vel, velocity_noise(told))
    if dt > 0.0:
        review_attitude(s, p, dt)


@compiled
def fuse_fix(s: EskfState, p: EskfGains, row: FloatArray, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Update by a fix, hardly by one that does not lie near; relock on those that insist."""
    propagate(s, p)
    start_height(s, p, pos[2] + s.vel_n[2] * lag)
    past_pos, past_vel = past_state(s, s.then, lag)
    once, twice = lag_integrals(s, s.then, lag)
    w = s.wander_n
    off_pos = (
        pos[0] - past_pos[0] - w[0],
        pos[1] - past_pos[1] - w[1],
        pos[2] - past_pos[2] - w[2],
    )
    off_vel = (vel[0] - past_vel[0], vel[1] - past_vel[1], vel[2] - past_vel[2])
    watch_height(s, p, row, off_pos[2])
    unlikely = place_distance_sq(s, p, row, off_pos, once, twice, lag) > p.gate_sq
    off_m = math.hypot(off_pos[0], off_pos[1])
    note_contradiction(s, off_m if unlikely else 0.0)
    far = unlikely and off_m >= p.gate_m
    if far and is_relocked(s, p.gps_relock_s, pos, vel):
        restart_at(s, p, pos, as_vec(s.fix_vel), lag)
        accept_fix(s)
        return
    update_by_fix(s, p, row, off_pos, off_vel, once, twice, lag)
    if not far:
        accept_fix(s)


@compiled
def watch_height(s: EskfState, p: EskfGains, row: FloatArray, off_m: float) -> None:
    """Give a height up that the fixes contradict for long: the next one tells it anew.

    The first heights of a receiver may be hundreds of metres off, and agree with one another. Those
    that leave what barometer and fixes have told together are doubted for as long as they have.
    """
    if not math.isfinite(off_m):
        return
    known = s.P[POS + 2, POS + 2] + s.wander_var[2] + place_variance(p, row, 2)
    near = abs(off_m) < p.gate_m or off_m * off_m < p.gate_sq * known
    dt = min(s.time_s - s.weighed_s, LONGEST_S)
    s.height_off_s = 0.0 if near else s.height_off_s + dt
    if near and s.time_s - s.baro_s < BARO_STALE_S:
        s.height_held_s = min(s.height_held_s + dt, HELD_S)
    if s.height_off_s > max(p.gps_relock_s, s.height_held_s):
        s.has_height, s.doubt_pos_sq, s.height_held_s = 0, 0.0, 0.0


@compiled
def note_contradiction(s: EskfState, off_m: float) -> None:
    """Note how far off the fixes are: two in a row, for one alone may be nonsense."""
    s.contradiction_m = min(off_m, s.off_last_m)
    s.off_last_m = off_m


@compiled
def follow_fix(s: EskfState, pos: Vec3, lag: float) -> None:
    """Show a fix while it cannot be fused, without a heading; its velocity moves it on."""
    s.fix_s = s.time_s
    for k in range(3):
        moved = s.fix_vel[k] * lag
        if k < 2 or (s.baro_known == 0 and math.isfinite(pos[2])):
            s.pos_n[k] = pos[k] + (moved if math.isfinite(moved) else 0.0)
