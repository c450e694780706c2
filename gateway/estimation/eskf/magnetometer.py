"""Magnetometer: valid readings, disturbances, misplaced axes, hard iron, and the heading.

Three checks precede the heading. A reading that does not change during a turn is stuck. The field
must rotate as the gyroscope measures, or axes are swapped. And its norm and dip must be the usual
ones; a new field that stays the same while the aircraft turns becomes the usual one [1]_. Three
states of the filter are the hard iron: turns distinguish it from the heading, since it rotates with
the body and changes the norm.

References
----------
.. [1] D. Laidig and T. Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation
   and magnetic disturbance rejection", Information Fusion 91, 2023, section 3.5.
.. [2] R. Alonso and M. D. Shuster, "Complete linear attitude-independent magnetometer calibration",
   Journal of the Astronautical Sciences 50, 2002.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.predict import NO_HEADING_VAR, propagate
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    GYRO_SCALE,
    HARD_IRON,
    MAG_LATENCY,
    State,
    raise_variance,
    reset_state,
    reset_states,
)
from gateway.estimation.eskf.update import clear_row, consider, inject, update_scalar
from gateway.estimation.record import as_quat, as_vec, write_quat, write_vec
from gateway.geometry import quaternion as quat
from gateway.geometry.angle import wrap_pi
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG

STALE_MAG_S: Final = 1.0
"""A compass without readings for longer is not in use."""
FIELD_RANGE_UT: Final = (1.0, 200.0)
"""The Earth's field is 22 to 67 uT; outside this range it is a fault or a magnet."""
MIN_LEVEL_SHARE: Final = 0.05
"""Least horizontal share of a field that gives a heading."""
STUCK_TURN_RAD: Final = 0.05
"""Turn over which an exactly repeated reading counts as stuck."""

SETTLE_S: Final = 0.5
"""Time after which a usual field counts as undisturbed, as in VQF."""
REJECT_MAX_S: Final = 60.0
"""Time after which a disturbed field is used again, at half its weight, as in VQF."""
FIELD_TAU_S: Final = 20.0
"""Time constant of the usual norm and dip, as in VQF."""
NEW_FIELD_S: Final = 20.0
"""Time in turns after which a candidate becomes the usual field, as in VQF."""
FIRST_FIELD_S: Final = 5.0
"""The same time for the first candidate, as in VQF."""
TURNING_RADPS: Final = 0.35
"""Least angular rate of such a turn, 20 deg/s, as in VQF."""
HALF_WEIGHT_NORM: Final = 0.04
HALF_WEIGHT_DIP_RAD: Final = 0.035
"""Differences in norm or dip at which a field has half the weight: a third of the tolerances."""
NORM_NOISE_UT: Final = 4.5
"""Change of the norm with the attitude due to errors of the scales and axes of the sensor."""
CORRELATION_S: Final = 1.0
"""Correlation time of compass errors: soft iron and currents change with the attitude."""
UNAIDED_CORRELATION_S: Final = 2.5
"""The same without GPS, when an error of the level rotates the heading through the dip."""
STEEP_DIP_RAD: Final = 74.0 * RAD_PER_DEG
"""Dip above which the horizontal field is weak, so that the set noise grows as 1/cos."""
DIP_ERROR_RAD: Final = 3.0 * RAD_PER_DEG
NORM_ERROR: Final = 0.07
"""Errors of the model's dip and norm at a location, including those of the sensor's scales."""

TURN_SHARE: Final = 0.2
"""Least change of the field, as a share of its norm, at which a turn is evaluated."""
TURNS_KEPT: Final = 0.99
"""Forgetting factor from turn to turn."""
MISPLACED_SHARE: Final = 0.75
WELL_PLACED_SHARE: Final = 0.5
"""Maximum unexplained share of the squared changes; with swapped axes most is unexplained."""
NORM_SHARE: Final = 0.1
"""Least change of the norm due to hard iron, as a share of the unexplained squared change."""

BIAS_TURN_RAD: Final = 4.0 * math.pi
"""Apparent turn, two circles, that is a gyroscope bias if no other sensor measures a turn."""


@compiled
def is_sound_field(s: State, mag_b: Vec3, dt: float) -> bool:
    """Return whether a sample contains a valid new field; must be called for each sample."""
    stuck = quat.norm_sq(as_vec(s.mag_turned)) > STUCK_TURN_RAD * STUCK_TURN_RAD
    if s.at_rest == 0 and not stuck:
        for k in range(3):
            s.mag_turned[k] += s.rate_b[k] * dt
    strength_sq = quat.norm_sq(mag_b)
    if not FIELD_RANGE_UT[0] ** 2 < strength_sq < FIELD_RANGE_UT[1] ** 2:
        return False
    if quat.norm_sq(quat.difference(mag_b, as_vec(s.mag_last))) == 0.0:
        return bool(s.mag_misplaced == 0 and not stuck)
    write_vec(s.mag_last, mag_b)
    s.mag_turned[:] = 0.0
    check_placement(s, mag_b)
    return bool(s.mag_misplaced == 0)


@compiled
def begin_turn(s: State, mag_b: Vec3) -> None:
    """Set the field with which the following ones are compared; zero for no comparison."""
    write_vec(s.mag_from_b, mag_b)
    write_vec(s.mag_from_i, quat.rotate(as_quat(s.q_ib), mag_b))


@compiled
def check_placement(s: State, mag_b: Vec3) -> None:
    """Compare the rotation of the field in the body with the gyroscope.

    Swapped or reversed axes do not change the norm. A strong hard iron leaves as much unexplained,
    but it changes the norm, and is not a reason to reject the compass.
    """
    begin = as_vec(s.mag_from_b)
    carried = quat.rotate_inverse(as_quat(s.q_ib), as_vec(s.mag_from_i))
    begin_sq = quat.norm_sq(begin)
    expected_sq = quat.norm_sq(quat.difference(carried, begin))
    if expected_sq < TURN_SHARE**2 * begin_sq:
        return
    begin_turn(s, mag_b)
    if begin_sq == 0.0:
        return
    changed_sq = quat.norm_sq(quat.difference(mag_b, begin))
    if changed_sq > NORM_SHARE * expected_sq:
        s.rest_turn_rad = 0.0
    else:
        # Only the gyroscope measures a turn, so its bias is unknown.
        s.rest_seen, s.rest_turn_rad = 0, BIAS_TURN_RAD
    change = math.sqrt(quat.norm_sq(mag_b)) - math.sqrt(begin_sq)
    q = s.mag_squares
    # One such turn is assumed to be explained, so that a few turns cannot decide.
    q[0] = TURNS_KEPT * (q[0] if q[0] > 0.0 else begin_sq) + changed_sq
    q[1] = TURNS_KEPT * q[1] + quat.norm_sq(quat.difference(mag_b, carried))
    q[2] = TURNS_KEPT * q[2] + change * change
    most = WELL_PLACED_SHARE if s.mag_misplaced == 1 else MISPLACED_SHARE
    s.mag_misplaced = 1 if q[1] > most * q[0] and q[2] < NORM_SHARE * q[1] else 0


@compiled
def agreement(norm_off: float, dip_off: float) -> float:
    """Return the weight of a field from its differences to the expected one."""
    unlike = (norm_off / HALF_WEIGHT_NORM) ** 2 + (dip_off / HALF_WEIGHT_DIP_RAD) ** 2
    return float(1.0 / (1.0 + unlike))


@compiled
def field_weight(s: State, p: Gains, norm: float, dip: float, dt: float) -> float:
    """Compare a field with the usual one; return the weight of its heading, 0 to 1.

    Before a usual field is known, it is compared with that of the Earth model.
    """
    if s.mag_ref[0] == 0.0:
        learn_field(s, p, norm, dip, dt)
        if not math.isfinite(s.earth_norm_ut):
            return 1.0
        return agreement(norm / s.earth_norm_ut - 1.0, dip - s.earth_dip_rad)
    norm_off, dip_off = norm / s.mag_ref[0] - 1.0, dip - s.mag_ref[1]
    usual = abs(norm_off) < p.field_norm_tolerance and abs(dip_off) < p.field_dip_tolerance_rad
    s.mag_usual_s = s.mag_usual_s + dt if usual else 0.0
    if not usual:
        s.mag_disturbed = 1
    elif s.mag_usual_s >= SETTLE_S:
        s.mag_disturbed = 0
        s.mag_ref[0] += dt / FIELD_TAU_S * (norm - s.mag_ref[0])
        s.mag_ref[1] += dt / FIELD_TAU_S * (dip - s.mag_ref[1])
    learn_field(s, p, norm, dip, dt)
    if s.mag_disturbed == 0:
        s.mag_rejected_s = max(s.mag_rejected_s - 2.0 * dt, 0.0)
        return agreement(norm_off, dip_off)
    s.mag_rejected_s = min(s.mag_rejected_s + dt, REJECT_MAX_S)
    return 0.0 if s.mag_rejected_s < REJECT_MAX_S else 0.5


@compiled
def learn_field(s: State, p: Gains, norm: float, dip: float, dt: float) -> None:
    """Update a candidate field, and make it the usual one after it was constant for long enough."""
    new = s.mag_new
    like = abs(norm - new[0]) < p.field_norm_tolerance * new[0]
    if not like or abs(dip - new[1]) > p.field_dip_tolerance_rad:
        new[0], new[1], s.mag_candidate_s = norm, dip, 0.0
        return
    first = s.mag_ref[0] == 0.0
    if first or quat.norm_sq(as_vec(s.rate_b)) > TURNING_RADPS * TURNING_RADPS:
        s.mag_candidate_s += dt
    new[0] += dt / FIELD_TAU_S * (norm - new[0])
    new[1] += dt / FIELD_TAU_S * (dip - new[1])
    needed_s = FIRST_FIELD_S if first else NEW_FIELD_S
    if (first or s.mag_disturbed == 1) and s.mag_candidate_s >= needed_s:
        s.mag_ref[0], s.mag_ref[1], s.mag_disturbed = new[0], new[1], 0


@compiled
def update_mag(s: State, p: Gains, mag_b: Vec3) -> None:
    """Use one valid reading of the calibrated field in body FRD, uT."""
    if s.lost == 1:
        return
    turned = quat.scaled(as_vec(s.rate_b), s.mag_latency_s)
    earth_b = quat.difference(mag_b, as_vec(s.hard_iron_b))
    present_b = quat.rotate_inverse(quat.from_rotation_vector(turned), earth_b)
    field_n = quat.rotate(as_quat(s.q_nb), present_b)
    level = math.hypot(field_n[0], field_n[1])
    norm = math.hypot(level, field_n[2])
    since_s = s.time_s - s.mag_s
    if norm < FIELD_RANGE_UT[0] or level < MIN_LEVEL_SHARE * norm or since_s <= 0.0:
        return
    s.mag_s = s.time_s
    dip = math.atan2(field_n[2], level)
    weight = field_weight(s, p, norm, dip, min(since_s, STALE_MAG_S))
    if weight == 0.0:
        return
    steep = max(1.0, (math.cos(STEEP_DIP_RAD) * norm / level) ** 2)
    variance = p.mag_noise_var * steep / weight
    propagate(s, p)
    if s.heading_known == 0:
        start_heading(s, p, field_n, variance)
    else:
        update_heading(s, p, field_n, variance)
    inject(s)
    write_vec(s.field_n, field_n)
    update_hard_iron(s, p, mag_b, weight, min(since_s, STALE_MAG_S))
    s.mag_used_s = s.time_s


@compiled
def update_hard_iron(s: State, p: Gains, mag_b: Vec3, weight: float, dt: float) -> None:
    """Update the hard iron `b` by the norm of the field, which does not change with the attitude.

    With the Earth's field `e`, `m = e + b` gives `|m|^2 = |e|^2 + 2 m b - |b|^2`. The difference of
    that from its mean is linear in `b`, and contains neither the attitude nor `|e|` [2]_.
    """
    consider_unaided(s)
    s.mag_mean_s += dt
    share = dt / min(FIELD_TAU_S, s.mag_mean_s)
    off = quat.norm_sq(mag_b) - s.mag_mean[3]
    s.mag_mean[3] += share * off
    for k in range(3):
        change = mag_b[k] - s.mag_mean[k]
        s.mag_mean[k] += share * change
        s.h[HARD_IRON + k] = 2.0 * change
        off -= 2.0 * change * s.hard_iron_b[k]
    if s.mag_mean_s < FIELD_TAU_S:
        return
    propagate(s, p)
    variance = 4.0 * quat.norm_sq(mag_b) * NORM_NOISE_UT**2 / weight
    update_scalar(s, off, variance * max(1.0, CORRELATION_S / dt), p.gate_sigma_sq)
    inject(s)


@compiled
def heading_row(s: State, field_n: Vec3) -> None:
    """Write the row of a magnetic heading, `declination - atan2(east, north)` of the field in NED.

    Its derivatives are `att_d - down (north att_n + east att_e) / level^2` (a tilt rotates the
    heading through the dip), plus `(east x_n - north x_e) / level^2` for hard iron on a body axis
    `x`, plus the rotation during the latency of the sample.
    """
    north, east, down = field_n
    level_sq = north * north + east * east
    s.h[ATT] = -down * north / level_sq
    s.h[ATT + 1] = -down * east / level_sq
    s.h[ATT + 2] = 1.0
    axes = quat.body_axes(as_quat(s.q_nb))
    for k in range(3):
        s.h[HARD_IRON + k] = (east * axes[k][0] - north * axes[k][1]) / level_sq
    # A field that is older by dt is rotated back by the angular rate times dt.
    rate_n = quat.rotate(as_quat(s.q_nb), as_vec(s.rate_b))
    for k in range(3):
        s.h[MAG_LATENCY] -= s.h[ATT + k] * rate_n[k]


@compiled
def consider_unaided(s: State) -> None:
    """Clear the row, and consider states that the compass must not change without GPS.

    Then the level depends only on the accelerometer, and the dip must not change it. And hard iron
    has the same effect on the heading in each turn as a scale error of the gyroscope.
    """
    clear_row(s)
    if s.aided == 0:
        consider(s, ATT, 2)
        consider(s, ACCEL_BIAS, 3)
        consider(s, GYRO_SCALE, 3)


@compiled
def declination(s: State) -> float:
    """Return the declination, rad; 0 while unknown."""
    return s.declination_rad if math.isfinite(s.declination_rad) else 0.0


@compiled
def start_heading(s: State, p: Gains, field_n: Vec3, variance: float) -> None:
    """Set the heading from the compass."""
    turn_heading(s, declination(s) - math.atan2(field_n[1], field_n[0]))
    reset_state(s, ATT + 2, NO_HEADING_VAR)
    clear_row(s)
    heading_row(s, field_n)
    update_scalar(s, 0.0, variance, p.gate_sigma_sq)
    s.heading_known = 1
    s.heading_true = 1 if math.isfinite(s.declination_rad) else 0


@compiled
def update_heading(s: State, p: Gains, field_n: Vec3, variance: float) -> None:
    """Update by the direction of the horizontal field, whose errors are correlated in time."""
    consider_unaided(s)
    heading_row(s, field_n)
    correlation_s = CORRELATION_S if s.aided == 1 else UNAIDED_CORRELATION_S
    since_s = min(s.time_s - s.mag_used_s, STALE_MAG_S)
    off = wrap_pi(declination(s) - math.atan2(field_n[1], field_n[0]))
    update_scalar(s, off, variance * max(1.0, correlation_s / since_s), p.gate_sigma_sq)


@compiled
def raise_hard_iron(s: State) -> None:
    """Raise the variance of the hard iron by the difference of the field from the Earth model's.

    Hard iron that changes norm and dip changes the heading by as much, so the variance of a heading
    from the compass is raised too.
    """
    field, norm = as_vec(s.field_n), s.earth_norm_ut
    level = math.hypot(field[0], field[1])
    if level == 0.0 or not math.isfinite(norm):
        return
    norm_off = math.hypot(level, field[2]) / norm - 1.0
    dip_off = math.sin(math.atan2(field[2], level) - s.earth_dip_rad)
    excess = max(norm_off * norm_off - NORM_ERROR**2, 0.0)
    excess += max(dip_off * dip_off - DIP_ERROR_RAD**2, 0.0)
    more = excess * norm * norm - s.P[HARD_IRON, HARD_IRON]
    if more <= 0.0:
        return
    clear_row(s)
    heading_row(s, field)
    for k in range(HARD_IRON, HARD_IRON + 3):
        raise_variance(s, k, more)
        turned = s.h[k] * more
        s.P[ATT + 2, k] -= turned
        s.P[k, ATT + 2] -= turned
        s.P[ATT + 2, ATT + 2] += s.h[k] * turned


@compiled
def reset_hard_iron(s: State, p: Gains) -> None:
    """Reset the estimated hard iron."""
    propagate(s, p)
    s.hard_iron_b[:] = 0.0
    s.mag_mean_s = 0.0
    reset_states(s, HARD_IRON, hard_iron_var(s, p))


@compiled
def hard_iron_var(s: State, p: Gains) -> float:
    """Return the initial variance of the hard iron per axis, uT2."""
    return p.hard_iron_uncalibrated_var if s.uncalibrated & 4 else p.hard_iron_var


@compiled
def turn_heading(s: State, turn_rad: float) -> None:
    """Rotate the attitude about down."""
    turn = quat.from_rotation_vector((0.0, 0.0, turn_rad))
    write_quat(s.q_nb, quat.normalise(quat.multiply(turn, as_quat(s.q_nb))))
    s.resets[ATT + 2] += 1.0
    # The integrals in NED contain the old heading.
    s.history_count = 0
