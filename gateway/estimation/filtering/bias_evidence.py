"""Whether the gyroscope's bias changes faster than it is expected to.

A filter corrects the bias a little at each measurement. While its model is right, such corrections
are white: their sum has the sum of their variances, and each has the variance that it takes off the
covariance [1]_. A bias that jumps, or drifts as a sensor warms up, is corrected one way again and
again. What the sum has beyond chance is then the noise by which the bias walks.

It is asked with GPS alone: without it, what pulls in a turn corrects one way as well. Nor does
`complementary` ask it of a compass whose iron has shown itself, which does the same.

References
----------
.. [1] R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE
   Transactions on Automatic Control 15, 1970.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, fill

MEMORY_S: Final = 20.0
"""Corrections are summed over about this time."""
CHANCE_SQ: Final = 6.0
"""A sum whose square is so many times its variance is chance."""
RAISED_S: Final = 0.3
"""What is beyond chance comes to the variance of the bias in this time."""
SETTLED_S: Final = 20.0
"""An attitude that was found just now may be further off than it is told, and blames the bias."""


class BiasEvidenceState:
    """What the bias was corrected by of late, along the body's axes."""

    sound_s: float
    """For how long the IMU has been sound: a turn that it did not see is none of the bias."""
    bias_corrected: Annotated[FloatArray, (3,)]
    """Sum of the corrections, rad/s; it fades."""
    bias_corrected_var: Annotated[FloatArray, (3,)]
    """The variance that it should have, (rad/s)2."""
    bias_watched_s: float
    """For how long the attitude has been known, up to `SETTLED_S`."""


@compiled
def note_bias_correction(s: BiasEvidenceState, k: int, share: float, column: float) -> None:
    """Add what one measurement corrects.

    Parameters
    ----------
    s : BiasEvidenceState
        Changed in place.
    k : int
        Axis of the body.
    share : float
        Innovation over its standard deviation, clipped as in the update.
    column : float
        Covariance of the bias with the innovation, over the same standard deviation, rad/s.
    """
    s.bias_corrected[k] += column * share
    s.bias_corrected_var[k] += column * column


@compiled
def unexpected_bias_density(s: BiasEvidenceState, k: int) -> float:
    """Return the density of the noise by which an axis of the bias walks, (rad/s)2/s."""
    beyond = s.bias_corrected[k] ** 2 / CHANCE_SQ - s.bias_corrected_var[k]
    return float(max(beyond, 0.0) / RAISED_S)


@compiled
def watch_bias_corrections(s: BiasEvidenceState, known: bool, dt: float) -> None:
    """Let the sums fade; they begin anew while the errors that correct the bias are not `known`."""
    s.bias_watched_s = min(s.bias_watched_s + dt, SETTLED_S) if known else 0.0
    if min(s.bias_watched_s, s.sound_s) < SETTLED_S:
        fill(s.bias_corrected, 0.0)
        fill(s.bias_corrected_var, 0.0)
        return
    kept = math.exp(-dt / MEMORY_S)
    for k in range(3):
        s.bias_corrected[k] *= kept
        s.bias_corrected_var[k] *= kept * kept
