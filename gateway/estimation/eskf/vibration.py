"""Vibration noise of the inertial sensors, measured from sample to sample."""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import State
from gateway.records import Vec3

STEP_LIMIT: Final = 1e4
"""A larger squared change is a fault, and NaN compares false."""


@compiled
def add_vibration(s: State, p: Gains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Add the noise by how the changes from sample to sample change: motion is steady, noise not.

    The second difference contains the noise of three samples, the middle one twice: six variances
    on each of three axes.
    """
    gyro_sq = accel_sq = 0.0
    for k in range(3):
        change = gyro[k] - s.imu_before[k]
        gyro_sq += (change - s.imu_change[k]) ** 2
        s.imu_change[k] = change
        change = accel[k] - s.imu_before[3 + k]
        accel_sq += (change - s.imu_change[3 + k]) ** 2
        s.imu_change[3 + k] = change
        s.imu_before[k], s.imu_before[3 + k] = gyro[k], accel[k]
    if gyro_sq < STEP_LIMIT and accel_sq < STEP_LIMIT:
        share = dt * dt / 18.0
        s.pending_noise[0] += p.gyro_vibration_sq * share * gyro_sq
        s.pending_noise[1] += p.accel_vibration_sq * share * accel_sq
