"""How much noisier the velocities of a GPS receiver are than is expected of any.

A receiver's word for its accuracy may be too good, or missing. What the pairs of the alignment
leave unexplained is its noise, as long as the IMU is sound: see `heading_evidence`.
"""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_velocity import TOLD_NOISE_MPS
from gateway.estimation.alignment.heading_evidence import FITTED_PAIRS, LEAST_PAIRS
from gateway.estimation.alignment.pair_sums import MEMORY_S
from gateway.estimation.alignment.wahba import JITTER_S, PAIR_S
from gateway.estimation.filtering.filter_state import FilterState

ENOUGH_PAIRS: Final = MEMORY_S / PAIR_S
"""As many as are ever remembered tell the noise; a few differ by chance."""
LASTING_S: Final = 1.0
"""Errors beyond a receiver's word, of multipath and of its own filter, last about this long."""


@compiled
def note_receiver_noise(s: FilterState) -> None:
    """Learn from the pairs that the alignment has weighed last; to be asked at each pair.

    Not while a fault of the IMU is among them: that is no noise of the receiver.
    """
    if s.pairs < LEAST_PAIRS or s.sound_s < MEMORY_S or s.noise_excess == 0.0:
        return
    told = s.pairs - FITTED_PAIRS
    s.noise_shown += told / (told + ENOUGH_PAIRS) * (s.noise_excess - s.noise_shown)


@compiled
def unexpected_noise_sq(s: FilterState, accel_sq: float) -> float:
    """Return what GPS velocities have been off beyond what is expected of any, along an axis.

    Parameters
    ----------
    s : FilterState
        Unchanged.
    accel_sq : float
        Square of the level acceleration, m2/s4: a receiver that lags is off by that.

    Returns
    -------
    float
        Variance, m2/s2; 0 of a good receiver, and while nothing is known.
    """
    expected = TOLD_NOISE_MPS * TOLD_NOISE_MPS + JITTER_S * JITTER_S * accel_sq
    # That of the accelerometer is in the pairs as well.
    shaken = 0.5 * PAIR_S * s.force_density
    return max(expected * (s.noise_shown - 1.0) - shaken, 0.0)


@compiled
def lasting_noise_sq(s: FilterState, accel_sq: float, since_s: float) -> float:
    """Return the variance of white noise that errs as much in the long run, m2/s2.

    `since_s` is the time between fixes; see `unexpected_noise_sq` for the rest.
    """
    return unexpected_noise_sq(s, accel_sq) * max(1.0, LASTING_S / max(since_s, 0.05))
