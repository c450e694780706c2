"""GPS fixes as they arrive: when they are blended, believed anew, or left out; and silences."""

import math

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_velocity import (
    FASTEST_MPS,
    WAY_NOISE_MPS,
    is_velocity_told,
    velocity_noise,
    velocity_of_fix,
)
from gateway.estimation.alignment.review import GAP_LOST_RAD, GAP_S, GAP_TILT_RATE, MOVING_MPS
from gateway.estimation.alignment.wahba import align_by_velocity
from gateway.estimation.columns import GPS_DECLINATION, GPS_LAT, GPS_LON, GPS_USABLE
from gateway.estimation.complementary.bias import update_bias
from gateway.estimation.complementary.complementary_output import (
    DEAD_RECKONING_MAX_S,
)
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.heading import UNKNOWN_VAR
from gateway.estimation.complementary.manoeuvre import take_fix_velocity
from gateway.estimation.complementary.navigation import (
    blend_fix,
    is_plausible,
    restart_at,
)
from gateway.estimation.complementary.reorientation import (
    begin_level,
    lose_attitude,
    review_attitude,
)
from gateway.estimation.complementary.tilt import refresh
from gateway.estimation.history import recall
from gateway.estimation.kernel_record import (
    FloatArray,
    as_quat,
    as_vec,
    write_vec,
)
from gateway.estimation.local_position import (
    NEVER_S,
    fix_position,
    fix_velocity,
    is_relocked,
    move_origin,
    past_state,
)
from gateway.estimation.sensor_faults import is_sound
from gateway.geometry.quaternion import rotate, wrap_pi
from gateway.records import Vec3


@compiled
def bridge_gap(s: ComplementaryState, dt: float) -> None:
    """Go on after a silence: on in the same turn, level anew from here; lost where it turned."""
    s.fault = 1
    rate = (
        s.gyro_lp[0] - s.bias_b[0],
        s.gyro_lp[1] - s.bias_b[1],
        s.gyro_lp[2] - s.bias_b[2],
    )
    still = s.at_rest == 1
    turning = 0.0 if still else math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    for k in range(3):
        s.pos_n[k] += s.vel_n[k] * dt
    begin_level(s)
    s.pair_s = NEVER_S
    if not still:
        turn_rad = rotate(as_quat(s.q_nb), rate)[2] * dt
        s.heading_rad = wrap_pi(s.heading_rad + turn_rad)
        half = 0.5 * turn_rad
        turn = (math.cos(half), 0.0, 0.0, math.sin(half))
        write_vec(s.vel_n, rotate(turn, as_vec(s.vel_n)))
    turned = (GAP_TILT_RATE + turning) * dt
    s.heading_var = min(s.heading_var + turned * turned, UNKNOWN_VAR)
    if turned > GAP_LOST_RAD and not still:
        lose_attitude(s)
    refresh(s)


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
    if s.started == 0 or row[GPS_USABLE] == 0.0:
        return
    if not (math.isfinite(row[GPS_LAT]) and math.isfinite(row[GPS_LON])):
        return
    learn_declination(s, row[GPS_DECLINATION])
    wanted_s = (time_us - s.base_us) * 1e-6 - p.gps_latency_s
    catch_up(s, wanted_s)
    valid_s = recall(s.ring, s.ring_count, wanted_s, s.time_s, s.integrals, s.then)
    lag = s.time_s - valid_s
    move_origin(s, row[GPS_LAT], row[GPS_LON])
    pos, told = fix_position(s, row), fix_velocity(row)
    vel, at_s = velocity_of_fix(s, valid_s, pos, told)
    align(s, at_s, vel, velocity_noise(told))
    valid_s = recall(s.ring, s.ring_count, wanted_s, s.time_s, s.integrals, s.then)
    past = past_state(s, s.then, lag)
    noise_mps = p.gps_velocity_noise_mps if is_velocity_told(told) else WAY_NOISE_MPS
    if not is_sound(told, FASTEST_MPS):
        told = velocity_from_position(s, pos, past)
    if not accept_fix(s, p, row, pos, told, past, lag):
        return
    s.fix_s = s.time_s
    if is_sound(vel, FASTEST_MPS) and s.lost == 0:
        at_s = recall(s.ring, s.ring_count, at_s, s.time_s, s.integrals, s.then)
        interval = take_fix_velocity(s, p, at_s, vel, as_vec(s.then), noise_mps)
        if interval > 0.0:
            update_bias(s, p, p.tau_accel_gps_s, interval)
    refresh(s)


@compiled
def catch_up(s: ComplementaryState, valid_s: float) -> None:
    """Go on to a fix that was valid long after the newest sample: the IMU is silent."""
    ahead = valid_s - s.time_s
    if ahead > GAP_S:
        s.time_us += int(ahead * 1e6)
        s.time_s = (s.time_us - s.base_us) * 1e-6
        bridge_gap(s, ahead)


@compiled
def align(s: ComplementaryState, at_s: float, vel: Vec3, noise_mps: float) -> None:
    """Give the velocity of a fix to the alignment, and heed what that says."""
    if not is_sound(vel, FASTEST_MPS):
        return
    fast = math.hypot(vel[0], vel[1]) > MOVING_MPS
    if s.by_gps == 0 and fast and s.time_s - s.fix_s > DEAD_RECKONING_MAX_S:
        # What was found without GPS took the pull of every turn for gravity.
        lose_attitude(s)
    at_s = recall(s.ring, s.ring_count, at_s, s.time_s, s.integrals, s.then)
    dt = align_by_velocity(s, at_s, vel, as_vec(s.then), noise_mps)
    if dt > 0.0:
        review_attitude(s, dt)


@compiled
def velocity_from_position(s: ComplementaryState, pos: Vec3, past: tuple[Vec3, Vec3]) -> Vec3:
    """Stand in for a velocity that the receiver does not tell."""
    share = 0.0 if s.fix_s == NEVER_S else 0.5 / max(s.time_s - s.fix_s, 0.5)
    (p0, p1, p2), (v0, v1, v2) = past
    return (
        v0 + share * (pos[0] - p0),
        v1 + share * (pos[1] - p1),
        v2 + share * (pos[2] - p2),
    )


@compiled
def accept_fix(
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
        s.reject_s, s.reject_last[0] = 0.0, NEVER_S
        blend_fix(s, p, pos, vel, past, lag)
        return True
    if is_relocked(s, p.gps_relock_s, pos, vel):
        s.reject_s, s.reject_last[0] = 0.0, NEVER_S
        s.fix_valid_s = NEVER_S
        restart_at(s, pos, vel, lag)
        return True
    return False


@compiled
def learn_declination(s: ComplementaryState, declination_rad: float) -> None:
    """Turn a magnetic heading to true north when the declination becomes known."""
    if not math.isfinite(declination_rad):
        return
    if s.heading_known == 1 and s.heading_true == 0:
        s.heading_rad += declination_rad
        s.heading_true = 1
    s.declination_rad = declination_rad
