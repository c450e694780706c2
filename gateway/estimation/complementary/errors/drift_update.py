"""One measurement of the Kalman filter in `drift`: the update, and what widens an expectation."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    COMPASS,
    FORCE,
    HEADING,
    IRON,
    SCALE,
    SPEED,
    STATES,
    TILT,
    ComplementaryGains,
    ComplementaryState,
    states_in_use,
)
from gateway.estimation.filtering.bias_evidence import note_bias_correction
from gateway.estimation.filtering.uncalibrated import largest_accel_bias
from gateway.estimation.kernel_record import FloatArray, as_quat, write_quat
from gateway.geometry.angle import wrap_pi
from gateway.geometry.quaternion import from_rotation_vector, multiply, normalise

SCALE_LIMIT: Final = 0.1
"""The scale of a gyroscope is at most this."""
UNCLIPPED: Final = 1e9
"""An innovation of so many standard deviations counts whole."""
OUTLIER_SIGMA: Final = 3.0
"""What is further off than so many of them counts for less than it tells."""


@compiled
def cleared_row(s: ComplementaryState) -> FloatArray:
    """Return the row of a measurement, all zero, to be filled."""
    for k in range(STATES):
        s.drift_row[k] = 0.0
    return s.drift_row


@compiled
def correct_drift(
    s: ComplementaryState,
    p: ComplementaryGains,
    innovation: float,
    variance: float,
    clip: float,
    count: int,
) -> None:
    """Update the states by one scalar measurement.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place; its covariance has been carried on, `drift_row` holds the measurement's
        derivatives by the states.
    p : ComplementaryGains
        Constants.
    innovation : float
        Measured less expected value.
    variance : float
        Of the measurement.
    clip : float
        An innovation counts up to so many of its standard deviations.
    count : int
        The first so many states are corrected, `SCALE` or `SPEED`, without GPS `IRON`; what follows
        is considered.
    """
    if not math.isfinite(innovation):
        return
    if s.level_by_gps == 0:
        count = IRON
    spread = variance + expected_variance(s)
    reduce_covariance(s, spread, count)
    std = math.sqrt(spread)
    off = max(-clip, min(clip, innovation / std))
    if s.iron_doubted == 0 or not is_of_field(s):
        for k in range(3):
            note_bias_correction(s, k, off, s.drift_gain[k] / std)
    apply_gain(s, p, off / std, count)


@compiled
def is_of_field(s: ComplementaryState) -> bool:
    """Return whether the measurement in `drift_row` is one of the compass."""
    row = s.drift_row
    return bool(row[IRON] != 0.0 or row[IRON + 1] != 0.0 or row[IRON + 2] != 0.0)


@compiled
def expected_variance(s: ComplementaryState) -> float:
    """Return the variance of the expected measurement; fills `drift_gain` with `P h`."""
    P, gain, row, n = s.drift_cov, s.drift_gain, s.drift_row, states_in_use(s)
    for k in range(n):
        gain[k] = 0.0
    for j in range(n):
        if row[j] != 0.0:
            for k in range(n):
                gain[k] += P[j, k] * row[j]
    spread = 0.0
    for k in range(n):
        spread += row[k] * gain[k]
    return spread


@compiled
def push_state(s: ComplementaryState, k: int, dt: float) -> None:
    """Let state `k` change for `dt` seconds at the rate whose derivatives stand in `drift_row`."""
    P, gain = s.drift_cov, s.drift_gain
    pushed_sq = dt * dt * expected_variance(s)
    for j in range(STATES):
        P[k, j] += dt * gain[j]
    for j in range(STATES):
        P[j, k] = P[k, j]
    P[k, k] += dt * gain[k] + pushed_sq


@compiled
def reduce_covariance(s: ComplementaryState, spread: float, count: int) -> None:
    """Reduce the covariance after a measurement whose innovation has the variance `spread`.

    That of the states from `count` on with one another stays.
    """
    P, gain, n = s.drift_cov, s.drift_gain, states_in_use(s)
    for k in range(n):
        share = gain[k] / spread
        for j in range(min(k + 1, count)):
            P[k, j] -= share * gain[j]
            P[j, k] = P[k, j]
        P[k, k] = max(P[k, k], 0.0)


@compiled
def apply_gain(s: ComplementaryState, p: ComplementaryGains, share: float, count: int) -> None:
    """Correct the first `count` states by a multiple of `drift_gain`."""
    gain, limit = s.drift_gain, p.bias_limit_radps
    for k in range(3):
        s.bias_b[k] = max(-limit, min(limit, s.bias_b[k] + gain[k] * share))
    s.heading_rad = wrap_pi(s.heading_rad + gain[HEADING] * share)
    s.compass_rad += gain[COMPASS] * share
    if count > IRON:
        for k in range(3):
            s.iron_b[k] += gain[IRON + k] * share
    if s.level_by_gps == 0:
        return
    most = largest_accel_bias(s)
    for k in range(3):
        force = s.accel_bias_b[k] + gain[FORCE + k] * share
        s.accel_bias_b[k] = max(-most, min(most, force))
        if count == SPEED:
            scale = s.scale_b[k] + gain[SCALE + k] * share
            s.scale_b[k] = max(-SCALE_LIMIT, min(SCALE_LIMIT, scale))
    turn = from_rotation_vector((gain[TILT] * share, gain[TILT + 1] * share, 0.0))
    write_quat(s.q_ei, normalise(multiply(turn, as_quat(s.q_ei))))


@compiled
def widen_prior(s: ComplementaryState, k: int, expected: float, variance: float) -> float:
    """Let state `k` have been expected within a variance that is more than it was.

    Parameters
    ----------
    s : ComplementaryState
        Its covariance has been carried on; `drift_gain` then holds the column of the state.
    k : int
        The state.
    expected, variance : float
        The variance that it was expected within, and that it is to be.

    Returns
    -------
    float
        Less than 0: the covariance has grown by `drift_gain drift_gain^T` over minus this. 0 where
        nothing was certain by the expectation.
    """
    cleared_row(s)[k] = 1.0
    expected_variance(s)
    excess = float(s.drift_cov[k, k] - expected * (variance / (variance - expected)))
    if excess >= 0.0:
        return 0.0
    reduce_covariance(s, excess, SCALE)
    return excess
