"""What the pairs of the alignment say of a heading that nothing else tells, and how surely.

In a level frame of unknown heading, GPS tells the same changes of velocity that the accelerometer
has felt, turned: `r = turn(f - c - d t) + noise`. The constant `c` is the level's error, which may
be any; the ramp `d t` is what the gyroscope's bias makes of it, as large as that may be. With both
taken out, the sum of the products of `r` and `f` is a complex number: its angle is the heading,
its size over the noise the concentration of the heading's von Mises distribution [1]_. Noise of one
sensor has no like in the other and is no evidence, however long it adds up; how much there is of it
shows in what the turn leaves unexplained, best of all at rest, where all of `r` is noise.

References
----------
.. [1] K. V. Mardia and P. E. Jupp, "Directional Statistics", 2000, section 3.5.4.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.wahba import UNKNOWN_RAD, AlignmentState, drift_variance
from gateway.estimation.kernel_record import FloatArray
from gateway.geometry.quaternion import rotate_inverse
from gateway.records import Quat, Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

FITTED_PAIRS: Final = 3.0
"""The constant, the ramp and the noise itself are told by as many pairs; more tell the heading."""
LEAST_PAIRS: Final = FITTED_PAIRS + 1.0
LEAST_BIAS_RADPS: Final = 1e-4
"""No bias is known better than this."""


@compiled
def heading_evidence(s: AlignmentState, q_ni: Quat, bias_radps: float) -> tuple[float, float]:
    """Tell the heading by the pairs of GPS velocities, and learn the noise of these.

    Parameters
    ----------
    s : AlignmentState
        `noise_excess` is changed.
    q_ni : tuple of 4 floats
        A solution of the alignment; its level counts, its heading may be any.
    bias_radps : float
        Standard deviation of the gyroscope's bias.

    Returns
    -------
    turn_rad : float
        By which to turn the solution about down.
    std_rad : float
        Standard deviation of its heading then; `UNKNOWN_RAD` at most.
    """
    if s.pairs < LEAST_PAIRS:
        return (0.0, UNKNOWN_RAD)
    ramp = STANDARD_GRAVITY_MPS2 * max(bias_radps, LEAST_BIAS_RADPS)
    along, across, squares = level_products(s, q_ni, 1.0 / (ramp * ramp))
    size = math.hypot(along, across)
    # Two numbers a pair; the fewer there are, the wider is the distribution of what they estimate.
    s.noise_excess = max(1.0, (squares - 2.0 * size) / (2.0 * (s.pairs - FITTED_PAIRS)))
    variance = s.noise_excess / max(size, 1e-9) + drift_variance(s)
    return (math.atan2(across, along), math.sqrt(min(variance, UNKNOWN_RAD * UNKNOWN_RAD)))


@compiled
def level_products(
    s: AlignmentState, q_ni: Quat, ramp_information: float
) -> tuple[float, float, float]:
    """Sum the products of the level parts of reference and force, without constant and ramp.

    Parameters
    ----------
    s : AlignmentState
        Unchanged.
    q_ni : tuple of 4 floats
        What the forces are turned by.
    ramp_information : float
        Inverse of the variance of the ramp's slope, s2/(m/s2)2.

    Returns
    -------
    tuple of 3 floats
        What both share as they lie, what they share a quarter turn apart, and the sum of the
        squares of both.
    """
    R, w = s.reference_sums, ramp_information
    x, y = rotate_inverse(q_ni, (1.0, 0.0, 0.0)), rotate_inverse(q_ni, (0.0, 1.0, 0.0))
    north, east = (R[0], R[2]), (R[1], R[3])
    ahead, right = force_sums_along(s.force_sums, x), force_sums_along(s.force_sums, y)
    along = -explained(s, north, ahead, w) - explained(s, east, right, w)
    across = -explained(s, east, ahead, w) + explained(s, north, right, w)
    squares = s.information[2, 2] - explained(s, north, north, w) - explained(s, east, east, w)
    squares -= explained(s, ahead, ahead, w) + explained(s, right, right, w)
    for j in range(3):
        along += s.outer[0, j] * x[j] + s.outer[1, j] * y[j]
        across += s.outer[1, j] * x[j] - s.outer[0, j] * y[j]
        for i in range(3):
            squares += s.force_squares[i, j] * (x[i] * x[j] + y[i] * y[j])
    return (along, across, squares)


@compiled
def force_sums_along(sums: FloatArray, axis: Vec3) -> tuple[float, float]:
    """Return the sums of the force along an axis: alone, and by the time."""
    return (
        sums[0] * axis[0] + sums[1] * axis[1] + sums[2] * axis[2],
        sums[3] * axis[0] + sums[4] * axis[1] + sums[5] * axis[2],
    )


@compiled
def explained(
    s: AlignmentState, a: tuple[float, float], b: tuple[float, float], ramp_information: float
) -> float:
    """Return what a constant and a ramp explain of a sum of products of two numbers.

    Both are given by their own sums, alone and by the time.
    """
    one, time, square = s.weight_sums[0], s.weight_sums[1], s.weight_sums[2] + ramp_information
    constant = a[0] * (square * b[0] - time * b[1])
    ramp = a[1] * (one * b[1] - time * b[0])
    return float((constant + ramp) / (one * square - time * time))
