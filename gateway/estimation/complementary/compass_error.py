"""The slow error of the compass: what turns have shown of the iron that it carries along.

A field that turns along with the aircraft makes the strength of the whole grow and shrink with the
direction of the Earth's in the body. The more directions there were, the more of that iron shows;
what bends the dip shows some that a hover hides.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.magfield import (
    MIN_FIELD_UT,
    PLACE_RAD,
    SETTLE_S,
    bent_share_sq,
    steepness,
)
from gateway.records import Vec3

IRON_TAU_S: Final = 60.0
"""The mean of the field is taken over this time: it holds turns in all directions."""
EXPECTED_SHARE: Final = 1.0 / 3.0
"""The iron to be expected counts as much as what one axis of three has shown."""


@compiled
def note_strength(s: ComplementaryState, mag_b: Vec3, norm: float, dt: float) -> None:
    """Average the field in the body, and how far its strength is off its mean.

    Iron and current bend the field along all three axes alike: what they do to its strength, which
    knows of no attitude, tells what they do to the heading.
    """
    s.field_seen_s = min(s.field_seen_s + dt, IRON_TAU_S)
    share = dt / s.field_seen_s
    # The magnetometer's own noise is no iron.
    s.strength_lp_ut += dt / min(s.field_seen_s, SETTLE_S + dt) * (norm - s.strength_lp_ut)
    stronger = s.strength_lp_ut - s.strength_ut
    s.strength_ut += share * stronger
    s.strength_var_ut2 += share * ((1.0 - share) * stronger * stronger - s.strength_var_ut2)
    for k in range(3):
        s.field_direction_b[k] += share * (mag_b[k] / norm - s.field_direction_b[k])


@compiled
def compass_variance(s: ComplementaryState, p: ComplementaryGains) -> tuple[float, float]:
    """Return the variance of the compass's slow error, and the part of it by iron, rad2.

    GPS reveals that error as it is, and is weighed against all of it. Without GPS, what iron is
    to be expected gives way to the strength that turns have left the same; what it has changed
    averages out over the turns.
    """
    variance, iron = p.heading_noise_rad**2, steady_iron_variance(s)
    if s.level_dip_s > 0.0:
        variance *= steepness(s.level_dip_rad)
    level_ut = s.strength_ut * math.cos(s.level_dip_rad)
    if level_ut > MIN_FIELD_UT and s.level_by_gps == 1:
        iron += s.strength_var_ut2 / (level_ut * level_ut)
    elif level_ut > MIN_FIELD_UT:
        x, y, z = s.field_direction_b[0], s.field_direction_b[1], s.field_direction_b[2]
        turned = max(1.0 - x * x - y * y - z * z, 0.0)
        place = min(PLACE_RAD * PLACE_RAD, variance)
        variance = place + (variance - place) * EXPECTED_SHARE / (EXPECTED_SHARE + turned)
    return (variance + iron, iron)


@compiled
def steady_iron_variance(s: ComplementaryState) -> float:
    """Return the variance of the heading by iron that bends the dip of the field, rad2."""
    share_sq = bent_share_sq(s.level_dip_rad, s.earth_dip_rad)
    if s.level_dip_s == 0.0 or share_sq == 0.0:
        return 0.0
    return share_sq / max(math.cos(s.level_dip_rad) ** 2, share_sq)


@compiled
def note_dip(s: ComplementaryState, dip_rad: float, dt: float) -> None:
    """Average the dip of the field."""
    s.level_dip_s = min(s.level_dip_s + dt, IRON_TAU_S)
    s.level_dip_rad += dt / s.level_dip_s * (dip_rad - s.level_dip_rad)
