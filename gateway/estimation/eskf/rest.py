"""Rest: low noise with a constant mean, and no speed. The mean rate is then the bias.

A rate beyond the usual bias is the bias of an uncalibrated gyroscope if no other sensor measures a
rotation: the force is constant and equal to gravity, and the magnetic field is constant or, without
a compass, the rate has not ended after two full circles.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import FRESH_GPS_S
from gateway.estimation.eskf.integrity import lose_attitude, require_bias_variance
from gateway.estimation.eskf.magnetometer import BIAS_TURN_RAD, begin_turn, reset_hard_iron
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import GYRO_BIAS, VEL, State, reset_states
from gateway.estimation.record import as_vec, write_vec
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

MEAN_S: Final = 0.5
"""Time constant of the means."""
DRIFT_S: Final = 10.0
"""Time constant of the drift of the means at rest, as of a sensor that warms up."""
REST_RATE_RADPS: Final = 0.5 * RAD_PER_DEG
REST_FORCE_MPS2: Final = 0.35
"""Change of the mean that ends a rest: 2 deg of tilt."""
USUAL_BIAS_RADPS: Final = 6.0 * RAD_PER_DEG
"""Constant rate above which it is more often a turn than a bias."""
STATIONARY_BIAS_TURN_RAD: Final = 1.0
"""The same as `BIAS_TURN_RAD` while GPS shows no speed."""
GRAVITY_SHARE: Final = 0.2
"""Error of an uncalibrated accelerometer at rest, as a share of gravity."""


@compiled
def is_moving(s: State, p: Gains) -> bool:
    """Return whether GPS, or dead reckoning minus one standard deviation, gives a speed."""
    fresh = s.time_s - s.fix_s < FRESH_GPS_S
    if s.aided == 0:
        return fresh and math.hypot(s.fix_vel[0], s.fix_vel[1]) > p.rest_speed_mps
    std = 0.0 if fresh else math.sqrt(s.P[VEL, VEL] + s.P[VEL + 1, VEL + 1])
    return math.hypot(s.vel_n[0], s.vel_n[1]) > p.rest_speed_mps + std


@compiled
def detect_rest(s: State, p: Gains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Update the means, and decide whether the aircraft is at rest."""
    share = min(1.0, dt / MEAN_S)
    gyro_sq = accel_sq = largest = 0.0
    for k in range(3):
        s.imu_mean[k] += share * (gyro[k] - s.imu_mean[k])
        s.gyro_mean[k] += share * (s.imu_mean[k] - s.gyro_mean[k])
        s.imu_mean[3 + k] += share * (accel[k] - s.imu_mean[3 + k])
        gyro_sq += (gyro[k] - s.imu_mean[k]) ** 2
        accel_sq += (accel[k] - s.imu_mean[3 + k]) ** 2
        largest = max(largest, abs(s.imu_mean[k]))
    quiet = gyro_sq < p.rest_gyro_radps**2 and accel_sq < p.rest_accel_mps2**2
    moving = is_moving(s, p)
    quiet = quiet and largest < p.bias_limit_radps and not moving
    likely = is_likely_bias(s, quiet, dt)
    s.rest_s = s.rest_s + dt if keeps_means(s, dt) and quiet and likely else 0.0
    if s.rest_s == 0.0:
        for k in range(6):
            s.rest_from[k] = s.imu_mean[k]
    s.at_rest = 1 if s.rest_s >= p.rest_time_s else 0
    if s.at_rest == 1:
        begin_rest(s, p)
    elif moving and s.rest_seen == 1:
        s.rest_seen = 2
        require_bias_variance(s, p.gyro_bias_change_radps)


@compiled
def keeps_means(s: State, dt: float) -> bool:
    """Return whether mean rate and force are those with which a rest began."""
    rate_sq = force_sq = 0.0
    share = min(1.0, dt / DRIFT_S)
    for k in range(3):
        rate_off = s.imu_mean[k] - s.rest_from[k]
        force_off = s.imu_mean[3 + k] - s.rest_from[3 + k]
        rate_sq += rate_off * rate_off
        force_sq += force_off * force_off
        s.rest_from[k] += share * rate_off
        s.rest_from[3 + k] += share * force_off
    return bool(rate_sq < REST_RATE_RADPS**2 and force_sq < REST_FORCE_MPS2**2)


@compiled
def is_usual_bias(s: State, rate: Vec3) -> bool:
    """Return whether a rate is close to the bias measured at the last rest."""
    b = s.rest_bias_b
    off = max(abs(rate[0] - b[0]), abs(rate[1] - b[1]))
    return bool(max(off, abs(rate[2] - b[2])) < USUAL_BIAS_RADPS)


@compiled
def is_likely_bias(s: State, quiet: bool, dt: float) -> bool:
    """Return whether the mean rate can be a bias; a large one must not be a rotation."""
    upright = norm_sq = 0.0
    for k in range(3):
        upright += (s.imu_mean[k] - s.rest_bias_b[k]) * s.imu_mean[3 + k]
        norm_sq += s.imu_mean[3 + k] ** 2
    force = math.sqrt(norm_sq)
    upright = abs(upright) / force if force > 0.0 else 0.0
    s.rest_turn_rad = s.rest_turn_rad + upright * dt if quiet else 0.0
    if is_usual_bias(s, (s.imu_mean[0], s.imu_mean[1], s.imu_mean[2])):
        return True
    fresh = s.time_s - s.fix_s < FRESH_GPS_S
    unturned = upright < USUAL_BIAS_RADPS
    unturned = unturned or s.rest_turn_rad > (STATIONARY_BIAS_TURN_RAD if fresh else BIAS_TURN_RAD)
    return bool(unturned and abs(force / STANDARD_GRAVITY_MPS2 - 1.0) < GRAVITY_SHARE)


@compiled
def begin_rest(s: State, p: Gains) -> None:
    """Store the bias of a rest; if it differs much, it has rotated the attitude, which is lost."""
    off = 0.0
    for k in range(3):
        off = max(off, abs(s.gyro_mean[k] - s.gyro_bias_b[k]))
        s.rest_bias_b[k] = s.gyro_mean[k]
    if s.rest_seen == 2:
        require_bias_variance(s, min(off, p.gyro_bias_change_radps))
    s.rest_seen = 1
    if off > USUAL_BIAS_RADPS:
        lose_attitude(s, p)
        write_vec(s.gyro_bias_b, as_vec(s.gyro_mean))
        reset_states(s, GYRO_BIAS, p.gyro_bias_change_radps**2)
        begin_turn(s, (0.0, 0.0, 0.0))
        reset_hard_iron(s, p)
