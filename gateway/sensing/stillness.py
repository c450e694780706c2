"""When a node lay still, so that a pose and a gyroscope bias may be measured.

A quiet sensor is not enough. In a steady turn the gyroscope is as quiet as on a table, and its
mean is the turn rate; but then the magnetic field turns, and GPS shows the movement.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.sensing.solvers import CalibrationError, FloatArray, NodeSamples
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

STILL_S: Final = 1.0
STILL_GYRO_RADPS: Final = 0.02
STILL_ACCEL_MPS2: Final = 0.3
"""Greatest standard deviation of an axis within a still window: ten times the MPU6050's noise."""
MIN_WINDOW_SAMPLES: Final = 5

MAX_GYRO_BIAS_RADPS: Final = 20.0 * RAD_PER_DEG
"""The MPU6050's limit of its bias: a larger rate is a rotation."""
MAX_FORCE_OFF_MPS2: Final = 1.5
"""At rest the specific force is gravity, bias and scale of a sensor never calibrated aside."""
REST_WINDOWS: Final = 3
"""This many still windows in a row are a rest: in fewer a slow turn cannot be detected."""
MAX_FIELD_DRIFT_UTPS: Final = 0.2
"""The field of a node that turns by 0.6 deg/s at mid latitudes; noise makes a third of it."""
MIN_FIELD_SAMPLES: Final = 20
MAX_RESTS_APART_RADPS: Final = 0.02
"""Rests of one log are this much alike, unless one of them was a turn."""

NOT_STILL: Final = "the node did not lie still: lay it down and do not touch it"


def still_windows(samples: NodeSamples) -> list[slice]:
    """Find the spans of a log in which the node lay still."""
    time_s = samples.time_s
    if len(time_s) == 0:
        return []
    edges = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], STILL_S))
    windows = [slice(*pair) for pair in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    return [window for window in windows if _is_still(samples, window)]


def rest_spans(samples: NodeSamples) -> list[slice]:
    """Find the spans in which the node lay still and did not turn either."""
    spans = []
    for run in _runs(still_windows(samples)):
        for begin in range(0, len(run) - REST_WINDOWS + 1, REST_WINDOWS):
            last = len(run) if len(run) - begin < 2 * REST_WINDOWS else begin + REST_WINDOWS
            span = slice(run[begin].start, run[last - 1].stop)
            if not _turns(samples, span):
                spans.append(span)
    return spans


def gyro_at_rest(samples: NodeSamples) -> FloatArray:
    """Return the gyroscope's samples at rest, which show only its bias.

    Parameters
    ----------
    samples : NodeSamples

    Returns
    -------
    ndarray, shape (n, 3)
        rad/s, sensor axes.

    Raises
    ------
    CalibrationError
        If there was no rest, or if what seems to be rests contradict each other.
    """
    spans = rest_spans(samples)
    if not spans:
        raise CalibrationError(f"no {REST_WINDOWS * STILL_S:.0f} s of rest: {NOT_STILL}")
    means = np.array([samples.gyro[span].mean(axis=0) for span in spans])
    apart = float(np.ptp(means, axis=0).max())
    if apart > MAX_RESTS_APART_RADPS:
        raise CalibrationError(
            f"what seems to be {len(spans)} rests is {apart / RAD_PER_DEG:.1f} deg/s apart: the "
            "node turned steadily in some of them; calibrate from a recording on the ground"
        )
    return np.vstack([samples.gyro[span] for span in spans])


def _is_still(samples: NodeSamples, window: slice) -> bool:
    gyro, accel = samples.gyro[window], samples.accel[window]
    if len(gyro) < MIN_WINDOW_SAMPLES or samples.moving[window].any():
        return False
    quiet = gyro.std(axis=0).max() < STILL_GYRO_RADPS
    if not quiet or accel.std(axis=0).max() >= STILL_ACCEL_MPS2:
        return False
    force_mps2 = float(np.linalg.norm(accel.mean(axis=0)))
    slow = np.abs(gyro.mean(axis=0)).max() <= MAX_GYRO_BIAS_RADPS
    return bool(slow and abs(force_mps2 - STANDARD_GRAVITY_MPS2) <= MAX_FORCE_OFF_MPS2)


def _runs(windows: list[slice]) -> list[list[slice]]:
    """Join windows that follow one another."""
    runs: list[list[slice]] = []
    for window in windows:
        if runs and runs[-1][-1].stop == window.start:
            runs[-1].append(window)
        else:
            runs.append([window])
    return runs


def _turns(samples: NodeSamples, span: slice) -> bool:
    """Return whether the field turned; False without a magnetometer."""
    begin_s, end_s = samples.time_s[span.start], samples.time_s[span.stop - 1]
    within: NDArray[np.bool_] = (samples.mag_time_s >= begin_s) & (samples.mag_time_s <= end_s)
    if int(within.sum()) < MIN_FIELD_SAMPLES:
        return False
    slope = np.polyfit(samples.mag_time_s[within] - begin_s, samples.mag[within], 1)[0]
    return float(np.linalg.norm(slope)) > MAX_FIELD_DRIFT_UTPS
