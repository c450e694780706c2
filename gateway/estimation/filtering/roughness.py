"""The sensors' noise, told from motion by what is uneven from sample to sample."""

from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray
from gateway.records import Vec3

ROUGH_TAU_S: Final = 2.0
"""The roughness of the sensors is averaged over this time."""
ROUGH_LIMIT: Final = 1e4
"""A larger change is a fault, and NaN compares false."""


class RoughnessState:
    """What has been uneven since the covariance was carried on."""

    gyro_change: Annotated[FloatArray, (3,)]
    """How the newest angular rate differs from the one before, rad/s."""
    accel_change: Annotated[FloatArray, (3,)]
    """The same of the specific force, m/s2."""
    rough_gyro: float
    """Variance of the angle over that time if what is uneven in the rate were white noise, rad2."""
    rough_accel: float
    """The same of the velocity, m2/s2."""
    force_density: float
    """Density of the noise of the specific force, as rough as it was of late, m2/s3."""


@compiled
def collect_roughness(
    s: RoughnessState, gyro: Vec3, accel: Vec3, gyro_before: Vec3, accel_before: Vec3, dt: float
) -> None:
    """Measure the noise by how the changes from sample to sample change: motion goes on, noise not.

    What the sum over a steady change is late by, the next change takes back: that is no noise.
    """
    turn, pull = 0.0, 0.0
    for k in range(3):
        turned, pulled = gyro[k] - gyro_before[k], accel[k] - accel_before[k]
        turn += (turned - s.gyro_change[k]) ** 2
        pull += (pulled - s.accel_change[k]) ** 2
        s.gyro_change[k] = turned if abs(turned) < ROUGH_LIMIT else 0.0
        s.accel_change[k] = pulled if abs(pulled) < ROUGH_LIMIT else 0.0
    # The noise of three samples, the middle one twice, of three axes.
    share = dt * dt / 18.0
    if turn < ROUGH_LIMIT and pull < ROUGH_LIMIT:
        s.rough_gyro += share * turn
        s.rough_accel += share * pull


@compiled
def note_force_noise(s: RoughnessState, dt: float) -> None:
    """Average the noise of the specific force, before what was collected over `dt` is cleared."""
    share = min(dt / ROUGH_TAU_S, 1.0)
    s.force_density += share * (s.rough_accel / dt - s.force_density)
