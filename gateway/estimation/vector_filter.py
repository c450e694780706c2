"""The paper's filters on vectors: second-order low-pass and first-order high-pass.

A filter starts as if all earlier samples were equal to the first one, so it has no transient.
"""

import math
from typing import Any, Final, Literal

from gateway.compiled import compiled
from gateway.records import Vec3

Kind = Literal["butterworth", "chebyshev"]
Coefficients = tuple[float, float, float, float, float]
"""`b0, b1, b2, a1, a2` of the difference equation, with `a0 = 1`."""

PASS_THROUGH: Final[Coefficients] = (1.0, 0.0, 0.0, 0.0, 0.0)


def prototype_of(kind: Kind, ripple_db: float) -> tuple[float, float]:
    """Return damping and `w0^2` of the analogue prototype `w0^2 / (s^2 + damping s + w0^2)`.

    Its cutoff is 1 rad/s.
    """
    if kind == "butterworth":
        return math.sqrt(2.0), 1.0
    mu = 0.5 * math.asinh(1.0 / math.sqrt(10.0 ** (0.1 * ripple_db) - 1.0))
    return math.sqrt(2.0) * math.sinh(mu), 0.5 * math.cosh(2.0 * mu)


@compiled
def discretise(damping: float, w0_sq: float, cutoff_hz: float, rate_hz: float) -> Coefficients:
    """Apply the bilinear transform to a prototype: eq. 17 and 18 for Butterworth.

    Deviation: it is scaled to unit gain at 0 Hz, because the even order of Chebyshev would
    otherwise reduce gravity by the ripple. A cutoff beyond half the sample rate disables the
    filter.
    """
    if cutoff_hz >= 0.5 * rate_hz:
        return PASS_THROUGH
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    stiff = w0_sq * k * k
    norm = 1.0 / (1.0 + damping * k + stiff)
    b0 = stiff * norm
    return (b0, 2.0 * b0, b0, 2.0 * (stiff - 1.0) * norm, (1.0 - damping * k + stiff) * norm)


@compiled
def design_highpass(cutoff_hz: float, rate_hz: float) -> Coefficients:
    """Design a first-order high-pass; a cutoff of 0 Hz disables it."""
    if not 1e-6 < cutoff_hz < 0.5 * rate_hz:
        return PASS_THROUGH
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    b0 = 1.0 / (1.0 + k)
    return (b0, -b0, 0.0, (k - 1.0) * b0, 0.0)


@compiled
def filter_step(c: Coefficients, z: Any, x: Vec3) -> Vec3:
    """Filter one finite vector in transposed direct form II.

    `z` are two delays for each axis, which are updated; NaN before the first sample.
    """
    if c == PASS_THROUGH:
        return x
    b0, b1, b2, a1, a2 = c
    if math.isnan(z[0]):
        gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
        for k in range(3):
            z[2 * k], z[2 * k + 1] = (gain - b0) * x[k], (b2 - a2 * gain) * x[k]
    y = (b0 * x[0] + z[0], b0 * x[1] + z[2], b0 * x[2] + z[4])
    for k in range(3):
        z[2 * k] = b1 * x[k] - a1 * y[k] + z[2 * k + 1]
        z[2 * k + 1] = b2 * x[k] - a2 * y[k]
    return y
