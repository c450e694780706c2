"""Iron that the compass carries along, three states of the Kalman filter in `drift`.

While gravity holds the level it is only considered, as what a calibration leaves. With GPS it is
estimated, by what `iron_evidence` shows. How much of it is to be expected, strength and dip tell as
well; what was taken for certain under a smaller expectation is taken back.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    COMPASS,
    HEADING,
    IRON,
    SCALE,
    STATES,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.compass_error import is_dip_turned
from gateway.estimation.complementary.errors.drift import carry_drift
from gateway.estimation.complementary.errors.drift_update import (
    OUTLIER_SIGMA,
    UNCLIPPED,
    apply_gain,
    cleared_row,
    correct_drift,
    expected_variance,
    widen_prior,
)
from gateway.estimation.filtering.iron_evidence import (
    COMPASS_CORRELATION_S,
    MISFIT_S,
    compare_strength,
    dip_by_iron,
    forget_strength,
    heading_by_iron,
    mean_strengthening,
    strength_noise_sq,
    unexplained_iron_sq,
)
from gateway.estimation.kernel_record import as_quat, as_vec
from gateway.estimation.magfield import DIP_ERROR_RAD, UNCALIBRATED_IRON_UT, bent_share_sq
from gateway.geometry.quaternion import rotate
from gateway.records import Vec3

AIDED_IRON_UT: Final = 1.0
"""Iron along an axis that a calibration leaves: expected with GPS where nothing shows more."""
MIN_LEVEL_SHARE: Final = 0.05
"""A field that stands more upright tells no heading."""


@compiled
def look_for_iron(
    s: ComplementaryState, p: ComplementaryGains, raw: Vec3, field_e: Vec3, dt: float
) -> None:
    """Compare strength and dip of a field with what they have been, and with the Earth's.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    raw : tuple of 3 floats
        Field in body FRD with the iron still in, uT.
    field_e : tuple of 3 floats
        Field in the level frame, the known iron out of it, uT; it tells a heading.
    dt : float
        Time since the field before, s.
    """
    if is_dip_turned(s):
        return
    carry_drift(s, p)
    if s.level_dip_s > 0.0:
        expect_iron(s, p, s.strength_ut**2 * bent_share_sq(s.level_dip_rad, s.earth_dip_rad))
    if s.level_by_gps == 0:
        return
    expect_iron(s, p, (UNCALIBRATED_IRON_UT if s.mag_uncalibrated == 1 else AIDED_IRON_UT) ** 2)
    before = mean_strengthening(s, as_vec(s.iron_b))
    if s.at_rest == 0:
        update_by_strength(s, p, raw, dt)
    update_by_dip(s, p, field_e, dt)
    follow_iron(s, raw, field_e, before)


@compiled
def tells_heading(field_e: Vec3) -> bool:
    """Return whether enough of a field lies level to tell a heading."""
    level = math.hypot(field_e[0], field_e[1])
    return level > MIN_LEVEL_SHARE * math.hypot(level, field_e[2])


@compiled
def expect_iron(s: ComplementaryState, p: ComplementaryGains, variance: float) -> None:
    """Take back what the iron was thought to be known by, where more of it is to be expected."""
    if variance <= s.iron_var:
        return
    for k in range(3):
        excess = widen_prior(s, IRON + k, s.iron_var, variance)
        if excess < 0.0:
            apply_gain(s, p, -s.iron_b[k] / excess, SCALE)
    s.iron_var = variance


@compiled
def doubt_iron(s: ComplementaryState, p: ComplementaryGains, variance: float) -> None:
    """Doubt iron that does not explain the field: there was more of it, or it has changed."""
    expect_iron(s, p, s.iron_var + variance)
    for k in range(IRON, IRON + 3):
        s.drift_cov[k, k] += variance
    s.iron_var += variance


@compiled
def doubt_iron_anew(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Be unsure of the iron by what the field has just jumped by: the heading has none of it."""
    if s.level_by_gps == 0:
        return
    carry_drift(s, p)
    x, y, z = as_vec(s.jump_b)
    for k in range(3):
        s.drift_cov[IRON + k, IRON + k] += s.jump_b[k] * s.jump_b[k]
    s.iron_var += max(x * x, y * y, z * z)
    forget_strength(s)


@compiled
def update_by_strength(s: ComplementaryState, p: ComplementaryGains, raw: Vec3, dt: float) -> None:
    """Correct the iron by how the strength of the field varies, once it does so beyond noise."""
    off, along = compare_strength(s, raw, as_vec(s.iron_b), dt)
    unexplained_sq = unexplained_iron_sq(s)
    if unexplained_sq > 0.0:
        s.iron_doubted = 1
        doubt_iron(s, p, unexplained_sq * dt / MISFIT_S)
    if s.iron_doubted == 0:
        return
    row = cleared_row(s)
    for k in range(3):
        row[IRON + k] = along[k]
    repeated = max(1.0, COMPASS_CORRELATION_S / dt)
    correct_by(s, p, off, strength_noise_sq(s) * repeated)


@compiled
def update_by_dip(s: ComplementaryState, p: ComplementaryGains, field_e: Vec3, dt: float) -> None:
    """Correct the iron by the dip, to within what the dip is off by itself."""
    if not math.isfinite(s.earth_dip_rad):
        return
    bent, row = dip_by_iron(as_quat(s.q_eb), field_e), cleared_row(s)
    for k in range(3):
        row[IRON + k] = bent[k]
    noise = DIP_ERROR_RAD * DIP_ERROR_RAD
    if expected_variance(s) < noise:
        return
    off = s.earth_dip_rad - math.atan2(field_e[2], math.hypot(field_e[0], field_e[1]))
    repeated = max(1.0, COMPASS_CORRELATION_S / dt)
    correct_by(s, p, off, noise * repeated)


@compiled
def correct_by(s: ComplementaryState, p: ComplementaryGains, off: float, noise: float) -> None:
    """Correct by a number whose row stands, the less the more it is off than is likely."""
    likely = off * off / OUTLIER_SIGMA**2
    correct_drift(s, p, off, max(noise, likely - expected_variance(s)), UNCLIPPED, SCALE)


@compiled
def follow_iron(s: ComplementaryState, raw: Vec3, field_e: Vec3, before: float) -> None:
    """Take for the usual field what is left of it, and for the heading's share of the iron too.

    The less of the field lies level, the more the same iron turns a heading that follows it. Left
    as it was, the next compass would take the difference for evidence of the iron.
    """
    b = as_vec(s.iron_b)
    if s.mag_norm_ref > 0.0:
        s.mag_norm_ref -= mean_strengthening(s, b) - before
    left = rotate(as_quat(s.q_eb), (raw[0] - b[0], raw[1] - b[1], raw[2] - b[2]))
    if not tells_heading(left):
        return
    more = math.hypot(field_e[0], field_e[1]) / math.hypot(left[0], left[1]) - 1.0
    P, turned = s.drift_cov, heading_by_iron(as_quat(s.q_eb), field_e)
    share = followed_share(s) * more
    for j in range(STATES):
        for k in range(3):
            P[HEADING, j] -= share * turned[k] * P[IRON + k, j]
    for j in range(STATES):
        for k in range(3):
            P[j, HEADING] -= share * turned[k] * P[j, IRON + k]


@compiled
def followed_share(s: ComplementaryState) -> float:
    """Return the share of the compass's error that the heading has."""
    P = s.drift_cov
    if P[COMPASS, COMPASS] == 0.0:
        return 0.0
    return float(max(0.0, min(1.0, -P[HEADING, COMPASS] / P[COMPASS, COMPASS])))
