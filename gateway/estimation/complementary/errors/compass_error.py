"""The slow error of the compass, as far as it is not iron of which turns have shown more.

Without GPS, a strength of the field that stays the same in turns shows that there is little iron:
the more directions there were, the less of it may be left.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.magfield import MIN_FIELD_UT, PLACE_RAD, UNCALIBRATED_IRON_UT, steepness
from gateway.records import Vec3

IRON_TAU_S: Final = 60.0
"""The mean of the field is taken over this time: it holds turns in all directions."""
TURNED_COS: Final = 0.5
"""Iron that bends the dip by more than 60 deg would be nearly as strong as the Earth's field."""
UNTOLD_VAR: Final = 1.0
"""What a compass with such a dip tells of the heading, rad2: nothing."""
EXPECTED_SHARE: Final = 1.0 / 3.0
"""The iron to be expected counts as much as what one axis of three has shown."""


@compiled
def note_field(s: ComplementaryState, mag_b: Vec3, norm: float, dt: float) -> None:
    """Average the strength of the field and its direction in the body."""
    s.field_seen_s = min(s.field_seen_s + dt, IRON_TAU_S)
    share = dt / s.field_seen_s
    s.strength_ut += share * (norm - s.strength_ut)
    for k in range(3):
        s.field_direction_b[k] += share * (mag_b[k] / norm - s.field_direction_b[k])


@compiled
def compass_variance(s: ComplementaryState, p: ComplementaryGains) -> float:
    """Return the variance of the compass's slow error, rad2.

    GPS reveals that error as it is, and is weighed against all of it. Without GPS, what is to be
    expected gives way to the strength that turns have left the same.
    """
    variance = p.heading_noise_rad**2
    if s.level_dip_s > 0.0:
        variance *= steepness(s.level_dip_rad)
    level_ut = s.strength_ut * math.cos(s.level_dip_rad)
    if level_ut > MIN_FIELD_UT and s.level_by_gps == 0:
        x, y, z = s.field_direction_b[0], s.field_direction_b[1], s.field_direction_b[2]
        if s.mag_uncalibrated == 1:
            variance = max(variance, (UNCALIBRATED_IRON_UT / level_ut) ** 2)
        turned = max(1.0 - x * x - y * y - z * z, 0.0)
        place = min(PLACE_RAD * PLACE_RAD, variance)
        variance = place + (variance - place) * EXPECTED_SHARE / (EXPECTED_SHARE + turned)
    if is_dip_turned(s):
        variance += UNTOLD_VAR
    return variance


@compiled
def is_dip_turned(s: ComplementaryState) -> bool:
    """Return whether the dip is off by more than iron bends it: the compass is reversed."""
    bent = math.cos(s.level_dip_rad - s.earth_dip_rad)
    return bool(s.level_dip_s > 0.0 and bent < TURNED_COS)


@compiled
def note_dip(s: ComplementaryState, dip_rad: float, dt: float) -> None:
    """Average the dip of the field."""
    s.level_dip_s = min(s.level_dip_s + dt, IRON_TAU_S)
    s.level_dip_rad += dt / s.level_dip_s * (dip_rad - s.level_dip_rad)
