"""Glitches: place and velocity of GPS that are off for a while, whatever the receiver tells.

A number beyond its gate does little alone: see `update_scalar`. But reflections and lost satellites
spoil all fixes of some seconds alike, place and velocity in agreement. Taken for errors that are
new in each fix, they would win over sensors that are right, and tilt the level. So what is off
beyond the gate counts as one error that lasts: its variance is multiplied by how many fixes share
it, which makes it the noise that errs as much in the long run, and the next fixes are doubted, too.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.covariance import lasting_excess
from gateway.estimation.eskf.eskf_state import EskfState
from gateway.records import Vec3

GLITCH_S: Final = 10.0
"""What is off beyond the gate is off for about this time."""
DOUBT_S: Final = 1.0
"""Doubt fades in about this time where fixes agree again."""
VELOCITY_GATE_SQ: Final = 9.0
"""A receiver's velocity lags in manoeuvres, far beyond its noise, so it counts for less early."""
DOUBT_PLACE_SQ: Final = 16.0
"""Beyond four standard deviations, the receiver's usual slow error included, a place is doubted."""
MOST_MPS: Final = 5.0
MOST_M: Final = 30.0
"""What is off by more is as doubtful as this: a single wild fix is forgotten within seconds."""
LAG_S: Final = 0.2
"""A receiver's velocity lags by about this in manoeuvres, far beyond its noise: no glitch."""
MANOEUVRE_S: Final = 2.0
"""It has caught up about this time after them."""


@compiled
def fade_doubt(s: EskfState, accel_n: Vec3, since_s: float) -> None:
    """Let doubt fade over the time since the last fix, and note what the aircraft flies, m/s2."""
    s.doubt_vel_sq *= math.exp(-since_s / DOUBT_S)
    s.doubt_pos_sq *= math.exp(-since_s / DOUBT_S)
    s.contradiction_mps *= math.exp(-since_s / DOUBT_S)
    north, east, down = accel_n
    now = math.sqrt(north * north + east * east + down * down)
    s.manoeuvre_mps2 = max(now, s.manoeuvre_mps2 * math.exp(-since_s / MANOEUVRE_S))


@compiled
def lag_variance(s: EskfState) -> float:
    """Return by how much a velocity may lag, m2/s2."""
    return (LAG_S * s.manoeuvre_mps2) ** 2


@compiled
def shared_by(since_s: float) -> float:
    """Return how many fixes, so long apart, share a glitch."""
    return max(1.0, GLITCH_S / since_s)


@compiled
def doubt_velocity(s: EskfState, off_mps: float, explained: float, since_s: float) -> None:
    """Doubt the velocities of fixes by what one axis is off; see `lasting_excess`.

    The true velocity may be either, so the filter's own is told no surer than that, nor are the
    level that may have turned it away and the place where it has led.
    """
    counts = min(abs(off_mps), MOST_MPS)
    excess = lasting_excess(counts, explained, VELOCITY_GATE_SQ, shared_by(since_s))
    if excess > 0.0:
        s.doubt_vel_sq = max(s.doubt_vel_sq, excess)
        s.contradiction_mps = max(s.contradiction_mps, counts)


@compiled
def doubt_position(s: EskfState, off_m: float, explained: float, since_s: float) -> None:
    """Doubt the places of fixes by what one axis is off; see `lasting_excess`."""
    counts = min(abs(off_m), MOST_M)
    excess = lasting_excess(counts, explained, DOUBT_PLACE_SQ, shared_by(since_s))
    s.doubt_pos_sq = max(s.doubt_pos_sq, excess)
