"""The heading by the compass.

The level frame drifts about the vertical with the gyroscope; `heading_rad` is the turn from it to
NED, a state of the Kalman filter in `drift`. A field whose strength or
dip is not the usual one is not believed for a minute; a new field that stays the same while the
aircraft turns becomes the usual one.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    COMPASS,
    HEADING,
    IRON,
    SCALE,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.carried_iron import (
    doubt_iron_anew,
    look_for_iron,
    tells_heading,
)
from gateway.estimation.complementary.errors.compass_error import note_dip, note_field
from gateway.estimation.complementary.errors.drift import carry_drift, heading_variance
from gateway.estimation.complementary.errors.drift_update import (
    UNCLIPPED,
    cleared_row,
    correct_drift,
)
from gateway.estimation.filtering.field_jump import has_jumped
from gateway.estimation.filtering.iron_evidence import (
    MISFIT_S,
    heading_by_iron,
    is_likely,
    unexplained_iron_sq,
)
from gateway.estimation.kernel_record import as_quat
from gateway.estimation.magfield import (
    MIN_FIELD_UT,
    STALE_MAG_S,
    steepness,
    take_field,
    usual_dip,
)
from gateway.geometry.angle import wrap_pi
from gateway.geometry.quaternion import rotate
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG

MAG_NOISE_DEG: Final = 3.2
"""Error of the compass that is another within a second or so."""
LEVEL_RAD: Final = 2.0 * RAD_PER_DEG
"""A level that is less sure says nothing of the field's dip."""
GOOD_VAR: Final = 0.3
"""Up to 30 deg of standard deviation, the GPS acceleration may be turned by the heading."""


@compiled
def is_heading_good(s: ComplementaryState) -> bool:
    """Return whether horizontal vectors may be turned by the heading."""
    return s.heading_known == 1 and heading_variance(s) < GOOD_VAR


@compiled
def compass_density(s: ComplementaryState, level_sq: float) -> float:
    """Return the density of the compass's noise, rad2 s; `level_sq` is of the field, uT2."""
    dip = usual_dip(s)
    density = (MAG_NOISE_DEG * RAD_PER_DEG) ** 2 * steepness(dip)
    if s.level_by_gps == 0:
        # A level that is off turns the field for as long, the more the steeper it is.
        steep = math.tan(dip)
        density += 2.0 * s.unaided_level_sq * steep * steep * s.gravity_tau_s
    return density + MISFIT_S * unexplained_iron_sq(s) / level_sq


@compiled
def take_mag(s: ComplementaryState, p: ComplementaryGains, mag_b: Vec3) -> None:
    """Correct the heading by one magnetometer sample.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    mag_b : tuple of 3 floats
        Calibrated field in body FRD, uT.
    """
    if s.lost == 1:
        return
    dt = min(s.time_s - s.mag_s, STALE_MAG_S)
    iron = s.iron_b
    own_b = (mag_b[0] - iron[0], mag_b[1] - iron[1], mag_b[2] - iron[2])
    field = rotate(as_quat(s.q_eb), own_b)
    north, east, down = field
    norm = math.sqrt(north * north + east * east + down * down)
    upright = not tells_heading(field)
    if has_jumped(s, mag_b):
        doubt_iron_anew(s, p)
    if norm > MIN_FIELD_UT and dt > 0.0:
        note_field(s, own_b, norm, dt)
        if is_likely(norm, s.strength_ut) and not upright:
            look_for_iron(s, p, mag_b, field, dt)
    weight = take_field(s, p, norm, down)
    if weight <= 0.0 or upright or not is_likely(norm, s.strength_ut):
        return
    level = max(s.told_std[0], s.told_std[1]) < LEVEL_RAD
    if level and s.mag_disturbed == 0:
        note_dip(s, math.asin(down / norm), dt)
    measured = -math.atan2(east, north)
    if math.isfinite(s.declination_rad):
        measured += s.declination_rad
        s.heading_true = 1
    carry_drift(s, p)
    if s.heading_known == 0:
        s.heading_rad, s.heading_known = wrap_pi(measured - s.compass_rad), 1
    innovation = wrap_pi(measured - s.compass_rad - s.heading_rad)
    density = compass_density(s, north * north + east * east)
    row = cleared_row(s)
    row[HEADING] = row[COMPASS] = 1.0
    turned = heading_by_iron(as_quat(s.q_eb), field)
    for k in range(3):
        row[IRON + k] = turned[k]
    correct_drift(s, p, innovation, density / (dt * weight), UNCLIPPED, SCALE)
