"""The measurements but for fixes: how a number of each sensor depends on the errors."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.covariance import (
    clear,
    consider,
    fade_force_turn,
    inject,
    innovation_variance,
    lasting_excess,
    level_variance,
    propagate,
    update_scalar,
)
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
    BARO_BIAS,
    GYRO_BIAS,
    GYRO_SCALE,
    MAG_BIAS,
    POS,
    TILT,
    VEL,
    EskfState,
)
from gateway.estimation.filtering.iron_evidence import (
    COMPASS_CORRELATION_S,
    MISFIT_S,
    heading_by_iron,
    unexplained_iron_sq,
)
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec
from gateway.estimation.magfield import steepness
from gateway.geometry.angle import wrap_pi
from gateway.records import Vec3

REST_VELOCITY_VAR: Final = 0.2**2
REST_RATE_VAR: Final = 0.002**2
UNAIDED_CORRELATION_S: Final = 1.0
"""The true speed that is taken for noise changes in about this time."""
UNAIDED_COMPASS_S: Final = 5.0
"""Without GPS the tilt is off for as long as this, and the field's dip turns the compass by it."""
FAR_SQ: Final = 1e12


@compiled
def compass_row(s: EskfState, field_n: Vec3) -> None:
    """Write the row of a compass: the heading, and the tilt through the field's dip."""
    clear(s)
    north, east, down = field_n
    level_sq = north * north + east * east
    s.h[TILT] = -down * north / level_sq
    s.h[TILT + 1] = -down * east / level_sq
    s.h[TILT + 2] = 1.0
    turned = heading_by_iron(as_quat(s.q_nb), field_n)
    for k in range(3):
        s.h[MAG_BIAS + k] = turned[k]


@compiled
def bent_var(s: EskfState) -> float:
    """Return by how much iron may turn the heading beyond what the row in `h` tells, rad2.

    As strong as the Earth's level field, it turns it by an angle that is no straight line of it:
    the second-order term of the extended filter [1]_, half the square of the first.

    References
    ----------
    .. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", 2001, section 10.3.2.
    """
    turned_sq = 0.0
    for k in range(MAG_BIAS, MAG_BIAS + 3):
        for j in range(MAG_BIAS, MAG_BIAS + 3):
            turned_sq += s.h[k] * s.P[k, j] * s.h[j]
    return 0.5 * turned_sq * turned_sq


@compiled
def compass_correlation_s(s: EskfState) -> float:
    """Return for how long the errors of the compass are alike, s."""
    unaided = s.aided == 0 and s.iron_search_started == 1
    return UNAIDED_COMPASS_S if unaided else COMPASS_CORRELATION_S


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
    repeated = max(1.0, compass_correlation_s(s) / dt)
    measured = declination - math.atan2(field_n[1], field_n[0])
    compass_row(s, field_n)
    if s.aided == 0:
        # The horizon rests on the accelerometer alone then: keep the field's dip out of it.
        consider(s, TILT, 2)
        consider(s, ACCEL_BIAS, 3)
        # Iron turns the compass in step with each turn, as a wrong scale would.
        consider(s, GYRO_SCALE, 3)
    level_sq = field_n[0] * field_n[0] + field_n[1] * field_n[1]
    lasting = max(1.0, MISFIT_S / dt) * unexplained_iron_sq(s) / level_sq
    steep = steepness(math.atan2(field_n[2], math.sqrt(level_sq)))
    noise = repeated * (steep * p.mag_var / weight + bent_var(s)) + lasting
    off = wrap_pi(measured)
    # What is off beyond the gate lasts as long as any error of the compass.
    explained = innovation_variance(s, noise)
    noise += max(lasting_excess(off, explained, p.gate_sq, repeated), 0.0)
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
        # An assumed velocity is wrong in step with the turns, and the bias would take the blame;
        # in a hand the heading would, through the scale that both share.
        consider(s, ACCEL_BIAS, 3)
        if s.unaided_sq < p.unaided_var:
            consider(s, TILT + 2, 1)
        update_scalar(s, -s.vel_n[k], variance, FAR_SQ)
    note_assumed(s, s.assumed, TILT)
    note_assumed(s, s.assumed_bias, GYRO_BIAS)
    note_assumed(s, s.assumed_scale, GYRO_SCALE)
    fade_force_turn(s, level)
    inject(s)


@compiled
def take_back(s: EskfState) -> None:
    """Undo what the speed of about zero has lately corrected, and be unsure by as much."""
    for k in range(3):
        s.bias_raised[k] += s.assumed_bias[k] * s.assumed_bias[k]
    take_states_back(s, s.assumed, TILT)
    take_states_back(s, s.assumed_bias, GYRO_BIAS)
    take_states_back(s, s.assumed_scale, GYRO_SCALE)
    inject(s)


@compiled
def note_assumed(s: EskfState, assumed: FloatArray, first: int) -> None:
    """Add what the states from `first` on are being corrected by."""
    for k in range(assumed.shape[0]):
        assumed[k] += s.dx[first + k]


@compiled
def take_states_back(s: EskfState, assumed: FloatArray, first: int) -> None:
    """Take a correction of the states from `first` on back, and forget it."""
    for k in range(assumed.shape[0]):
        s.dx[first + k] = -assumed[k]
        s.P[first + k, first + k] += assumed[k] * assumed[k]
        assumed[k] = 0.0


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
