"""What a rest says of the gyroscope's bias, and how far that may be believed in motion."""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import as_vec, fill, write_vec
from gateway.estimation.rest import USUAL_BIAS_RADPS, RestState, largest_difference
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG

BIAS_CHANGE_RADPS: Final = 0.15 * RAD_PER_DEG
"""What a gyroscope's bias may change by between rest and flight, by heat and vibration."""
LEAST_CHANGE_RADPS: Final = 0.05 * RAD_PER_DEG
LEAST_MOTION_S: Final = 20.0
"""A bias is that of a motion which lasted so long."""


@compiled
def doubt_rest_bias(s: RestState, bias_b: Vec3, rested: bool, moving: bool, dt: float) -> float:
    """Return how firmly a bias that was learned at rest may be believed in flight, or reversed.

    Parameters
    ----------
    s : RestState
        Changed in place.
    bias_b : tuple of 3 floats
        The estimator's, rad/s.
    rested : bool
        Whether it rested until the newest sample.
    moving : bool
        What GPS or dead reckoning says.
    dt : float
        Time step, s.

    Returns
    -------
    float
        Standard deviation in rad/s at the start of a motion: what the bias has changed by from
        motion to rest before, or may change by where that is not known. At the start of a rest: by
        how much the rate differs from the bias of the motion. 0 at other times.
    """
    if s.at_rest == 1:
        change = 0.0
        if not rested and s.flown_s > LEAST_MOTION_S:
            s.flown_known = 1
            write_vec(s.flown_bias_b, bias_b)
            change = largest_difference(bias_b, as_vec(s.gyro_rest))
        s.flown_s, s.bias_of_rest = 0.0, 1
        return change
    if not moving:
        return 0.0
    s.flown_s += dt
    if s.bias_of_rest == 0:
        return 0.0
    s.bias_of_rest = 0
    if s.flown_known == 0:
        return BIAS_CHANGE_RADPS
    change = largest_difference(bias_b, as_vec(s.flown_bias_b))
    return min(max(change, LEAST_CHANGE_RADPS), BIAS_CHANGE_RADPS)


@compiled
def forget_shown_bias(s: RestState) -> None:
    """Forget that a rest has shown the bias."""
    fill(s.shown_bias_b, 0.0)
    s.bias_shown = 0


@compiled
def has_spun(s: RestState, bias_b: Vec3) -> bool:
    """Return whether a rest shows that a bias was so far off that it has turned the attitude."""
    off = largest_difference(bias_b, as_vec(s.gyro_rest))
    return bool(s.at_rest == 1 and off > USUAL_BIAS_RADPS)
