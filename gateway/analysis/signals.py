"""Properties of signals: the two low-passes of the paper, power spectrum and Allan deviation."""

import math
import timeit
from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from gateway.analysis.flight import FloatArray
from gateway.estimation.paper import PaperSettings
from gateway.estimation.vector_filter import (
    Coefficients,
    Kind,
    discretise,
    filter_step,
    prototype_of,
)

if TYPE_CHECKING:
    import pandas as pd

KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
PAPER_RATE_HZ: Final = 1000.0
"""Sample rate in the paper's figures, whose filters have order 2 and a cutoff of 10 Hz."""
RESPONSE_POINTS: Final = 400
STEP_S: Final = 0.5
TIMED_SAMPLES: Final = 5_000
TIMED_RUNS: Final = 3
SEGMENT_S: Final = 8.0
ALLAN_POINTS: Final = 40
MIN_CLUSTERS: Final = 4
"""Minimum number of averages; with fewer, the Allan deviation is too uncertain."""
REST_GYRO_RADPS: Final = 0.02
REST_ACCEL_MPS2: Final = 0.15
"""Maximum standard deviation within a second at rest."""


def filtered(
    coefficients: Coefficients, x: FloatArray, state: list[float] | None = None
) -> FloatArray:
    """Filter an array of shape (n, 3) sample by sample, as the gateway does; see `filter_step`."""
    state = [math.nan] * 6 if state is None else state
    rows = [filter_step(coefficients, state, (v[0], v[1], v[2])) for v in x.tolist()]
    return np.array(rows).reshape(-1, 3)


def response(kind: Kind, settings: PaperSettings, rate_hz: float) -> tuple[FloatArray, ...]:
    """Compute the response from a hundredth of the cutoff to half the sample rate.

    Returns frequencies in Hz, gains in dB, phases in deg and group delays in ms.
    """
    from scipy import signal

    *b, a1, a2 = _design(kind, settings, rate_hz)
    a = [1.0, a1, a2]
    low_hz = 0.01 * settings.accel_cutoff_hz
    frequency = np.geomspace(low_hz, 0.499 * rate_hz, RESPONSE_POINTS)
    _, h = signal.freqz(b, a, frequency, fs=rate_hz)
    _, delay = signal.group_delay((b, a), frequency, fs=rate_hz)
    gain_db = 20.0 * np.log10(np.maximum(np.abs(h), 1e-12))
    return frequency, gain_db, np.degrees(np.unwrap(np.angle(h))), 1e3 * delay / rate_hz


def apply(kind: Kind, settings: PaperSettings, rate_hz: float, x: FloatArray) -> FloatArray:
    """Filter an array of shape (N, 3) with the low-pass of the settings."""
    return filtered(_design(kind, settings, rate_hz), np.where(np.isfinite(x), x, 0.0))


def _design(kind: Kind, settings: PaperSettings, rate_hz: float) -> Coefficients:
    prototype = prototype_of(kind, settings.chebyshev_ripple_db)
    return discretise(*prototype, settings.accel_cutoff_hz, rate_hz)


def compare(settings: PaperSettings, rate_hz: float) -> "pd.DataFrame":
    """Return a table of the filters' properties."""
    import pandas as pd

    return pd.DataFrame([_properties(kind, settings, rate_hz) for kind in KINDS])


def _properties(kind: Kind, settings: PaperSettings, rate_hz: float) -> dict[str, object]:
    frequency_hz, gain_db, _, delay_ms = response(kind, settings, rate_hz)
    cutoff = settings.accel_cutoff_hz
    passed = gain_db[frequency_hz <= cutoff]
    # The Butterworth gain decreases monotonically, so only a later increase is ripple.
    ripple_db = float(np.max(np.maximum.accumulate(passed[::-1])[::-1] - passed[0]))
    steps = np.ones((round(STEP_S * rate_hz), 3))
    steps[0] = 0.0
    risen = apply(kind, settings, rate_hz, steps)[:, 0]
    return {
        "filter": kind,
        "ripple, dB": max(ripple_db, 0.0),
        "gain at cutoff, dB": float(np.interp(cutoff, frequency_hz, gain_db)),
        "gain at 3 x cutoff, dB": float(np.interp(3 * cutoff, frequency_hz, gain_db)),
        "delay at 0 Hz, ms": float(delay_ms[0]),
        "greatest delay, ms": float(delay_ms.max()),
        "step overshoot, %": 100.0 * float(risen.max() - 1.0),
        "time a sample, ns": _time_ns(kind, settings, rate_hz),
    }


def _time_ns(kind: Kind, settings: PaperSettings, rate_hz: float) -> float:
    """Measure the time per sample on three axes, best of several runs."""
    x, coefficients = np.zeros((TIMED_SAMPLES, 3)), _design(kind, settings, rate_hz)
    seconds = timeit.repeat(lambda: filtered(coefficients, x), number=1, repeat=TIMED_RUNS)
    return 1e9 / TIMED_SAMPLES * min(seconds)


def power_density(x: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Estimate the one-sided power spectral density by Welch's method; frequencies without 0 Hz."""
    from scipy import signal

    size = min(len(x), round(SEGMENT_S * rate_hz))
    frequency, density = signal.welch(np.nan_to_num(x), rate_hz, nperseg=size, axis=0)
    return frequency[1:], density[1:]


def allan_deviation(x: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Compute averaging times and overlapping Allan deviations (IEEE Std 952-1997, annex C)."""
    longest = len(x) // MIN_CLUSTERS
    if longest < 1:
        return np.empty(0), np.empty((0, 3))
    sizes = np.unique(np.geomspace(1, longest, ALLAN_POINTS).round().astype(np.int64))
    total = np.vstack([np.zeros(x.shape[1]), np.cumsum(x - x.mean(axis=0), axis=0)])
    deviations = []
    for m in sizes.tolist():
        change = (total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]) / m
        deviations.append(np.sqrt(0.5 * np.mean(np.square(change), axis=0)))
    return sizes / rate_hz, np.array(deviations)


def longest_rest(accel_b_mps2: FloatArray, gyro_b_radps: FloatArray, rate_hz: float) -> slice:
    """Return the longest part in which the sensors measure only noise."""
    window = max(round(rate_hz), 2)
    if len(gyro_b_radps) < window:
        return slice(0, 0)
    calm = (spread(gyro_b_radps, window) < REST_GYRO_RADPS) & (
        spread(accel_b_mps2, window) < REST_ACCEL_MPS2
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], calm, [False]]).astype(np.int8)))
    if not len(edges):
        return slice(0, 0)
    begins, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - begins))
    # The last window may already contain the slow start of a motion.
    return slice(int(begins[best]), int(ends[best]))


def spread(x: FloatArray, window: int) -> FloatArray:
    """Return the greatest standard deviation of all axes in each window of samples."""
    x = np.nan_to_num(x - np.nanmean(x, axis=0))
    first = np.cumsum(np.vstack([np.zeros(x.shape[1]), x]), axis=0)
    second = np.cumsum(np.vstack([np.zeros(x.shape[1]), x * x]), axis=0)
    mean = (first[window:] - first[:-window]) / window
    power = (second[window:] - second[:-window]) / window
    return np.asarray(np.sqrt(np.maximum(power - mean * mean, 0.0)).max(axis=1))
