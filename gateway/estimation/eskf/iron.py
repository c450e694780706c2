"""Iron that a compass carries along, as three states: by what `iron_evidence` shows of it."""

import math

from gateway.compiled import compiled
from gateway.estimation.eskf.covariance import (
    NO_HEADING_VAR,
    clear,
    consider,
    inject,
    innovation_variance,
    propagate,
    renew,
    update_scalar,
)
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import GYRO_SCALE, MAG_BIAS, STATES, TILT, EskfState
from gateway.estimation.eskf.measure import compass_correlation_s, compass_row
from gateway.estimation.filtering.covariance_scale import limit_variance
from gateway.estimation.filtering.iron_evidence import (
    MISFIT_S,
    compare_strength,
    dip_by_iron,
    forget_strength,
    is_likely,
    mean_strengthening,
    strength_noise_sq,
    unexplained_iron_sq,
)
from gateway.estimation.kernel_record import as_quat, as_vec
from gateway.estimation.magfield import (
    DIP_ERROR_RAD,
    FIELD_TAU_S,
    FIRST_FIELD_S,
    PLACE_RAD,
    SETTLE_S,
    STALE_MAG_S,
    UNCALIBRATED_IRON_UT,
    bent_share_sq,
)
from gateway.geometry.quaternion import rotate
from gateway.records import Vec3


@compiled
def look_for_iron(s: EskfState, p: EskfGains, raw: Vec3, dt: float) -> None:
    """Compare the strength of a field with its mean, in motion.

    Without GPS, iron is looked for within what a calibration leaves: a field that varies by more
    may be that of the place, since aircraft without GPS are often indoors.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    raw : tuple of 3 floats
        Field in body FRD with the iron still in, uT.
    dt : float
        Time since the field before, s.
    """
    if s.iron_search_started == 0 or s.at_rest == 1:
        return
    if s.aided == 0 and s.mag_disturbed == 1:
        return
    norm = math.sqrt(raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2])
    usual = s.mag_norm_ref if s.mag_norm_ref > 0.0 else s.iron_norm
    if s.iron_s > SETTLE_S and not is_likely(norm, usual):
        return
    dt = min(dt, STALE_MAG_S)
    off, along = compare_strength(s, raw, as_vec(s.mag_bias_b), dt)
    unexplained_sq = unexplained_iron_sq(s)
    if s.aided == 1 and unexplained_sq > 0.0:
        s.iron_doubted = 1
        doubt_iron(s, unexplained_sq * dt / MISFIT_S)
    if s.aided == 0 or s.iron_doubted == 1:
        propagate(s, p)
        clear(s)
        if s.aided == 0:
            consider(s, GYRO_SCALE, 3)
        for k in range(3):
            s.h[MAG_BIAS + k] = along[k]
        repeated = max(1.0, compass_correlation_s(s) / dt)
        update_scalar(s, off, strength_noise_sq(s) * repeated, p.gate_sq)
        inject(s)


@compiled
def update_by_dip(s: EskfState, p: EskfGains, field_n: Vec3, dt: float) -> None:
    """Compare the dip of the field with that of the Earth's field at the place.

    Iron bends it, and is told so without a turn, to within what the dip is off by itself. The level
    is left to the fixes.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    field_n : tuple of 3 floats
        Field in NED by the present attitude, uT; the iron that is known is out of it.
    dt : float
        Time since the field before, s.
    """
    if s.aided == 0 or s.iron_search_started == 0 or not math.isfinite(s.earth_dip_rad):
        return
    clear(s)
    bent = dip_by_iron(as_quat(s.q_nb), field_n)
    for k in range(3):
        s.h[MAG_BIAS + k] = bent[k]
    if innovation_variance(s, 0.0) < DIP_ERROR_RAD * DIP_ERROR_RAD:
        return
    propagate(s, p)
    dip_by_tilt(s, field_n)
    consider(s, TILT, 2)
    before = as_vec(s.mag_bias_b)
    off = s.earth_dip_rad - math.atan2(field_n[2], math.hypot(field_n[0], field_n[1]))
    update_scalar(s, off, p.mag_var * max(1.0, compass_correlation_s(s) / dt), p.gate_sq)
    inject(s)
    b = s.mag_bias_b
    more = (b[0] - before[0], b[1] - before[1], b[2] - before[2])
    iron_n = rotate(as_quat(s.q_nb), more)
    level = math.hypot(field_n[0] - iron_n[0], field_n[1] - iron_n[1])
    spread_heading(s, field_n, math.hypot(field_n[0], field_n[1]) / level - 1.0)


@compiled
def spread_heading(s: EskfState, field_n: Vec3, more: float) -> None:
    """Let iron turn a heading that follows the compass by a share `more` than was reckoned with.

    The less of the field lies level, the more the same iron turns it. Left as it was, the next
    compass would take the difference for evidence of the iron across the field.
    """
    if s.heading_known == 0:
        return
    compass_row(s, field_n)
    for k in range(MAG_BIAS, MAG_BIAS + 3):
        s.h[k] *= s.compass_share * more
    for j in range(STATES):
        for k in range(MAG_BIAS, MAG_BIAS + 3):
            s.P[TILT + 2, j] -= s.h[k] * s.P[k, j]
    for i in range(STATES):
        for k in range(MAG_BIAS, MAG_BIAS + 3):
            s.P[i, TILT + 2] -= s.h[k] * s.P[i, k]
    limit_variance(s.P, TILT + 2, NO_HEADING_VAR)


@compiled
def dip_by_tilt(s: EskfState, field_n: Vec3) -> None:
    """Write into the row how the tilt changes the field's dip."""
    level = math.hypot(field_n[0], field_n[1])
    s.h[TILT] = field_n[1] / level
    s.h[TILT + 1] = -field_n[0] / level


@compiled
def follow_field(s: EskfState, dip: float, dt: float) -> None:
    """Take for the usual field what is left of it without the iron that is just being found."""
    if s.iron_doubted == 0 or s.mag_norm_ref == 0.0:
        return
    s.mag_norm_ref = s.iron_norm - mean_strengthening(s, as_vec(s.mag_bias_b))
    s.mag_dip_ref += min(dt, STALE_MAG_S) / FIELD_TAU_S * (dip - s.mag_dip_ref)


@compiled
def has_followed_compass(s: EskfState) -> bool:
    """Return whether a compass has ever told a heading: not where the field stands upright."""
    return bool(s.field_n[0] != 0.0 or s.field_n[1] != 0.0)


@compiled
def doubt_iron(s: EskfState, variance: float) -> None:
    """Add to the variance of the iron, and to that of a heading which has followed the compass."""
    for k in range(MAG_BIAS, MAG_BIAS + 3):
        s.P[k, k] += variance
    if not has_followed_compass(s):
        return
    compass_row(s, as_vec(s.field_n))
    for k in range(MAG_BIAS, MAG_BIAS + 3):
        turned = s.h[k] * variance
        s.P[TILT + 2, k] -= turned
        s.P[k, TILT + 2] -= turned
        s.P[TILT + 2, TILT + 2] += s.h[k] * turned


@compiled
def doubt_iron_anew(s: EskfState, p: EskfGains) -> None:
    """Be unsure of the iron by what the field has just jumped by: the heading has none of it."""
    if s.aided == 0 or s.iron_search_started == 0:
        return
    propagate(s, p)
    for k in range(3):
        jump_sq = s.jump_b[k] * s.jump_b[k]
        s.P[MAG_BIAS + k, MAG_BIAS + k] += jump_sq
        s.iron_raised[k] += jump_sq
    forget_strength(s)


@compiled
def forget_iron(s: EskfState, p: EskfGains) -> None:
    """Know nothing of the iron that has been found, but that a calibration leaves little."""
    forget_strength(s)
    if s.iron_search_started == 0:
        return
    propagate(s, p)
    left_ut = UNCALIBRATED_IRON_UT if s.mag_uncalibrated == 1 else 0.0
    for k in range(3):
        s.mag_bias_b[k] = 0.0
        renew(s, MAG_BIAS + k, max(p.mag_bias_var, left_ut * left_ut))


@compiled
def start_iron_search(s: EskfState, p: EskfGains) -> None:
    """Look for iron: without GPS for what a calibration leaves, from the first fix on for any.

    A heading that came from the compass has the iron's error, reversed. Turns tell the iron from
    the heading: it turns along.
    """
    if s.iron_search_started == 0:
        s.iron_search_started = 1
        for k in range(MAG_BIAS, MAG_BIAS + 3):
            renew(s, k, 0.0)
    left = s.left_iron_ut * s.left_iron_ut
    variance = left if s.aided == 1 else min(left, p.mag_bias_var)
    s.left_iron_ut = math.sqrt(left - variance)
    if s.aided == 1 and has_followed_compass(s):
        north, east, down = as_vec(s.field_n)
        level_sq = north * north + east * east
        share_sq = bent_share_sq(math.atan2(down, math.sqrt(level_sq)), s.earth_dip_rad)
        variance = max(variance, share_sq * (level_sq + down * down) - s.P[MAG_BIAS, MAG_BIAS])
    doubt_iron(s, variance)


@compiled
def doubt_standing_field(s: EskfState, p: EskfGains, dt: float) -> None:
    """Doubt a heading that was read where the aircraft stood, where the field in motion is another.

    The floor's iron has turned the one, or motors and currents turn the other: which of both is the
    Earth's, nothing tells before a fix. What they differ by in strength and dip, they may differ by
    sideways. The doubt fades while the compass is believed in motion. Once it has been for some
    time, the iron that the calibration left is looked for.
    """
    confirmed = s.field_held_s >= FIRST_FIELD_S or s.iron_search_started == 1
    if s.mag_disturbed == 0 and s.at_rest == 0:
        s.field_held_s += dt
        variance = s.left_iron_ut * s.left_iron_ut
        least = p.mag_bias_var if s.iron_search_started == 0 else 0.0
        if s.aided_before == 0 and s.mag_uncalibrated == 1:
            least = UNCALIBRATED_IRON_UT**2
        variance += dt / FIELD_TAU_S * (least - variance)
        s.left_iron_ut = math.sqrt(variance)
        if s.iron_search_started == 0 and s.heading_known == 1 and s.field_held_s >= FIRST_FIELD_S:
            propagate(s, p)
            start_iron_search(s, p)
    elif s.mag_disturbed == 1 and not confirmed:
        s.field_held_s = 0.0
        norm, usual, turned = s.mag_new_norm, s.mag_norm_ref, s.mag_new_dip - s.mag_dip_ref
        apart_sq = norm * norm + usual * usual - 2.0 * norm * usual * math.cos(turned)
        s.left_iron_ut = math.sqrt(max(0.5 * apart_sq, p.mag_bias_var))


@compiled
def board_var(s: EskfState) -> float:
    """Return the variance of the heading by what the compass is off on its board, rad2."""
    return float((s.compass_share * PLACE_RAD) ** 2)


@compiled
def standing_field_var(s: EskfState) -> float:
    """Return the variance of a heading by iron that nothing tells from it yet, rad2.

    It is one error for as long as it lasts, until the iron is a state of its own.
    """
    level_ut = math.hypot(s.field_n[0], s.field_n[1])
    if level_ut == 0.0:
        return 0.0
    return (s.left_iron_ut / level_ut) ** 2
