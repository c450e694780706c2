"""Magnetic disturbances: whether the field is the usual one.

A field whose strength or dip is not the usual one is not believed for a minute; a new field that
stays the same while the aircraft turns becomes the usual one.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.estimation.rest import UNTURNED_RAD
from gateway.records import Vec3
from gateway.settings import Settings, setting
from gateway.units import RAD_PER_DEG

SETTLE_S: Final = 0.5
"""An undisturbed field must last this long to be believed."""
REJECT_MAX_S: Final = 60.0
REJECT_SHARE: Final = 0.5
"""Weight of a disturbed compass after `REJECT_MAX_S`."""
FIELD_TAU_S: Final = 20.0
"""Time constant of the usual strength and dip."""
NEW_FIELD_S: Final = 20.0
"""Time in turning motion after which a steady other field becomes the usual one."""
FIRST_FIELD_S: Final = 5.0
TURNING_RADPS: Final = 0.35
STALE_MAG_S: Final = 1.0
MIN_FIELD_UT: Final = 1.0
UNCALIBRATED_IRON_UT: Final = 15.0
"""Iron along an axis that is to be expected in a compass which nobody has calibrated."""
PLACE_RAD: Final = 1.0 * RAD_PER_DEG
"""What the declination is off, and the compass on its board."""
DIP_ERROR_RAD: Final = 3.0 * RAD_PER_DEG
"""How far the dip is off the Earth model's without iron: by the place, by the sensor's scale."""
STUCK_TURN_RAD: Final = 0.05
"""A field that is the same to the last digit after so much of a turn is none: a sensor hangs."""
TURN_SHARE: Final = 0.2
"""A turn that changes the field by this share of its strength is compared with the gyroscope's."""
STILL_SHARE: Final = 0.1
"""A field that changes by less of what it should, squared, stands still."""
TURNS_KEPT: Final = 0.99
"""What was compared is forgotten after so many hundred turns more."""
WRONG_SHARE: Final = 0.75
RIGHT_SHARE: Final = 0.5
"""Of the field's changes, that the gyroscope leaves unexplained: a compass with an axis reversed or
in the place of another leaves most, or more than there are, one with strong iron some 0.4."""
LIKE_NORM_SHARE: Final = 0.04
LIKE_DIP_RAD: Final = 0.035
"""A field this much stronger or steeper than usual counts half."""
USUAL_DIP_RAD: Final = 74.0 * RAD_PER_DEG
"""Up to this dip of either sign a compass tells the heading as well as usual."""
LEAST_LEVEL: Final = 1e-3
"""Least share of a field's strength that counts as level."""


class CompassSettings(Settings, frozen=True):
    """When the compass is taken for disturbed; the same for complementary and eskf."""

    norm_tolerance: Annotated[
        float,
        setting("Share by which the field may differ from its usual strength.", ge=0.01, le=1.0),
    ] = 0.1
    dip_tolerance_deg: Annotated[
        float, setting("By how much its dip may differ.", "deg", ge=1.0, le=90.0)
    ] = 10.0


class FieldGains:
    """The same in SI units."""

    mag_norm_tolerance: float
    mag_dip_tolerance_rad: float


def field_gains(settings: CompassSettings) -> dict[str, float]:
    """Return the fields of `FieldGains`."""
    return {
        "mag_norm_tolerance": settings.norm_tolerance,
        "mag_dip_tolerance_rad": math.radians(settings.dip_tolerance_deg),
    }


class FieldState:
    """The usual field and a candidate for it."""

    time_s: float
    rate_b: Annotated[FloatArray, (3,)]
    """Angular rate, bias removed, rad/s."""
    at_rest: int
    bias_shown: int
    turn_s: float
    spun_rad: float
    """See `RestState`."""
    mag_s: float
    """Time of the last sample that told a field."""
    mag_norm_ref: float
    mag_dip_ref: float
    mag_ok_s: float
    mag_reject_s: float
    mag_new_norm: float
    mag_new_dip: float
    mag_new_s: float
    mag_disturbed: int
    mag_last: Annotated[FloatArray, (3,)]
    mag_turned: Annotated[FloatArray, (3,)]
    """Turn in body FRD since the field was another, rad; up to where it counts as hanging."""
    mag_begin: Annotated[FloatArray, (3,)]
    """Where a turn began, uT; zeros before the first."""
    mag_carried: Annotated[FloatArray, (3,)]
    """What it should be by now, by the gyroscope."""
    mag_changed_ut2: float
    mag_unexplained_ut2: float
    """By how much it was another after the last turns, and other than it should be: squares."""
    mag_uncalibrated: int
    """1 where nobody has calibrated the compass."""
    mag_misplaced: int
    """1 while the field turns otherwise than the aircraft: axes are swapped or reversed."""


@compiled
def is_field_told(s: FieldState, mag_b: Vec3, dt: float) -> bool:
    """Return whether a sample tells a field; to be asked at each one.

    Parameters
    ----------
    s : FieldState
        Changed in place.
    mag_b : tuple of 3 floats
        Calibrated field in body FRD, uT; NaN unless new.
    dt : float
        Time since the sample before, s.

    Returns
    -------
    bool
        False where it is not new, all zeros, or that of a compass that hangs or turns otherwise
        than the aircraft.
    """
    carry_field(s, dt)
    if s.at_rest == 0 and not has_turned(s):
        for k in range(3):
            s.mag_turned[k] += s.rate_b[k] * dt
    blank = not (mag_b[0] or mag_b[1] or mag_b[2])
    if blank or not math.isfinite(mag_b[0] + mag_b[1] + mag_b[2]):
        return False
    last = s.mag_last
    if mag_b[0] == last[0] and mag_b[1] == last[1] and mag_b[2] == last[2]:
        return bool(s.mag_misplaced == 0 and not has_turned(s))
    write_vec(last, mag_b)
    write_vec(s.mag_turned, (0.0, 0.0, 0.0))
    compare_turn(s, mag_b)
    return s.mag_misplaced == 0


@compiled
def has_turned(s: FieldState) -> bool:
    """Return whether the aircraft has turned since the field was another, if only for a while."""
    x, y, z = as_vec(s.mag_turned)
    return bool(x * x + y * y + z * z > STUCK_TURN_RAD * STUCK_TURN_RAD)


@compiled
def carry_field(s: FieldState, dt: float) -> None:
    """Turn the field of the turn's begin back, as the aircraft turns."""
    x, y, z = s.mag_carried[0], s.mag_carried[1], s.mag_carried[2]
    p, q, r = s.rate_b[0] * dt, s.rate_b[1] * dt, s.rate_b[2] * dt
    s.mag_carried[0] += y * r - z * q
    s.mag_carried[1] += z * p - x * r
    s.mag_carried[2] += x * q - y * p


@compiled
def begin_turn(s: FieldState, mag_b: Vec3) -> None:
    """Begin a turn at a field; at zeros where the next tells one."""
    write_vec(s.mag_begin, mag_b)
    write_vec(s.mag_carried, mag_b)


@compiled
def compare_turn(s: FieldState, mag_b: Vec3) -> None:
    """Compare how the field turns in the body with the gyroscope: this needs no attitude."""
    norm_sq = expected_sq = changed_sq = off_sq = 0.0
    for k in range(3):
        begin, carried = s.mag_begin[k], s.mag_carried[k]
        norm_sq += begin * begin
        expected_sq += (carried - begin) ** 2
        changed_sq += (mag_b[k] - begin) ** 2
        off_sq += (mag_b[k] - carried) ** 2
    if expected_sq < TURN_SHARE**2 * norm_sq:
        return
    begin_turn(s, mag_b)
    if norm_sq == 0.0:
        return
    if changed_sq > STILL_SHARE * expected_sq:
        s.turn_s = s.spun_rad = 0.0
    else:
        # The gyroscope alone says that it turns: its bias may be any by now.
        s.bias_shown, s.spun_rad = 0, UNTURNED_RAD
    if s.mag_changed_ut2 == 0.0:
        # Until turns of a radian or so have shown otherwise, it is a compass.
        s.mag_changed_ut2 = norm_sq
    s.mag_changed_ut2 = TURNS_KEPT * s.mag_changed_ut2 + changed_sq
    s.mag_unexplained_ut2 = TURNS_KEPT * s.mag_unexplained_ut2 + off_sq
    most = RIGHT_SHARE if s.mag_misplaced == 1 else WRONG_SHARE
    s.mag_misplaced = 1 if s.mag_unexplained_ut2 > most * s.mag_changed_ut2 else 0


@compiled
def take_field(s: FieldState, p: FieldGains, norm: float, down: float) -> float:
    """Judge the newest field.

    Parameters
    ----------
    s : FieldState
        Changed in place.
    p : FieldGains
        Constants.
    norm, down : float
        Its strength and its part downwards, uT.

    Returns
    -------
    float
        Weight of the sample, 0 to 1; 0 also where there is no field, or no new one.
    """
    dt = s.time_s - s.mag_s
    if norm < MIN_FIELD_UT or dt <= 0.0:
        return 0.0
    s.mag_s = s.time_s
    dip, dt = math.asin(down / norm), min(dt, STALE_MAG_S)
    return compare_field(s, p, norm, dip, dt)


@compiled
def compare_field(s: FieldState, p: FieldGains, norm: float, dip: float, dt: float) -> float:
    """Compare the field with the usual one.

    Parameters
    ----------
    s : FieldState
        Changed in place.
    p : FieldGains
        Constants.
    norm, dip : float
        Strength in uT and dip in rad of the newest field.
    dt : float
        Time since the sample before, s.

    Returns
    -------
    float
        Weight of the sample, 0 to 1.
    """
    if s.mag_norm_ref == 0.0:
        # Until a usual field is known there is nothing to compare with.
        learn_field(s, p, norm, dip, dt)
        return 1.0
    usual = (
        abs(norm - s.mag_norm_ref) < p.mag_norm_tolerance * s.mag_norm_ref
        and abs(dip - s.mag_dip_ref) < p.mag_dip_tolerance_rad
    )
    if usual:
        s.mag_ok_s += dt
        if s.mag_ok_s >= SETTLE_S:
            s.mag_disturbed = 0
            share = dt / FIELD_TAU_S
            s.mag_norm_ref += share * (norm - s.mag_norm_ref)
            s.mag_dip_ref += share * (dip - s.mag_dip_ref)
    else:
        s.mag_ok_s = 0.0
        s.mag_disturbed = 1
    learn_field(s, p, norm, dip, dt)
    if s.mag_disturbed == 0:
        s.mag_reject_s = max(s.mag_reject_s - 2.0 * dt, 0.0)
        return 1.0
    if s.mag_reject_s < REJECT_MAX_S:
        s.mag_reject_s += dt
        return 0.0
    return REJECT_SHARE


@compiled
def usual_dip(s: FieldState) -> float:
    """Return the dip of the usual field, or of what may become it while none is known, rad."""
    return float(s.mag_dip_ref if s.mag_norm_ref > 0.0 else s.mag_new_dip)


@compiled
def steepness(dip_rad: float) -> float:
    """Return by what the dip of the field multiplies the variance of a heading by compass.

    Iron, scale and currents bend a field by a share of its strength; the less of it lies level, the
    more that turns the heading. 1 up to `USUAL_DIP_RAD`, of either sign.
    """
    share = math.cos(USUAL_DIP_RAD) / max(math.cos(dip_rad), LEAST_LEVEL)
    return max(1.0, share * share)


@compiled
def bent_share_sq(dip_rad: float, earth_dip_rad: float) -> float:
    """Return the square of iron's share of a field, along one axis, by how it bends the dip.

    A hover or a stand shows no iron by the field's strength. But iron that makes the field steeper
    or less steep than it is at the place bends it sideways as much. 0 where that is not known.
    """
    bent = math.sin(dip_rad - earth_dip_rad)
    excess = bent * bent - DIP_ERROR_RAD**2
    return excess if excess > 0.0 else 0.0


@compiled
def field_unlikeness(s: FieldState, norm: float, dip: float) -> float:
    """Tell how unlike the usual field one is: what bends strength and dip bends the heading.

    Parameters
    ----------
    s : FieldState
        Tells the usual field.
    norm, dip : float
        Strength in uT and dip in rad of the newest field.

    Returns
    -------
    float
        By what to divide its weight: 1 for the usual field or while none is known, else more.
    """
    if s.mag_norm_ref == 0.0:
        return 1.0
    stronger = (norm / s.mag_norm_ref - 1.0) / LIKE_NORM_SHARE
    steeper = (dip - s.mag_dip_ref) / LIKE_DIP_RAD
    return 1.0 + stronger * stronger + steeper * steeper


@compiled
def learn_field(s: FieldState, p: FieldGains, norm: float, dip: float, dt: float) -> None:
    """Follow a candidate field and make it the usual one when it has proved steady."""
    if (
        abs(norm - s.mag_new_norm) < p.mag_norm_tolerance * s.mag_new_norm
        and abs(dip - s.mag_new_dip) < p.mag_dip_tolerance_rad
    ):
        x, y, z = s.rate_b[0], s.rate_b[1], s.rate_b[2]
        first = s.mag_norm_ref == 0.0
        if first or x * x + y * y + z * z > TURNING_RADPS * TURNING_RADPS:
            s.mag_new_s += dt
        share = dt / FIELD_TAU_S
        s.mag_new_norm += share * (norm - s.mag_new_norm)
        s.mag_new_dip += share * (dip - s.mag_new_dip)
        needed = FIRST_FIELD_S if first else NEW_FIELD_S
        if (first or s.mag_disturbed == 1) and s.mag_new_s >= needed:
            s.mag_norm_ref, s.mag_dip_ref = s.mag_new_norm, s.mag_new_dip
            s.mag_disturbed = 0
    else:
        s.mag_new_norm, s.mag_new_dip, s.mag_new_s = norm, dip, 0.0
