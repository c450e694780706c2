"""What the gyroscope drifts by and what that does to the heading: a Kalman filter of five states.

The gyroscope's bias in body FRD, the heading, and the compass's slow error, by iron and by the
place. That error is of some degrees, but it changes slowly: so a heading that walks away from the
compass tells the bias, long before the compass tells the heading; and what the GPS says of the
heading tells the compass's error. The level is not among the states; what it says of the bias
comes in by `bias`.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.kernel_record import as_quat
from gateway.geometry.quaternion import rotate_inverse, wrap_pi
from gateway.units import RAD_PER_DEG

HEADING: Final = 3
"""Turn about down from the level frame to NED; the three before are the bias."""
COMPASS: Final = 4
STATES: Final = 5
Row = tuple[float, float, float, float, float]

BIAS_WALK_RAD2PS3: Final = (0.1 * RAD_PER_DEG) ** 2 / 100.0
"""A drift of 0.1 deg/s in 100 s."""
HEADING_WALK_RAD2PS: Final = (0.1 * RAD_PER_DEG) ** 2
"""Of the gyroscope's noise."""
TURN_WALK_RAD: Final = 1e-5
"""Variance of the heading after a turn of 1 rad, by scale and axes of the gyroscope."""
KNOWN_BIAS_RADPS: Final = 0.1 * RAD_PER_DEG
LEVEL_HASTE_SPRAD: Final = 5.0 / RAD_PER_DEG
"""A bias less certain than that tilts the horizon, which then is levelled the faster."""
LEAST_LEVEL_S: Final = 2.0
"""Faster levelling would pass the noise of the GPS velocity."""
DOUBT: Final = 2.0
"""A bias that may have changed is believed so much less: what follows it is slower than it."""
UNKNOWN_VAR: Final = 10.0
"""Variance of a heading of which nothing is known, rad2."""
LEAST_VAR: Final = 1e-6
"""Rounding must not make a variance negative."""


@compiled
def begin_drift(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Set what is expected of a gyroscope and a compass that nothing is known of."""
    for k in range(3):
        s.drift_cov[k, k] = p.bias_initial_radps**2
    forget_heading(s, p)


@compiled
def forget_heading(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Know nothing of the heading, nor of the compass's error."""
    start_heading(s, s.heading_rad, UNKNOWN_VAR)
    for j in range(STATES):
        s.drift_cov[COMPASS, j] = s.drift_cov[j, COMPASS] = 0.0
    s.compass_rad = 0.0
    s.drift_cov[COMPASS, COMPASS] = p.heading_noise_rad**2


@compiled
def start_heading(s: ComplementaryState, heading_rad: float, variance: float) -> None:
    """Take a heading that has nothing to do with what was known."""
    for j in range(STATES):
        s.drift_cov[HEADING, j] = s.drift_cov[j, HEADING] = 0.0
    s.drift_cov[HEADING, HEADING] = variance
    s.heading_rad = wrap_pi(heading_rad)
    s.down_turn[0] = s.down_turn[1] = s.down_turn[2] = s.carried_s = s.carried_turn = 0.0


@compiled
def note_turn(s: ComplementaryState, dt: float) -> None:
    """Note how a bias turns the heading in one sample, and how far the aircraft turned."""
    down = rotate_inverse(as_quat(s.q_eb), (0.0, 0.0, 1.0))
    x, y, z = s.rate_b[0], s.rate_b[1], s.rate_b[2]
    for k in range(3):
        s.down_turn[k] += down[k] * dt
    s.carried_s += dt
    s.carried_turn += math.sqrt(x * x + y * y + z * z) * dt


@compiled
def carry_drift(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Carry the covariance on to now."""
    P, r = s.drift_cov, s.down_turn
    before = r[0] * P[HEADING, 0] + r[1] * P[HEADING, 1] + r[2] * P[HEADING, 2]
    for j in range(STATES):
        if j != HEADING:
            P[HEADING, j] -= r[0] * P[0, j] + r[1] * P[1, j] + r[2] * P[2, j]
            P[j, HEADING] = P[HEADING, j]
    after = r[0] * P[HEADING, 0] + r[1] * P[HEADING, 1] + r[2] * P[HEADING, 2]
    walked = HEADING_WALK_RAD2PS * s.carried_s + TURN_WALK_RAD * s.carried_turn
    variance = P[HEADING, HEADING] - before - after + walked
    P[HEADING, HEADING] = min(max(variance, LEAST_VAR), UNKNOWN_VAR)
    kept = math.exp(-s.carried_s / p.tau_heading_s)
    for j in range(STATES):
        P[COMPASS, j] *= kept
        P[j, COMPASS] *= kept
    P[COMPASS, COMPASS] += (1.0 - kept * kept) * p.heading_noise_rad**2
    s.compass_rad *= kept
    for k in range(3):
        P[k, k] = min(P[k, k] + BIAS_WALK_RAD2PS3 * s.carried_s, p.bias_initial_radps**2)
        r[k] = 0.0
    s.carried_s = s.carried_turn = 0.0


@compiled
def correct_drift(
    s: ComplementaryState, p: ComplementaryGains, row: Row, innovation: float, variance: float
) -> None:
    """Update the five states by one number.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place; its covariance has been carried on.
    p : ComplementaryGains
        Constants.
    row : tuple of 5 floats
        How the number depends on the states.
    innovation : float
        What was measured less what was expected.
    variance : float
        Of the measurement.
    """
    if not math.isfinite(innovation):
        return
    P, gain = s.drift_cov, s.drift_gain
    spread = variance
    for k in range(STATES):
        gain[k] = 0.0
        for j in range(STATES):
            gain[k] += P[k, j] * row[j]
    for k in range(STATES):
        spread += row[k] * gain[k]
    for k in range(STATES):
        for j in range(STATES):
            P[k, j] -= gain[k] * gain[j] / spread
    share, limit = innovation / spread, p.bias_limit_radps
    for k in range(3):
        s.bias_b[k] = max(-limit, min(limit, s.bias_b[k] + gain[k] * share))
    s.heading_rad = wrap_pi(s.heading_rad + gain[HEADING] * share)
    s.compass_rad += gain[COMPASS] * share
    for k in range(STATES):
        P[k, k] = max(P[k, k], LEAST_VAR * LEAST_VAR)


@compiled
def bias_std(s: ComplementaryState) -> float:
    """Return the standard deviation of the bias per axis, rad/s."""
    P = s.drift_cov
    return math.sqrt((P[0, 0] + P[1, 1] + P[2, 2]) / 3.0)


@compiled
def level_time_s(s: ComplementaryState, p: ComplementaryGains) -> float:
    """Return the time constant of gravity's low-pass with GPS: shorter while the bias is unknown.

    The horizon hangs behind by what the bias turns it in this time.
    """
    unknown = max(bias_std(s) - KNOWN_BIAS_RADPS, 0.0)
    shortest = min(p.tau_accel_gps_s, LEAST_LEVEL_S)
    return max(p.tau_accel_gps_s / (1.0 + LEVEL_HASTE_SPRAD * unknown), shortest)


@compiled
def heading_variance(s: ComplementaryState) -> float:
    """Return the heading's variance when it was carried on last, rad2."""
    return float(s.drift_cov[HEADING, HEADING])


@compiled
def raise_bias_variance(s: ComplementaryState, std: float) -> None:
    """Believe the bias no more firmly than to a standard deviation in rad/s."""
    for k in range(3):
        s.drift_cov[k, k] = max(s.drift_cov[k, k], std * std)


@compiled
def raise_heading_variance(s: ComplementaryState, std: float) -> None:
    """Make the heading less certain by a standard deviation in rad."""
    variance = s.drift_cov[HEADING, HEADING] + std * std
    s.drift_cov[HEADING, HEADING] = min(variance, UNKNOWN_VAR)
