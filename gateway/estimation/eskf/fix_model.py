"""Measurement model of a GPS fix: its row for the time of validity, its variance, and glitches.

A fix is compared with the state at its time of validity, `L` seconds ago, and its row expresses the
error of that state by the present one:

    vel_then = vel - att x S + R L accel_bias
    pos_then = pos - L vel + att x (L S - D) - R L^2 / 2 accel_bias

with `S` and `D` the first and second integral of the specific force over the lag. This is the same
as fusing the fix on time, except for the process noise during the lag, some tenths of a second.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import GPS_H_ACC, GPS_SPEED_ACC, GPS_V_ACC
from gateway.estimation.eskf import update
from gateway.estimation.eskf.alignment import NOISE_MPS
from gateway.estimation.eskf.magnetometer import STALE_MAG_S
from gateway.estimation.eskf.predict import is_accel_degraded, look_back
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import ATT, GAINED, GPS_CLIMB, GPS_ERROR, MOVED, POS, VEL, State
from gateway.estimation.record import FloatArray, as_vec
from gateway.geometry.quaternion import difference, norm_sq, scaled
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

NOISE_SHARE: Final = 0.2
"""Share of the reported accuracy that is noise from fix to fix."""
ERROR_SHARES: Final = (0.7, 0.7, 0.9)
"""Shares of the reported accuracy that are slow error: north, east (of a radial accuracy), down."""
SPEED_SHARES: Final = (0.4, 0.4, 0.8)
"""Shares of the reported speed accuracy that are noise of one axis."""
CLIMB_ERROR_SHARE: Final = 0.6
"""Share of the reported speed accuracy that is slow error of the climb."""
SLOW_ERROR_MPS: Final = 0.05
SLOW_ERROR_S: Final = 4.0
"""Slow error of GPS velocities without a reported accuracy, and its correlation time."""
LEAST_FIX_INTERVAL_S: Final = 0.05
"""Least interval of fixes; closer ones count as if they had this interval."""
LEAST_LAG_S: Final = 0.1
"""Least time of a mean acceleration, which over a shorter time is mostly vibration."""
VELOCITY: Final = 0
POSITION: Final = 1
GLITCH_GATE_SQ: Final = (9.0, 16.0)
"""Squared gates of velocity and position, in variances, beyond which innovations are glitches."""
MAX_GLITCH: Final = (5.0, 30.0)
"""Largest size of a glitch, m/s and m."""
GLITCH_S: Final = 10.0
"""Time in which fixes share the same glitch."""
GLITCH_FADE_S: Final = 1.0
RECEIVER_LAG_S: Final = 0.2
"""Lag of the receiver's own filter in a manoeuvre."""


@compiled
def since_then(s: State, lag: float) -> tuple[Vec3, Vec3]:
    """Return the acceleration in NED integrated once and twice over the lag, which ends now."""
    now, then = s.integrals, s.then
    before = as_vec(then[GAINED : GAINED + 3])
    gained = difference(as_vec(now[GAINED : GAINED + 3]), before)
    moved = difference(as_vec(now[MOVED : MOVED + 3]), as_vec(then[MOVED : MOVED + 3]))
    return gained, difference(moved, scaled(before, lag))


@compiled
def past_state(s: State, lag: float) -> tuple[Vec3, Vec3]:
    """Return position and velocity `lag` seconds ago, from the present ones and `then`."""
    gained, moved = since_then(s, lag)
    vel = difference(as_vec(s.vel_n), gained)
    return difference(difference(as_vec(s.pos_n), scaled(vel, lag)), moved), vel


@compiled
def lag_integrals(s: State, lag: float) -> tuple[Vec3, Vec3]:
    """Return `S` and `D`: the specific force in NED integrated once and twice over the lag."""
    gained, moved = since_then(s, lag)
    g = STANDARD_GRAVITY_MPS2
    once = (gained[0], gained[1], gained[2] - g * lag)
    return once, (moved[0], moved[1], moved[2] - 0.5 * g * lag * lag)


@compiled
def set_error_variances(s: State, p: Gains, row: FloatArray) -> None:
    """Set the slow errors of a fix from the reported accuracies."""
    for k in range(3):
        usual = p.gps_error_var if k < 2 else p.gps_height_error_var
        accuracy = row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC]
        s.gps_error_var[k] = reported_variance(usual, accuracy, ERROR_SHARES[k])
        usual = SLOW_ERROR_MPS * SLOW_ERROR_MPS
        slow = reported_variance(usual, row[GPS_SPEED_ACC], SPEED_SHARES[k])
        s.pos_density[k] = 2.0 * SLOW_ERROR_S * slow
    usual = p.gps_climb_error_var
    s.gps_climb_error_var = reported_variance(usual, row[GPS_SPEED_ACC], CLIMB_ERROR_SHARE)


@compiled
def reported_variance(variance: float, accuracy: float, share: float) -> float:
    """Return the variance from a reported accuracy, or the default if none is reported."""
    return (share * accuracy) ** 2 if accuracy > 0.0 else variance


@compiled
def position_variance(s: State, p: Gains, row: FloatArray, k: int, since_s: float) -> float:
    """Return the noise of one coordinate of a fix, m2, with that of its varying latency."""
    usual = p.gps_position_var if k < 2 else p.gps_height_var
    accuracy = row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC]
    white = reported_variance(usual, accuracy, NOISE_SHARE)
    late = p.gps_jitter_sq * s.vel_n[k] * s.vel_n[k]
    return float((white + late) * max(1.0, p.gps_correlation_s / since_s))


@compiled
def velocity_variance(
    s: State, p: Gains, row: FloatArray, accel_n: Vec3, k: int, since_s: float
) -> float:
    """Return white noise with the same long-term effect as the errors of a velocity, m2/s2."""
    accuracy = row[GPS_SPEED_ACC]
    usual = p.gps_velocity_var if k < 2 else p.gps_climb_var
    white = reported_variance(usual, accuracy, SPEED_SHARES[k])
    assumed = NOISE_MPS * NOISE_MPS
    if k < 2 and s.time_s - s.mag_used_s > STALE_MAG_S:
        # Without a compass, the heading depends only on these velocities.
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
    gained, _ = since_then(s, span)
    return (gained[0] / span, gained[1] / span, gained[2] / span)


@compiled
def velocity_row(s: State, k: int, once: Vec3, lag: float) -> None:
    """Write the row of one component of a late velocity."""
    update.clear_row(s)
    set_attitude(s, k, scaled(once, -1.0))
    s.h[VEL + k] = 1.0
    if k == 2:
        s.h[GPS_CLIMB] = 1.0
    update.set_accel_bias(s, k, lag)


@compiled
def position_row(s: State, k: int, once: Vec3, twice: Vec3, lag: float) -> None:
    """Write the row of one component of a late position, which has the slow GPS error."""
    update.clear_row(s)
    set_attitude(s, k, difference(scaled(once, lag), twice))
    s.h[VEL + k] = -lag
    s.h[POS + k] = 1.0
    s.h[GPS_ERROR + k] = 1.0
    update.set_accel_bias(s, k, -0.5 * lag * lag)


@compiled
def set_attitude(s: State, k: int, w: Vec3) -> None:
    """Write the dependence of `(att x w)[k]` on the attitude error."""
    a, b = (k + 1) % 3, (k + 2) % 3
    s.h[ATT + a] = w[b]
    s.h[ATT + b] = -w[a]


@compiled
def is_unlikely(s: State, p: Gains, row: FloatArray, off: Vec3, lag: float) -> bool:
    """Return whether a position is outside the gate in north or east."""
    once, twice = lag_integrals(s, lag)
    worst = 0.0
    for k in range(2):
        position_row(s, k, once, twice, lag)
        total = update.innovation_variance(s, position_variance(s, p, row, k, p.gps_correlation_s))
        worst = max(worst, off[k] * off[k] / total)
    return worst > p.gate_sigma_sq


@compiled
def raise_glitch_variance(s: State, kind: int, off: float, variance: float, since_s: float) -> None:
    """Add the variance of a glitch, an innovation outside the gate that several fixes share.

    If its errors counted as independent in each fix, a glitch would outweigh valid inertial
    sensors. The equivalent variance is that of one error times the number of fixes that share it.
    """
    off = min(abs(off), MAX_GLITCH[kind])
    excess = off * off / GLITCH_GATE_SQ[kind] - update.innovation_variance(s, variance)
    s.glitch_var[kind] = max(s.glitch_var[kind], excess * max(1.0, GLITCH_S / since_s))


@compiled
def update_fix(
    s: State, p: Gains, row: FloatArray, off_pos: Vec3, off_vel: Vec3, lag: float
) -> None:
    """Update by velocity and position of a fix; components that are not finite are ignored."""
    once, twice = lag_integrals(s, lag)
    since_s = max(s.time_s - s.update_s, LEAST_FIX_INTERVAL_S)
    s.update_s = s.time_s
    accel_n = mean_acceleration(s, lag)
    faded = math.exp(-since_s / GLITCH_FADE_S)
    s.glitch_var[VELOCITY] *= faded
    s.glitch_var[POSITION] *= faded
    s.hard_accel_sq = max(norm_sq(accel_n), s.hard_accel_sq * faded)
    late_var = RECEIVER_LAG_S * RECEIVER_LAG_S * s.hard_accel_sq
    # All components are checked before any is used, because a glitch affects all of them.
    for k in range(2 if is_accel_degraded(s) else 3):
        if math.isfinite(off_vel[k]):
            velocity_row(s, k, once, lag)
            variance = velocity_variance(s, p, row, accel_n, k, since_s)
            raise_glitch_variance(s, VELOCITY, off_vel[k], variance + late_var, since_s)
        if math.isfinite(off_pos[k]):
            position_row(s, k, once, twice, lag)
            variance = position_variance(s, p, row, k, since_s)
            raise_glitch_variance(s, POSITION, off_pos[k], variance, since_s)
    for k in range(3):
        if math.isfinite(off_vel[k]):
            velocity_row(s, k, once, lag)
            variance = velocity_variance(s, p, row, accel_n, k, since_s)
            update.update_scalar(
                s, off_vel[k], variance + s.glitch_var[VELOCITY], GLITCH_GATE_SQ[VELOCITY]
            )
        if math.isfinite(off_pos[k]):
            position_row(s, k, once, twice, lag)
            variance = position_variance(s, p, row, k, since_s) + s.glitch_var[POSITION]
            update.update_scalar(s, off_pos[k], variance, p.gate_sigma_sq)
    update.inject(s)
