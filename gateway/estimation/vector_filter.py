"""The paper's filters on vectors: second-order low-pass and first-order high-pass.

A filter starts as if its first sample had been constant for ever, so it has no transient.
"""

import math
from collections.abc import Callable
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gateway.records import Vec3

FloatArray = NDArray[np.float64]
Kind = Literal["butterworth", "chebyshev"]
Coefficients = tuple[float, float, float, float, float]
"""`b0, b1, b2, a1, a2` of the difference equation, with `a0 = 1`."""

PASS_THROUGH: Final[Coefficients] = (1.0, 0.0, 0.0, 0.0, 0.0)


def design_lowpass(
    kind: Kind, cutoff_hz: float, rate_hz: float, ripple_db: float = 1.0
) -> Coefficients:
    """Design a second-order low-pass by the bilinear transform: eq. 17 and 18 for Butterworth.

    Chebyshev is of type I, with its ripple in dB; deviation: it is scaled to unit gain at 0 Hz,
    because its even order would otherwise shrink gravity by the ripple. The cutoff in Hz is -3 dB
    for Butterworth and the end of the ripple for Chebyshev.
    """
    if cutoff_hz >= 0.5 * rate_hz:
        return PASS_THROUGH
    # Analogue prototype of cutoff 1 rad/s: w0^2 / (s^2 + damping s + w0^2).
    damping, w0_sq = math.sqrt(2.0), 1.0
    if kind == "chebyshev":
        mu = 0.5 * math.asinh(1.0 / math.sqrt(10.0 ** (0.1 * ripple_db) - 1.0))
        damping, w0_sq = math.sqrt(2.0) * math.sinh(mu), 0.5 * math.cosh(2.0 * mu)
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    stiff = w0_sq * k * k
    norm = 1.0 / (1.0 + damping * k + stiff)
    b0 = stiff * norm
    return (b0, 2.0 * b0, b0, 2.0 * (stiff - 1.0) * norm, (1.0 - damping * k + stiff) * norm)


def design_highpass(cutoff_hz: float, rate_hz: float) -> Coefficients:
    """Design a first-order high-pass; a cutoff of 0 Hz passes all."""
    if not 1e-6 < cutoff_hz < 0.5 * rate_hz:
        return PASS_THROUGH
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    b0 = 1.0 / (1.0 + k)
    return (b0, -b0, 0.0, (k - 1.0) * b0, 0.0)


class VectorFilter:
    """One filter on three axes, in transposed direct form II, designed for a sample rate in Hz."""

    def __init__(self, design: Callable[[float], Coefficients], rate_hz: float = 100.0) -> None:
        self._design = design
        self._coefficients = design(rate_hz)
        self.state: list[float] | None = None
        """Two delays for each axis; None before the first sample. May be read and restored."""

    def retune(self, rate_hz: float) -> None:
        """Redesign for another sample rate; the filter starts again at the next sample."""
        self._coefficients, self.state = self._design(rate_hz), None

    def step(self, x: Vec3) -> Vec3:
        """Filter one finite vector."""
        if self._coefficients == PASS_THROUGH:
            return x
        b0, b1, b2, a1, a2 = self._coefficients
        if self.state is None:
            gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
            self.state = [d for v in x for d in ((gain - b0) * v, (b2 - a2 * gain) * v)]
        z, y = self.state, [0.0, 0.0, 0.0]
        for k, v in enumerate(x):
            y[k] = b0 * v + z[2 * k]
            z[2 * k] = b1 * v - a1 * y[k] + z[2 * k + 1]
            z[2 * k + 1] = b2 * v - a2 * y[k]
        return (y[0], y[1], y[2])

    def run(self, x: FloatArray) -> FloatArray:
        """Filter an array of shape (n, 3), as that many calls of `step`."""
        return np.array([self.step((v[0], v[1], v[2])) for v in x.tolist()]).reshape(-1, 3)
