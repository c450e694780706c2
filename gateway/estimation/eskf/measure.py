"""The measurements: how each sensor's number depends on the errors.

A late fix is compared with the state at the time it was valid, and its row carries that state's
error back from the present one: `vel_then = vel - tilt x S + R L accel_bias` and
`pos_then = pos - L vel + tilt x (L S - D) - R L^2/2 accel_bias`, `S` and `D` being the first and
second integral of the specific force over the lag `L`. It is the same as fusing the fix in time,
but for the noise of the few tenths of a second between.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_velocity import TOLD_NOISE_MPS
from gateway.estimation.columns import GPS_H_ACC, GPS_SPEED_ACC, GPS_V_ACC
from gateway.estimation.eskf.covariance import (
    clear,
    consider,
    fade_force_turn,
    inject,
    innovation_variance,
    level_variance,
    normalised_innovation_sq,
    propagate,
    update_scalar,
)
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
    BARO_BIAS,
    GYRO_BIAS,
    MAG_BIAS,
    POS,
    TILT,
    VEL,
    WANDER,
    EskfState,
)
from gateway.estimation.eskf.fix_doubt import (
    VELOCITY_GATE_SQ,
    doubt_position,
    doubt_velocity,
    fade_doubt,
    lag_variance,
)
from gateway.estimation.filtering.fix_intake import look_back
from gateway.estimation.filtering.receiver_noise import lasting_noise_sq
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec
from gateway.estimation.magfield import STALE_MAG_S
from gateway.geometry.quaternion import rotate, wrap_pi
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

NOISE_SHARE: Final = 0.2
"""Of the accuracy that a receiver tells, the share that is noise from one fix to the next."""
WANDER_SHARE: Final = (0.7, 0.7, 0.9)
"""The share, north, east and down, that is its slow error; the horizontal accuracy is radial."""
SPEED_SHARE: Final = (0.4, 0.4, 0.8)
SLOW_MPS: Final = 0.05
SLOW_S: Final = 4.0
"""Beside their noise GPS velocities are off by as much again, or this, for so long: they do not
hold the place for ever against the slow error of its fixes."""
REST_VELOCITY_VAR: Final = 0.2**2
REST_RATE_VAR: Final = 0.002**2
UNAIDED_CORRELATION_S: Final = 1.0
"""The true speed that is taken for noise changes in about this time."""
COMPASS_CORRELATION_S: Final = 1.0
"""The errors of soft iron and current change with the attitude, so in about this time: recorded
compasses were 3 to 5 deg off, for half a second to two."""
STRENGTH_NOISE: Final = 0.03
"""Share by which the field's strength varies with no iron to find: soft iron, scale, currents."""
MISFIT_S: Final = 20.0
"""A strength that has varied for so long beyond its noise is that of unknown iron; the heading's
error by it lasts as long, for it changes with the attitude alone."""
FAR_SQ: Final = 1e12
LEAST_LAG_S: Final = 0.1
"""Over less, an acceleration is mostly vibration."""
LEAST_S: Final = 0.05
"""Fixes closer together count as that far apart."""


@compiled
def set_turned(s: EskfState, k: int, w: Vec3) -> None:
    """Put the dependence of `(tilt x w)[k]` on the tilt into the row."""
    a, b = (k + 1) % 3, (k + 2) % 3
    s.h[TILT + a] = w[b]
    s.h[TILT + b] = -w[a]


@compiled
def set_bias_row(s: EskfState, k: int, share: float) -> None:
    """Put `share` times row `k` of `R_nb` at the accelerometer bias."""
    q = as_quat(s.q_nb)
    x, y, z = rotate(q, (1.0, 0.0, 0.0)), rotate(q, (0.0, 1.0, 0.0)), rotate(q, (0.0, 0.0, 1.0))
    s.h[ACCEL_BIAS] = share * x[k]
    s.h[ACCEL_BIAS + 1] = share * y[k]
    s.h[ACCEL_BIAS + 2] = share * z[k]


@compiled
def lag_integrals(s: EskfState, then: FloatArray, lag: float) -> tuple[Vec3, Vec3]:
    """Integrate the specific force in NED once and twice over the lag.

    Parameters
    ----------
    s : EskfState
        Present integrals.
    then : ndarray, shape (INTEGRALS,)
        Integrals when the fix was valid.
    lag : float
        How long ago that was, s.

    Returns
    -------
    tuple of 2 vectors
        In m/s and m.
    """
    now, g = s.integrals, STANDARD_GRAVITY_MPS2
    return (
        (now[3] - then[3], now[4] - then[4], now[5] - then[5] - g * lag),
        (
            now[6] - then[6] - then[3] * lag,
            now[7] - then[7] - then[4] * lag,
            now[8] - then[8] - then[5] * lag - 0.5 * g * lag * lag,
        ),
    )


@compiled
def velocity_row(s: EskfState, k: int, once: Vec3, lag: float) -> None:
    """Write the row of one component of a late velocity."""
    clear(s)
    set_turned(s, k, (-once[0], -once[1], -once[2]))
    s.h[VEL + k] = 1.0
    set_bias_row(s, k, lag)


@compiled
def position_row(s: EskfState, k: int, once: Vec3, twice: Vec3, lag: float) -> None:
    """Write the row of one component of a late position; GPS adds its slow error."""
    clear(s)
    w = (lag * once[0] - twice[0], lag * once[1] - twice[1], lag * once[2] - twice[2])
    set_turned(s, k, w)
    s.h[VEL + k] = -lag
    s.h[POS + k] = 1.0
    s.h[WANDER + k] = 1.0
    set_bias_row(s, k, -0.5 * lag * lag)


@compiled
def reported_variance(variance: float, accuracy: float, share: float) -> float:
    """Take the receiver's word for its accuracy, where it gives one, before our own guess."""
    return (share * accuracy) ** 2 if accuracy > 0.0 else variance


@compiled
def set_wander_variance(s: EskfState, p: EskfGains, row: FloatArray) -> None:
    """Take the size of the GPS position's slow error from a fix's own accuracies."""
    for k in range(3):
        usual = p.gps_wander_var if k < 2 else p.gps_height_wander_var
        acc = row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC]
        s.wander_var[k] = reported_variance(usual, acc, WANDER_SHARE[k])
        slow = reported_variance(SLOW_MPS * SLOW_MPS, row[GPS_SPEED_ACC], SPEED_SHARE[k])
        s.place_density[k] = 2.0 * SLOW_S * slow


@compiled
def velocity_variance(s: EskfState, p: EskfGains, row: FloatArray, k: int) -> float:
    """Return the noise of one component of a fix's velocity, m2/s2.

    A heading that rests on nothing but these velocities turns with their errors: it counts them no
    smaller than the alignment does.
    """
    usual = p.gps_velocity_var if k < 2 else p.gps_climb_var
    variance = reported_variance(usual, row[GPS_SPEED_ACC], SPEED_SHARE[k])
    if k < 2 and s.time_s - s.mag_used_s > STALE_MAG_S:
        variance = max(variance, TOLD_NOISE_MPS * TOLD_NOISE_MPS * s.noise_excess)
    return variance


@compiled
def place_variance(p: EskfGains, row: FloatArray, k: int) -> float:
    """Return the noise of one coordinate of a fix from one to the next, m2."""
    usual = p.gps_position_var if k < 2 else p.gps_height_var
    return reported_variance(usual, row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC], NOISE_SHARE)


@compiled
def mean_acceleration(s: EskfState, lag: float) -> Vec3:
    """Return the mean acceleration over the lag, `LEAST_LAG_S` at least, m/s2; uses `then` up."""
    span = s.time_s - look_back(s, s.time_s - max(lag, LEAST_LAG_S))
    if span <= 0.0:
        return (0.0, 0.0, 0.0)
    now, then = s.integrals, s.then
    return ((now[3] - then[3]) / span, (now[4] - then[4]) / span, (now[5] - then[5]) / span)


@compiled
def delay_variances(s: EskfState, p: EskfGains, a: Vec3) -> tuple[Vec3, Vec3]:
    """Compute what the jitter of the latency adds to position and velocity, at `a` m/s2."""
    v, j = s.vel_n, p.gps_jitter_sq
    return (
        (j * v[0] * v[0], j * v[1] * v[1], j * v[2] * v[2]),
        (j * a[0] * a[0], j * a[1] * a[1], j * a[2] * a[2]),
    )


@compiled
def place_distance_sq(
    s: EskfState, p: EskfGains, row: FloatArray, off_pos: Vec3, once: Vec3, twice: Vec3, lag: float
) -> float:
    """Return how unlikely the horizontal place of a fix is, before any of its numbers is used.

    Returns
    -------
    float
        The larger normalised innovation squared of north and east.
    """
    worst = 0.0
    v, j = s.vel_n, p.gps_jitter_sq
    for k in range(2):
        position_row(s, k, once, twice, lag)
        variance = place_variance(p, row, k) + j * v[k] * v[k]
        worst = max(worst, normalised_innovation_sq(s, off_pos[k], variance))
    return worst


@compiled
def update_by_fix(
    s: EskfState,
    p: EskfGains,
    row: FloatArray,
    off_pos: Vec3,
    off_vel: Vec3,
    once: Vec3,
    twice: Vec3,
    lag: float,
) -> None:
    """Update by a fix: three velocities, three positions, the less the more it is doubted.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    row : ndarray, shape (GPS_COLUMNS,)
        The fix, for its accuracies.
    off_pos, off_vel : tuple of 3 floats
        Innovations; what is not finite is left out.
    once, twice : tuple of 3 floats
        See `lag_integrals`.
    lag : float
        Age of the fix, s.
    """
    before, level = s.P[TILT + 2, TILT + 2], level_variance(s)
    since = max(s.time_s - s.weighed_s, LEAST_S)
    s.weighed_s = s.time_s
    accel = mean_acceleration(s, lag)
    fade_doubt(s, accel, since)
    late_pos, late_vel = delay_variances(s, p, accel)
    repeated = max(1.0, p.velocity_correlation_s / since)
    unexpected = lasting_noise_sq(s, accel[0] * accel[0] + accel[1] * accel[1], since)
    noise_vel = (
        max(repeated * velocity_variance(s, p, row, 0) + late_vel[0], unexpected),
        max(repeated * velocity_variance(s, p, row, 1) + late_vel[1], unexpected),
        max(repeated * velocity_variance(s, p, row, 2) + late_vel[2], unexpected),
    )
    noise_pos = (
        place_variance(p, row, 0) + late_pos[0],
        place_variance(p, row, 1) + late_pos[1],
        place_variance(p, row, 2) + late_pos[2],
    )
    # All of a fix is weighed before any of it is used: a glitch that shows in one axis spoils all.
    for k in range(3):
        if math.isfinite(off_vel[k]):
            velocity_row(s, k, once, lag)
            explained = innovation_variance(s, noise_vel[k]) + lag_variance(s)
            doubt_velocity(s, off_vel[k], explained, since)
        if math.isfinite(off_pos[k]):
            position_row(s, k, once, twice, lag)
            explained = innovation_variance(s, noise_pos[k])
            doubt_position(s, off_pos[k], explained, since)
    for k in range(3):
        if math.isfinite(off_vel[k]):
            velocity_row(s, k, once, lag)
            update_scalar(s, off_vel[k], noise_vel[k] + s.doubt_vel_sq, VELOCITY_GATE_SQ)
        if math.isfinite(off_pos[k]):
            position_row(s, k, once, twice, lag)
            update_scalar(s, off_pos[k], noise_pos[k] + s.doubt_pos_sq, p.gate_sq)
    s.compass_share *= s.P[TILT + 2, TILT + 2] / before
    fade_force_turn(s, level)
    inject(s)


@compiled
def compass_row(s: EskfState, field_n: Vec3) -> None:
    """Write the row of a compass: the heading, and the tilt through the field's dip."""
    clear(s)
    north, east, down = field_n
    level_sq = north * north + east * east
    s.h[TILT] = -down * north / level_sq
    s.h[TILT + 1] = -down * east / level_sq
    s.h[TILT + 2] = 1.0
    q = as_quat(s.q_nb)
    axes = (rotate(q, (1.0, 0.0, 0.0)), rotate(q, (0.0, 1.0, 0.0)), rotate(q, (0.0, 0.0, 1.0)))
    for k in range(3):
        s.h[MAG_BIAS + k] = (east * axes[k][0] - north * axes[k][1]) / level_sq


@compiled
def unexplained_iron_sq(s: EskfState) -> float:
    """Return the variance, per axis, of what bends the field beyond the iron that is known, uT2."""
    return max(s.iron_misfit - (STRENGTH_NOISE * s.iron_norm) ** 2, 0.0)


@compiled
def update_by_compass(
    s: EskfState, p: EskfGains, field_n: Vec3, declination: float, weight: float, dt: float
) -> None:
    """Update by the direction of the horizontal field, `dt` after the last such update.

    What the compass is off on its board is no noise: the heading is off by as much of it as its
    variance owes to the compass.
    """
    propagate(s, p)
    before = s.P[TILT + 2, TILT + 2]
    repeated = max(1.0, COMPASS_CORRELATION_S / dt)
    measured = declination - math.atan2(field_n[1], field_n[0])
    compass_row(s, field_n)
    if s.aided == 0:
        # The horizon rests on the accelerometer alone then: keep the field's dip out of it.
        consider(s, TILT, 2)
        consider(s, ACCEL_BIAS, 3)
    level_sq = field_n[0] * field_n[0] + field_n[1] * field_n[1]
    lasting = max(1.0, MISFIT_S / dt) * unexplained_iron_sq(s) / level_sq
    noise = repeated * p.mag_var / weight + lasting
    off = wrap_pi(measured)
    # What is off beyond the gate lasts as long as any error of the compass.
    noise += repeated * max(off * off / p.gate_sq - innovation_variance(s, noise), 0.0)
    update_scalar(s, off, noise, p.gate_sq)
    s.compass_share = 1.0 - (1.0 - s.compass_share) * s.P[TILT + 2, TILT + 2] / before
    inject(s)


@compiled
def update_by_baro(s: EskfState, p: EskfGains, down_m: float) -> None:
    """Update by the barometer's depth below zero height."""
    propagate(s, p)
    clear(s)
    s.h[POS + 2] = 1.0
    s.h[BARO_BIAS] = -1.0
    update_scalar(s, down_m + s.baro_bias_m - s.pos_n[2], p.baro_var, p.gate_sq)
    inject(s)


@compiled
def update_by_velocity(s: EskfState, p: EskfGains, variance: float) -> None:
    """Update by a velocity of about zero, for want of better."""
    propagate(s, p)
    level = level_variance(s)
    for k in range(3):
        clear(s)
        s.h[VEL + k] = 1.0
        # An assumed velocity is wrong in step with the turns, and the bias would take the blame.
        consider(s, ACCEL_BIAS, 3)
        update_scalar(s, -s.vel_n[k], variance, FAR_SQ)
    for k in range(6):
        s.assumed[k] += s.dx[TILT + k]
    fade_force_turn(s, level)
    inject(s)


@compiled
def take_back(s: EskfState) -> None:
    """Undo what the speed of about zero has lately corrected, and be unsure by as much."""
    for k in range(6):
        s.dx[TILT + k] = -s.assumed[k]
        s.P[TILT + k, TILT + k] += s.assumed[k] * s.assumed[k]
        s.assumed[k] = 0.0
    inject(s)


@compiled
def update_by_rest(s: EskfState, p: EskfGains) -> None:
    """Update by standing still: no velocity, and a rate that is the bias."""
    propagate(s, p)
    level = level_variance(s)
    rate = as_vec(s.gyro_rest)
    for k in range(3):
        clear(s)
        s.h[GYRO_BIAS + k] = 1.0
        update_scalar(s, rate[k] - s.gyro_bias_b[k], REST_RATE_VAR, FAR_SQ)
    for k in range(3):
        clear(s)
        s.h[VEL + k] = 1.0
        update_scalar(s, -s.vel_n[k], REST_VELOCITY_VAR, p.gate_sq)
    fade_force_turn(s, level)
    inject(s)
