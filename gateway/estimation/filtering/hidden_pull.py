"""The level of what moved before one was seen: its steady pull passes for gravity.

A car that pulls away, or a wing in its turn, leans the mean force for seconds, and nothing shows it
but a rest, GPS, or a later change of the pull. What tilts and does not pull is in a hand.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.geometry.quaternion import rotate
from gateway.records import Quat, Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

HIDDEN_MPS2: Final = 1.0
"""By this, along an axis, what moves is to be expected to pull unseen."""
TILTING_RADPS: Final = 0.3
"""A vehicle tilts more slowly, but for a flight, and that pulls."""
HAND_S: Final = 4.0
"""What could have pulled for a few times this long and has not is in a hand."""
SHOWN_S: Final = 5.0
"""A rest of this time shows the level: on a smooth road a pull is as quiet, but shorter."""


class HiddenPullState:
    """What has been seen of the level."""

    rest_s: float
    """See `RestState`."""
    level_shown: int
    """1 once a rest or GPS has shown it."""
    tilted_s: float
    """Until then, for how long it has tilted."""
    flight_pulls: int
    """1 once something has pulled harder than a hand does."""


@compiled
def forget_level(s: HiddenPullState) -> None:
    """Let nothing have been seen of the level."""
    s.level_shown = s.flight_pulls = 0
    s.tilted_s = 0.0


@compiled
def watch_hidden_pull(s: HiddenPullState, q_eb: Quat, rate_b: Vec3, pulls: bool, dt: float) -> None:
    """Note a rest, which shows the level, and until then what shows that it is in a hand.

    Parameters
    ----------
    s : HiddenPullState
        Changed in place.
    q_eb : tuple of 4 floats
        Attitude: body FRD to a level frame.
    rate_b : tuple of 3 floats
        Angular rate in body FRD, rad/s.
    pulls : bool
        Whether it pulls harder than a hand does.
    dt : float
        Time since the last call, s.
    """
    if s.rest_s > SHOWN_S:
        s.level_shown = 1
    if s.level_shown == 1:
        return
    if pulls:
        s.flight_pulls = 1
    x, y, _ = rotate(q_eb, rate_b)
    if math.hypot(x, y) > TILTING_RADPS:
        s.tilted_s += dt


@compiled
def flight_share(pulled: int, calm_s: float) -> float:
    """Return how far it has to be expected that it flies or drives, and will pull.

    Parameters
    ----------
    pulled : int
        1 once it has pulled harder than a hand does.
    calm_s : float
        For how long it could have, s.
    """
    return 1.0 if pulled == 1 else math.exp(-calm_s / HAND_S)


@compiled
def hidden_level_var(s: HiddenPullState) -> float:
    """Return the variance of the level about an axis by what may pull unseen, rad2."""
    if s.level_shown == 1:
        return 0.0
    return (flight_share(s.flight_pulls, s.tilted_s) * HIDDEN_MPS2 / STANDARD_GRAVITY_MPS2) ** 2
