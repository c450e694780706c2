"""The measurement of a late fix: how its numbers depend on the errors.

It is compared with the state at the time it was valid, and its row carries that state's error back
from the present one: `vel_then = vel - tilt x S + R L accel_bias` and
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
    fade_force_turn,
    inject,
    innovation_variance,
    level_variance,
    normalised_innovation_sq,
    update_scalar,
)
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
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
    shared_by,
)
from gateway.estimation.filtering.fix_intake import look_back
from gateway.estimation.filtering.receiver_noise import lasting_noise_sq
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec
from gateway.estimation.magfield import STALE_MAG_S
from gateway.geometry.quaternion import body_axes
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
POOR_MPS: Final = 0.5
"""No receiver in the open tells worse: what it tells beyond is of reflections, and lasts."""
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
    x, y, z = body_axes(as_quat(s.q_nb))
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
def lasting_variance(s: EskfState, p: EskfGains, row: FloatArray, k: int, since_s: float) -> float:
    """Return the noise that errs as much as one component of a fix's velocity does, m2/s2.

    Its errors are alike for a moment; those by reflections, of which the receiver tells, are alike
    in all fixes of some seconds: noise as large as told would average out.
    """
    told = row[GPS_SPEED_ACC]
    beyond = told * told - POOR_MPS * POOR_MPS if told > POOR_MPS else 0.0
    reflected = shared_by(since_s) * SPEED_SHARE[k] * SPEED_SHARE[k] * beyond
    repeated = max(1.0, p.velocity_correlation_s / since_s)
    return float(repeated * velocity_variance(s, p, row, k) + reflected)


@compiled
def place_variance(p: EskfGains, row: FloatArray, k: int) -> float:
    """Return the noise of one coordinate of a fix from one to the next, m2."""
    usual = p.gps_position_var if k < 2 else p.gps_height_var
    return reported_variance(usual, row[GPS_H_ACC] if k < 2 else row[GPS_V_ACC], NOISE_SHARE)


@compiled
def mean_acceleration(s: EskfState, lag: float) -> Vec3:
    """Return the mean acceleration over the lag or `LEAST_LAG_S`, m/s2; `then` is overwritten."""
    span = s.time_s - look_back(s, s.time_s - max(lag, LEAST_LAG_S))
    if span <= 0.0:
        return (0.0, 0.0, 0.0)
    now, then = s.integrals, s.then
    return ((now[3] - then[3]) / span, (now[4] - then[4]) / span, (now[5] - then[5]) / span)


@compiled
def jitter_variances(p: EskfGains, rate: Vec3) -> Vec3:
    """Compute what the jitter of the latency adds to what changes at this rate, per second."""
    j = p.gps_jitter_sq
    return (j * rate[0] * rate[0], j * rate[1] * rate[1], j * rate[2] * rate[2])


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
    late_pos = jitter_variances(p, as_vec(s.vel_n))
    for k in range(2):
        position_row(s, k, once, twice, lag)
        variance = place_variance(p, row, k) + late_pos[k]
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
    late_pos, late_vel = jitter_variances(p, as_vec(s.vel_n)), jitter_variances(p, accel)
    unexpected = lasting_noise_sq(s, accel[0] * accel[0] + accel[1] * accel[1], since)
    noise_vel = (
        max(lasting_variance(s, p, row, 0, since) + late_vel[0], unexpected),
        max(lasting_variance(s, p, row, 1, since) + late_vel[1], unexpected),
        max(lasting_variance(s, p, row, 2, since) + late_vel[2], unexpected),
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
