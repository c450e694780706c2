"""The paper's filters on vectors of three: second-order low-pass and first-order high-pass.

One compiled step serves the live sample and the offline array, so both give the same bits. The
filters start as if the first sample had been constant for ever, so they have no start-up
transient.
"""

import math
from collections.abc import Callable
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import address_of, array_at, compiled
from gateway.compiled.entry_point import EntryPoint
from gateway.records import Vec3

FloatArray = NDArray[np.float64]
Kind = Literal["butterworth", "chebyshev"]
Coefficients = tuple[float, float, float, float, float]
"""`b0, b1, b2, a1, a2` of the difference equation, `a0` being 1."""
Delays = tuple[float, float, float, float, float, float]
"""The two delay elements of each axis, in transposed direct form II."""
FilterState = tuple[Delays, Vec3]
"""Delays and last output."""

PASS_THROUGH: Final[Coefficients] = (1.0, 0.0, 0.0, 0.0, 0.0)
"""A wire: what it is designed for keeps no delays and needs no arithmetic."""
_FLOAT: Final = np.dtype(np.float64)
NO_DELAYS: Final[Delays] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SLOWEST_HIGHPASS_HZ: Final = 1e-6
"""A time constant of 44 hours: a slower one makes no difference in any flight, while rounding
would put its pole on the unit circle, where its gain at 0 Hz is undefined."""


def design_lowpass(
    kind: Kind, cutoff_hz: float, rate_hz: float, ripple_db: float = 1.0
) -> Coefficients:
    """Design a second-order low-pass by the bilinear transform: eq. 17 and 18 for Butterworth.

    Parameters
    ----------
    kind : {"butterworth", "chebyshev"}
        Chebyshev is of type I; deviation: it is scaled to unit gain at 0 Hz, because its even
        order would otherwise shrink gravity by the ripple.
    cutoff_hz : float
        Edge of the pass band: -3 dB for Butterworth, the end of the ripple for Chebyshev.
    rate_hz : float
        Sample rate.
    ripple_db : float
        Ripple of the Chebyshev pass band.

    Returns
    -------
    tuple of 5 floats
        Coefficients; those of a pass-through if the cutoff is at or above half the sample rate.
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
    """Design a first-order high-pass; a cutoff of `SLOWEST_HIGHPASS_HZ` or less passes all.

    Parameters
    ----------
    cutoff_hz : float
        -3 dB frequency; the time constant is `1 / (2 pi cutoff_hz)`.
    rate_hz : float
        Sample rate.

    Returns
    -------
    tuple of 5 floats
        Coefficients.
    """
    if not SLOWEST_HIGHPASS_HZ < cutoff_hz < 0.5 * rate_hz:
        return PASS_THROUGH
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    b0 = 1.0 / (1.0 + k)
    return (b0, -b0, 0.0, (k - 1.0) * b0, 0.0)


def gain_at_rest(c: Coefficients) -> float:
    """Return the gain at 0 Hz."""
    return (c[0] + c[1] + c[2]) / (1.0 + c[3] + c[4])


@compiled
def settled(c: Coefficients, x: Vec3, y: Vec3) -> Delays:
    """Find the filter state at which a constant input `x` gives a constant output `y`."""
    b1, b2, a1, a2 = c[1], c[2], c[3], c[4]
    w0, w1, w2 = b2 * x[0] - a2 * y[0], b2 * x[1] - a2 * y[1], b2 * x[2] - a2 * y[2]
    return (
        b1 * x[0] - a1 * y[0] + w0,
        w0,
        b1 * x[1] - a1 * y[1] + w1,
        w1,
        b1 * x[2] - a1 * y[2] + w2,
        w2,
    )


@compiled
def step(c: Coefficients, z: Delays, x: Vec3) -> tuple[Vec3, Delays]:
    """Pass one sample through the filter."""
    b0, b1, b2, a1, a2 = c
    y0, y1, y2 = b0 * x[0] + z[0], b0 * x[1] + z[2], b0 * x[2] + z[4]
    delays = (
        b1 * x[0] - a1 * y0 + z[1],
        b2 * x[0] - a2 * y0,
        b1 * x[1] - a1 * y1 + z[3],
        b2 * x[1] - a2 * y1,
        b1 * x[2] - a1 * y2 + z[5],
        b2 * x[2] - a2 * y2,
    )
    return ((y0, y1, y2), delays)


@EntryPoint
def filter_rows(count: int, coefficients_at: int, delays_at: int, x_at: int, y_at: int) -> None:
    """Pass an array of shape (count, 3) through the filter; the delays are changed."""
    k, d = array_at(coefficients_at, (5,), _FLOAT), array_at(delays_at, (6,), _FLOAT)
    x, y = array_at(x_at, (count, 3), _FLOAT), array_at(y_at, (count, 3), _FLOAT)
    c, z = (k[0], k[1], k[2], k[3], k[4]), (d[0], d[1], d[2], d[3], d[4], d[5])
    for i in range(count):
        out, z = step(c, z, (x[i, 0], x[i, 1], x[i, 2]))
        y[i, 0], y[i, 1], y[i, 2] = out
    d[0], d[1], d[2], d[3], d[4], d[5] = z


def _last_input(c: Coefficients, z: Delays, y: Vec3) -> Vec3:
    """Return the input of a first-order filter that left these delays with this output."""
    b1, a1 = c[1], c[3]
    if b1 == 0.0:
        return y  # of a pass-through
    return ((z[0] + a1 * y[0]) / b1, (z[2] + a1 * y[1]) / b1, (z[4] + a1 * y[2]) / b1)


class VectorFilter:
    """One filter on three axes, fed one sample at a time or a whole array.

    Parameters
    ----------
    design : callable
        Coefficients for a sample rate in Hz.
    rate_hz : float
        Sample rate to begin with.
    """

    def __init__(self, design: Callable[[float], Coefficients], rate_hz: float) -> None:
        self._design = design
        self._coefficients = design(rate_hz)
        self.state: FilterState | None = None
        """None before the first sample. May be read and restored."""

    def reset(self) -> None:
        """Reset the filter: the next sample starts it again."""
        self.state = None

    def retune(self, rate_hz: float) -> None:
        """Redesign for another sample rate without a step in the output.

        Parameters
        ----------
        rate_hz : float
            The new rate.
        """
        before, self._coefficients = self._coefficients, self._design(rate_hz)
        if self.state is not None:
            y = self.state[1]
            gain = gain_at_rest(self._coefficients)
            if abs(gain) < 1e-9:
                x = _last_input(before, *self.state)
            else:
                x = (y[0] / gain, y[1] / gain, y[2] / gain)
            self.state = (settled(self._coefficients, x, y), y)

    def step(self, x: Vec3) -> Vec3:
        """Filter one sample.

        Parameters
        ----------
        x : tuple of 3 floats
            The newest sample, finite.

        Returns
        -------
        tuple of 3 floats
            The filtered sample.
        """
        if self._coefficients is PASS_THROUGH:
            self.state = (NO_DELAYS, x)
            return x
        y, delays = step(self._coefficients, self._delays(x), x)
        self.state = (delays, y)
        return y

    def run(self, x: FloatArray) -> FloatArray:
        """Filter an array; bit-identical to that many calls of `step`.

        Parameters
        ----------
        x : ndarray, shape (n, 3)
            Samples in their order.

        Returns
        -------
        ndarray, shape (n, 3)
            Filtered samples.
        """
        if not len(x):
            return x.copy()
        if self._coefficients is PASS_THROUGH:
            y, delays = x.copy(), NO_DELAYS
        else:
            y, delays = self._filter(np.ascontiguousarray(x, np.float64))
        self.state = (delays, (float(y[-1, 0]), float(y[-1, 1]), float(y[-1, 2])))
        return y

    def _filter(self, x: FloatArray) -> tuple[FloatArray, Delays]:
        y, state = np.empty_like(x), np.array(self._delays(x[0]))
        arrays = (np.array(self._coefficients), state, x, y)
        filter_rows(len(x), *map(address_of, arrays))
        a, b, c, d, e, f = state.tolist()
        return y, (a, b, c, d, e, f)

    def _delays(self, first: Vec3 | FloatArray) -> Delays:
        if self.state is not None:
            return self.state[0]
        x = (float(first[0]), float(first[1]), float(first[2]))
        gain = gain_at_rest(self._coefficients)
        return settled(self._coefficients, x, (x[0] * gain, x[1] * gain, x[2] * gain))
