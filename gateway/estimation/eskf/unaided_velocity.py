"""The velocity where no GPS tells it: a hand's is about zero, a flight's is as it has shown."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.wahba import SPEED_MEMORY_S
from gateway.estimation.eskf.covariance import level_variance
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import VEL, EskfState
from gateway.estimation.eskf.late_fix import lag_integrals
from gateway.estimation.eskf.measure import UNAIDED_CORRELATION_S, take_back
from gateway.estimation.filtering.fix_intake import look_back
from gateway.estimation.filtering.hidden_pull import watch_hidden_pull
from gateway.estimation.kernel_record import as_quat, as_vec
from gateway.estimation.local_position import past_state
from gateway.estimation.rest import PUSHED_SQ
from gateway.units import STANDARD_GRAVITY_MPS2

WAY_S: Final = 2.0
HAND_M: Final = 2.0
"""A hand does not go so far in this time; what does is flown."""
SWING_S: Final = 0.1
"""A hand's motion, to and fro, keeps its velocity for about this time."""
SETTLE_S: Final = 20.0
"""The velocity that an attitude began with is forgotten in about this time."""
LEG_S: Final = 10.0
"""A flight that hardly turns is on the same leg for about this time."""
ASSUMED_S: Final = 5.0
"""Corrections that are older are not taken back."""


@compiled
def unaided_density(s: EskfState, p: EskfGains) -> float:
    """Return how little is known of a velocity that no GPS tells.

    Returns
    -------
    float
        The variance of the speed of about zero that stands in for a sensor, times how long the
        true velocity stays the same, m2/s. A hand's is small and short, but not at once known to
        be. What flies is as fast as its way has shown, and the harder it turns, the sooner it is
        another.
    """
    hand = p.unaided_var * UNAIDED_CORRELATION_S
    leg_s = min(0.5 * math.sqrt(s.unaided_sq) / max(s.turning_mps2, 0.1), LEG_S)
    return max(hand, s.hand_sq * SWING_S, s.unaided_sq * leg_s)


@compiled
def watch_way(s: EskfState, dt: float) -> None:
    """Detect flight: the way of the last seconds is longer than a hand carries anything.

    A take-off run is as smooth as rest, and its pull looks like tilt; only its way tells. The
    speed of about zero is refuted by it, so what that has corrected meanwhile is taken back.
    """
    lag = s.time_s - look_back(s, s.time_s - WAY_S)
    _, vel = past_state(s, s.then, lag)
    _, pushed = lag_integrals(s, s.then, lag)
    north = (vel[0] - s.assumed[3]) * lag + pushed[0]
    east = (vel[1] - s.assumed[4]) * lag + pushed[1]
    unsure = s.P[VEL, VEL] + s.P[VEL + 1, VEL + 1]
    pulled_sq = (0.5 * STANDARD_GRAVITY_MPS2 * lag) ** 2 * level_variance(s)
    drift = unsure + PUSHED_SQ * (2.0 * s.hand_sq + pulled_sq)
    flew = s.flies
    s.flies = 1 if north * north + east * east > HAND_M * HAND_M + lag * lag * drift else 0
    s.unaided_sq *= math.exp(-dt / SPEED_MEMORY_S)
    settled = math.exp(-dt / SETTLE_S)
    s.hand_sq *= settled
    for k in range(6):
        s.assumed[k] *= math.exp(-dt / ASSUMED_S)
    for k in range(3):
        s.assumed_bias[k] *= settled
        s.assumed_scale[k] *= settled
    watch_hidden_pull(s, as_quat(s.q_nb), as_vec(s.rate_b), s.flies == 1, dt)
    if s.at_rest == 1:
        s.unaided_sq, s.hand_sq, s.flies = 0.0, 0.0, 0
    elif s.flies == 1:
        shown = 0.5 * (s.vel_n[0] ** 2 + s.vel_n[1] ** 2 - unsure)
        s.unaided_sq = max(s.unaided_sq, shown)
        if flew == 0:
            take_back(s)
