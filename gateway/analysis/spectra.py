"""Noise by frequency and by averaging time: power spectrum and Allan deviation."""

from typing import Final

import numpy as np
from scipy import signal

from gateway.analysis.flight_arrays import FloatArray

SEGMENT_S: Final = 8.0
ALLAN_POINTS: Final = 40
MIN_CLUSTERS: Final = 4
"""With fewer averages the deviation is a guess."""
REST_GYRO_RADPS: Final = 0.02
REST_ACCEL_MPS2: Final = 0.15
"""Greatest standard deviation within a second at rest."""


def power_density(x: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Estimate the one-sided power spectral density by Welch's method.

    Parameters
    ----------
    x : ndarray, shape (N, 3)
        A signal sampled evenly.
    rate_hz : float
        Sample rate.

    Returns
    -------
    frequency_hz : ndarray, shape (M,)
        Without 0 Hz.
    density : ndarray, shape (M, 3)
        Unit of x squared per Hz.
    """
    size = min(len(x), round(SEGMENT_S * rate_hz))
    frequency, density = signal.welch(np.nan_to_num(x), rate_hz, nperseg=size, axis=0)
    return frequency[1:], density[1:]


def allan_deviation(x: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Compute the overlapping Allan deviation of a rate.

    Parameters
    ----------
    x : ndarray, shape (N, 3)
        A rate sampled evenly, such as an angular rate at rest.
    rate_hz : float
        Sample rate.

    Returns
    -------
    tau_s : ndarray, shape (M,)
        Averaging times.
    deviation : ndarray, shape (M, 3)
        Unit of x.

    References
    ----------
    .. [1] IEEE Std 952-1997, annex C.
    """
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
    """Find the longest stretch in which the sensors measure only noise.

    Parameters
    ----------
    accel_b_mps2, gyro_b_radps : ndarray, shape (N, 3)
        Specific force and angular rate.
    rate_hz : float
        Sample rate.

    Returns
    -------
    slice
        Empty if there is no rest.
    """
    window = max(round(rate_hz), 2)
    if len(gyro_b_radps) < window:
        return slice(0, 0)
    calm = (_spread(gyro_b_radps, window) < REST_GYRO_RADPS) & (
        _spread(accel_b_mps2, window) < REST_ACCEL_MPS2
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], calm, [False]]).astype(np.int8)))
    if not len(edges):
        return slice(0, 0)
    begins, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - begins))
    # The last window may already hold the slow start of a motion.
    return slice(int(begins[best]), int(ends[best]))


def _spread(x: FloatArray, window: int) -> FloatArray:
    """Greatest standard deviation of the three axes in each window of samples."""
    x = np.nan_to_num(x - np.nanmean(x, axis=0))
    first = np.cumsum(np.vstack([np.zeros(x.shape[1]), x]), axis=0)
    second = np.cumsum(np.vstack([np.zeros(x.shape[1]), x * x]), axis=0)
    mean = (first[window:] - first[:-window]) / window
    power = (second[window:] - second[:-window]) / window
    return np.asarray(np.sqrt(np.maximum(power - mean * mean, 0.0)).max(axis=1))
