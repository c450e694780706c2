"""Seeded noise for the sensors, independent of how it is divided into pieces.

Every source of noise owns its generator and carries its state, so drawing a flight at once or
second by second gives the same numbers, bit for bit.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

FloatArray = NDArray[np.float64]

AXES: Final = 3


class White:
    """Independent normal noise on three axes."""

    def __init__(self, rng: np.random.Generator, sigma: float) -> None:
        self._rng = rng
        self._sigma = sigma

    def draw(self, size: int) -> FloatArray:
        """Draw the next values, shape (size, 3)."""
        return self._sigma * self._rng.standard_normal((size, AXES))


class Wander:
    """First-order Gauss-Markov noise on three axes: `x' = retain * x + step`.

    Parameters
    ----------
    rng : numpy.random.Generator
    sigma : float
        Standard deviation in the long run.
    correlation_s : float
        Time after which 37 % of a value is left.
    interval_s : float
        Time between values.
    """

    def __init__(
        self, rng: np.random.Generator, sigma: float, correlation_s: float, interval_s: float
    ) -> None:
        self._rng = rng
        self._retain = math.exp(-interval_s / correlation_s)
        self._step = sigma * math.sqrt(1.0 - self._retain**2)
        self._last = sigma * rng.standard_normal(AXES)

    def draw(self, size: int) -> FloatArray:
        """Draw the next values, shape (size, 3)."""
        steps = self._step * self._rng.standard_normal((size, AXES))
        if size == 0:
            return steps
        start = (self._retain * self._last)[np.newaxis]
        values, _ = lfilter([1.0], [1.0, -self._retain], steps, axis=0, zi=start)
        self._last = values[-1]
        return np.asarray(values)


class Walk:
    """Random walk on three axes, starting at zero."""

    def __init__(
        self, rng: np.random.Generator, sigma_per_sqrt_s: float, interval_s: float
    ) -> None:
        self._rng = rng
        self._step = sigma_per_sqrt_s * math.sqrt(interval_s)
        self._last = np.zeros(AXES)

    def draw(self, size: int) -> FloatArray:
        """Draw the next values, shape (size, 3)."""
        steps = self._step * self._rng.standard_normal((size, AXES))
        values = np.cumsum(np.vstack([self._last, steps]), axis=0)
        self._last = values[-1]
        return values[1:]
