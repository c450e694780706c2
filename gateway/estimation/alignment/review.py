"""When the alignment's attitude takes the place of an estimator's own."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.alignment.heading_evidence import heading_evidence
from gateway.estimation.alignment.pair_sums import clear_pairs
from gateway.estimation.alignment.wahba import (
    UNKNOWN_RAD,
    AlignmentState,
    alignment_level_std,
    heading_difference,
    level_difference,
    misfit,
    solve_alignment,
)
from gateway.estimation.kernel_record import FloatArray, as_quat, write_quat
from gateway.estimation.local_position import NEVER_S
from gateway.geometry.quaternion import multiply, normalise
from gateway.records import Quat
from gateway.units import STANDARD_GRAVITY_MPS2

FOUND_LEVEL_RAD: Final = 0.08
FOUND_HEADING_RAD: Final = 0.2
"""Up to these standard deviations an alignment is taken for the attitude, or contradicts it."""
PATIENCE_S: Final = 8.0
"""What pulls for longer is taken for gravity, where nothing else is told, and what spins turns."""
PULLED_MPS2: Final = 1.0
DOUBT_LEVEL_RAD: Final = 0.14
DOUBT_HEADING_RAD: Final = 0.3
DOUBT_S: Final = 2.0
"""An attitude further off than this, for so long, is given up for that of the alignment."""
DOUBT_GRAVITY_RAD: Final = 0.6
DOUBT_GRAVITY_S: Final = 5.0
"""The same where there is gravity alone, which manoeuvres hide."""
DOUBT_SIGMA: Final = 4.0
GRAVITY_PAIR_S: Final = 0.1
GAP_S: Final = 0.5
"""A longer silence of the IMU is not integrated over."""
GAP_TILT_RATE: Final = 0.05
"""In a silence the attitude may change by this beside the turn that it was in, rad/s."""
GAP_LOST_RAD: Final = 0.35
"""An attitude that may have changed by more is no attitude any more."""
BROUGHT_BACK_RAD: Final = 0.75
"""Up to this, the velocities of GPS bring one back whose change both ends of a silence tell."""
MOVING_MPS: Final = 3.0
"""From this speed on, an attitude that was found without GPS is not believed."""


class ReviewState(AlignmentState):
    """What the alignment says, and whether the attitude is known."""

    lost: int
    """1 while the attitude is not known."""
    lost_s: float
    """For how long."""
    doubt_s: float
    """For how long the alignment has contradicted the attitude."""
    heading_known: int
    spins: int
    """See `RestState`."""
    found_q_nb: Annotated[FloatArray, (4,)]
    level_std: float
    heading_std: float
    """The alignment's attitude after the last pair, and its standard deviations in rad."""


@compiled
def lose(s: ReviewState) -> None:
    """Note that the attitude is not known; the alignment begins anew."""
    s.lost, s.lost_s, s.doubt_s = 1, 0.0, 0.0
    s.heading_known = 0
    clear_pairs(s)
    s.pair_s = NEVER_S


@compiled
def find(s: ReviewState, q_nb: Quat, enough_rad: float = FOUND_HEADING_RAD) -> Quat:
    """Note that the attitude is known again, and tell it.

    Parameters
    ----------
    s : ReviewState
        `heading_known` is 0 afterwards where the alignment tells no heading.
    q_nb : tuple of 4 floats
        The estimator's own, whose heading is kept then.
    enough_rad : float
        Standard deviation up to which a heading is taken.

    Returns
    -------
    tuple of 4 floats
        `q_nb` from here on.
    """
    s.lost, s.doubt_s = 0, 0.0
    found = as_quat(s.found_q_nb)
    s.heading_known = 1 if s.by_gps == 1 and s.heading_std < enough_rad else 0
    if s.heading_known == 1:
        return found
    return turned(found, heading_difference(q_nb, found))


@compiled
def turned(q: Quat, turn_rad: float) -> Quat:
    """Turn an attitude about down."""
    half = 0.5 * turn_rad
    return normalise(multiply((math.cos(half), 0.0, 0.0, math.sin(half)), q))


@compiled
def tells_heading(s: ReviewState, enough_rad: float = FOUND_HEADING_RAD) -> bool:
    """Return whether a heading that is not known yet can be had from the alignment."""
    found = s.by_gps == 1 and s.level_std < FOUND_LEVEL_RAD and s.heading_std < enough_rad
    return bool(s.lost == 0 and s.heading_known == 0 and found)


@compiled
def is_to_be_taken(
    s: ReviewState,
    q_nb: Quat,
    level_told: float,
    heading_told: float,
    bias_radps: float,
    dt: float,
) -> bool:
    """Solve the alignment after a new pair and compare it with the attitude.

    Parameters
    ----------
    s : ReviewState
        Changed in place.
    q_nb : tuple of 4 floats
        The estimator's own attitude.
    level_told, heading_told : float
        Its standard deviations, rad.
    bias_radps : float
        Standard deviation of the gyroscope's bias.
    dt : float
        Length of the pair, s.

    Returns
    -------
    bool
        Whether the alignment's attitude is to take its place: see `find`.
    """
    q_ni = solve_alignment(s)
    s.level_std, s.heading_std = alignment_level_std(s, misfit(s, q_ni)), UNKNOWN_RAD
    if s.by_gps == 1:
        turn_rad, s.heading_std = heading_evidence(s, q_ni, bias_radps)
        q_ni = turned(q_ni, turn_rad)
    write_quat(s.found_q_nb, normalise(multiply(q_ni, as_quat(s.q_ib))))
    if s.lost == 1:
        s.lost_s += dt
        # Of a motion that does not end, a worse level in time is better than none.
        level_found = s.level_std < FOUND_LEVEL_RAD * max(1.0, s.lost_s / PATIENCE_S)
        unlikely = s.spins == 1 or (s.by_gps == 0 and s.pull_mps2 > PULLED_MPS2)
        return level_found and not (unlikely and s.lost_s < PATIENCE_S)
    doubted = is_contradicted(s, q_nb, level_told, heading_told)
    s.doubt_s = s.doubt_s + dt if doubted else 0.0
    return s.doubt_s > (DOUBT_S if s.by_gps == 1 else DOUBT_GRAVITY_S)


@compiled
def flown_level_rad(s: ReviewState) -> float:
    """Return how far a flight may pull the mean force of the pairs from gravity, rad.

    However long it pulls, its velocity v changes by 2 v at most, from one way to the opposite one:
    so over T the mean pull is 2 v / T at most, and gravity g with it leans by asin(2 v / (g T)).
    """
    share = 2.0 * s.flown_mps / (STANDARD_GRAVITY_MPS2 * max(s.gathered_s, GRAVITY_PAIR_S))
    return math.asin(share) if share < 1.0 else math.pi


@compiled
def is_contradicted(s: ReviewState, q_nb: Quat, level_told: float, heading_told: float) -> bool:
    """Return whether the alignment and the attitude cannot both be right."""
    found = as_quat(s.found_q_nb)
    allowed = DOUBT_SIGMA * math.hypot(s.level_std, level_told)
    off = level_difference(found, q_nb)
    if s.by_gps == 0:
        allowed = max(DOUBT_GRAVITY_RAD, allowed, flown_level_rad(s))
        return bool(off > allowed and s.pull_mps2 == 0.0)
    if off > max(DOUBT_LEVEL_RAD, allowed):
        return True
    if s.heading_known == 0:
        return False
    allowed = DOUBT_SIGMA * math.hypot(s.heading_std, heading_told)
    turned = abs(heading_difference(found, q_nb))
    return bool(s.heading_std < FOUND_HEADING_RAD and turned > max(DOUBT_HEADING_RAD, allowed))
