"""Errors of attitude and sensors: a Kalman filter of sixteen states, and of four that follow.

The gyroscope bias in body FRD, the heading, the slow error of the compass (soft iron, and the
place), the iron that it carries along, the tilt of the level frame, the accelerometer bias in body
FRD, and the scale of each axis of the gyroscope. The compass is wrong by some degrees, but that
error changes slowly: a heading that drifts away from the compass reveals the gyroscope bias long
before the compass corrects the heading, and a heading from GPS reveals the error of the compass.

Only GPS reveals the scale: iron turns the compass in step with each turn, as a wrong scale would.
To all other measurements it is only considered, the Schmidt-Kalman update: its gain is zero, its
uncertainty still counts.

Speed and place are blended by `navigation`, not estimated here; their errors follow from the
others, which push them, and are only considered.

While the low-pass of gravity levels the attitude, neither the iron nor the tilt nor the
accelerometer bias nor the scale is estimated; `bias` then corrects the gyroscope bias by what the
low-pass corrects.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    COMPASS,
    FORCE,
    HEADING,
    IRON,
    SCALE,
    STATES,
    TILT,
    ComplementaryGains,
    ComplementaryState,
    states_in_use,
)
from gateway.estimation.complementary.errors.compass_error import compass_variance
from gateway.estimation.complementary.errors.drift_update import widen_prior
from gateway.estimation.filtering.bias_evidence import (
    unexpected_bias_density,
    watch_bias_corrections,
)
from gateway.estimation.filtering.covariance_scale import limit_variance, scale_state
from gateway.estimation.filtering.roughness import ROUGH_TAU_S, note_force_noise
from gateway.estimation.filtering.uncalibrated import accel_bias_std
from gateway.estimation.kernel_record import as_quat
from gateway.estimation.rest_bias import BIAS_CHANGE_RADPS
from gateway.geometry.angle import wrap_pi
from gateway.geometry.quaternion import rotate_inverse
from gateway.units import RAD_PER_DEG

BIAS_WALK_RAD2PS3: Final = (0.1 * RAD_PER_DEG) ** 2 / 100.0
"""A drift of 0.1 deg/s in 100 s."""
ATTITUDE_WALK_RAD2PS: Final = (0.1 * RAD_PER_DEG) ** 2
"""Of the gyroscope's noise."""
TURN_WALK_RAD: Final = 1e-5
"""Variance of the attitude after a turn of 1 rad, by the axes of the gyroscope."""
SCALE_SHARE: Final = 0.01
"""The scale of a gyroscope is off by this to begin with, a third of an MPU6050's tolerance."""
FORCE_BIAS_MPS2: Final = 0.1
FORCE_WALK_M2PS5: Final = 0.002**2
"""Bias of the accelerometer at the start, and its random walk."""
ROUGH_SHARE: Final = 0.5
"""Of what is uneven in the angular rate: an engine's shaking to and fro adds up less than noise."""
IRON_UT: Final = 0.05
"""Iron along an axis that a calibration leaves."""
DOUBT: Final = 2.0
"""A bias that may have changed is believed so much less: what follows it is slower than it."""
UNKNOWN_VAR: Final = 10.0
"""Variance of a heading of which nothing is known, rad2."""


@compiled
def begin_drift(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Set the covariance of sensors that nothing is known of."""
    for k in range(3):
        s.drift_cov[k, k] = p.bias_initial_radps**2
        s.drift_cov[FORCE + k, FORCE + k] = force_bias_var(s)
    forget_scale(s)
    forget_iron(s)
    forget_heading(s, p)
    forget_compass(s, p)


@compiled
def begin_state(s: ComplementaryState, k: int, variance: float) -> None:
    """Take a value for one state that has nothing to do with what was known."""
    for j in range(STATES):
        s.drift_cov[k, j] = s.drift_cov[j, k] = 0.0
    s.drift_cov[k, k] = variance


@compiled
def force_bias_var(s: ComplementaryState) -> float:
    """Return the variance of the accelerometer's bias along an axis, before anything tells it."""
    std = accel_bias_std(s, FORCE_BIAS_MPS2)
    return std * std


@compiled
def forget_heading(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Know nothing of the heading."""
    start_heading(s, p, s.heading_rad, UNKNOWN_VAR)


@compiled
def forget_compass(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Know nothing of the compass's error."""
    s.compass_rad = 0.0
    s.compass_var = p.heading_noise_rad**2
    begin_state(s, COMPASS, s.compass_var)


@compiled
def forget_scale(s: ComplementaryState) -> None:
    """Know nothing of the gyroscope's scale."""
    for k in range(3):
        s.scale_b[k] = 0.0
        begin_state(s, SCALE + k, SCALE_SHARE**2)


@compiled
def forget_iron(s: ComplementaryState) -> None:
    """Know nothing of the iron that the compass carries along."""
    for k in range(3):
        s.iron_b[k] = 0.0
        begin_state(s, IRON + k, IRON_UT**2)
    s.iron_var = IRON_UT**2


@compiled
def doubt_sensors(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Doubt what gyroscope and compass have shown by an attitude that was wrong."""
    carry_drift(s, p)
    raise_bias_variance(s, DOUBT * BIAS_CHANGE_RADPS)
    forget_scale(s)
    forget_iron(s)
    forget_compass(s, p)


@compiled
def start_heading(
    s: ComplementaryState, p: ComplementaryGains, heading_rad: float, variance: float
) -> None:
    """Take a heading that has nothing to do with what was known."""
    carry_drift(s, p)
    begin_state(s, HEADING, variance)
    s.heading_rad = wrap_pi(heading_rad)


@compiled
def start_level(s: ComplementaryState, p: ComplementaryGains, std: float) -> None:
    """Hold the level by GPS from here on, beginning with a standard deviation in rad."""
    carry_drift(s, p)
    s.level_by_gps = 1
    begin_state(s, TILT, std * std)
    begin_state(s, TILT + 1, std * std)


@compiled
def end_level(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Leave the level to gravity's low-pass from here on."""
    carry_drift(s, p)
    s.level_by_gps = 0
    for k in range(TILT, STATES):
        begin_state(s, k, s.drift_cov[k, k] if k >= FORCE else 0.0)


@compiled
def note_turn(s: ComplementaryState, dt: float) -> None:
    """Note how a bias turns the attitude in one sample, and how far the aircraft turned."""
    q, turn, scaled = as_quat(s.q_eb), s.carried_turn_eb, s.carried_scaled_eb
    down = rotate_inverse(q, (0.0, 0.0, dt))
    for k in range(3):
        turn[2, k] += down[k]
        scaled[2, k] += down[k] * s.rate_b[k]
    if s.level_by_gps == 1:
        first, second = rotate_inverse(q, (dt, 0.0, 0.0)), rotate_inverse(q, (0.0, dt, 0.0))
        for k in range(3):
            turn[0, k] += first[k]
            turn[1, k] += second[k]
            scaled[0, k] += first[k] * s.rate_b[k]
            scaled[1, k] += second[k] * s.rate_b[k]
    wx, wy, wz = s.rate_b[0], s.rate_b[1], s.rate_b[2]
    s.carried_s += dt
    s.carried_rad += math.sqrt(wx * wx + wy * wy + wz * wz) * dt


@compiled
def carry_drift(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Carry the covariance on to now."""
    if s.carried_s == 0.0:
        return
    P, turn, scaled = s.drift_cov, s.carried_turn_eb, s.carried_scaled_eb
    first, n = 0 if s.level_by_gps == 1 else 2, states_in_use(s)
    walked = ATTITUDE_WALK_RAD2PS * s.carried_s + TURN_WALK_RAD * s.carried_rad
    walked += ROUGH_SHARE * s.rough_gyro
    note_roughness(s)
    for axis in range(first, 3):
        k = HEADING if axis == 2 else TILT + axis
        for i in range(3):
            for j in range(n):
                P[k, j] -= turn[axis, i] * P[i, j] + scaled[axis, i] * P[SCALE + i, j]
    for axis in range(first, 3):
        k = HEADING if axis == 2 else TILT + axis
        for i in range(3):
            for j in range(n):
                P[j, k] -= turn[axis, i] * P[j, i] + scaled[axis, i] * P[j, SCALE + i]
        P[k, k] += walked
    limit_variance(s.drift_cov, HEADING, UNKNOWN_VAR)
    carry_compass(s, p)
    for k in range(3):
        P[k, k] += (BIAS_WALK_RAD2PS3 + unexpected_bias_density(s, k)) * s.carried_s
        P[FORCE + k, FORCE + k] += FORCE_WALK_M2PS5 * s.carried_s
        limit_variance(s.drift_cov, k, p.bias_initial_radps**2)
        limit_variance(s.drift_cov, FORCE + k, force_bias_var(s))
        turn[0, k] = turn[1, k] = turn[2, k] = 0.0
        scaled[0, k] = scaled[1, k] = scaled[2, k] = 0.0
    known = s.heading_known == 1 and s.level_by_gps == 1
    watch_bias_corrections(s, known, s.carried_s)
    s.carried_s = s.carried_rad = 0.0


@compiled
def note_roughness(s: ComplementaryState) -> None:
    """Average the noise of the sensors, of which the covariance has been told."""
    share = min(s.carried_s / ROUGH_TAU_S, 1.0)
    s.rate_density += share * (ROUGH_SHARE * s.rough_gyro / s.carried_s - s.rate_density)
    note_force_noise(s, s.carried_s)
    s.rough_gyro = s.rough_accel = 0.0


@compiled
def carry_compass(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Carry the compass's slow error on: it fades with time."""
    variance = compass_variance(s, p)
    widen_compass(s, variance)
    kept = math.exp(-s.carried_s / p.tau_heading_s)
    scale_state(s.drift_cov, COMPASS, kept)
    s.drift_cov[COMPASS, COMPASS] += (1.0 - kept * kept) * variance
    s.compass_rad *= kept


@compiled
def widen_compass(s: ComplementaryState, variance: float) -> None:
    """Take back what a compass that is worse than it was thought to be has told.

    Its error was expected within `compass_var`; with that expectation goes the certainty that it
    gave to the heading, but none that GPS has given.
    """
    if variance > s.compass_var:
        widen_prior(s, COMPASS, s.compass_var, variance)
    s.compass_var = variance


@compiled
def bias_std(s: ComplementaryState) -> float:
    """Return the standard deviation of the bias per axis, rad/s."""
    P = s.drift_cov
    return math.sqrt((P[0, 0] + P[1, 1] + P[2, 2]) / 3.0)


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
def raise_attitude_variance(s: ComplementaryState, std: float) -> None:
    """Make the attitude less certain by a standard deviation in rad about each axis."""
    s.drift_cov[HEADING, HEADING] = min(s.drift_cov[HEADING, HEADING] + std * std, UNKNOWN_VAR)
    if s.level_by_gps == 1:
        s.drift_cov[TILT, TILT] += std * std
        s.drift_cov[TILT + 1, TILT + 1] += std * std
