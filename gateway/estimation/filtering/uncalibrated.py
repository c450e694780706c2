"""Sensors that nobody has calibrated: what they are off by is more than a calibration leaves."""

from typing import Final

from gateway.compiled import compiled
from gateway.units import RAD_PER_DEG

UNCALIBRATED_GYRO_RADPS: Final = 3.0 * RAD_PER_DEG
UNCALIBRATED_ACCEL_MPS2: Final = 0.3
"""Standard deviations of a bias along an axis; an MPU6050's tolerances are 20 deg/s, and 0.5 m/s2
across and 0.8 upright."""
UNCALIBRATED_MOST_MPS2: Final = 1.5
CALIBRATED_MOST_MPS2: Final = 0.5
"""No bias of an accelerometer is larger."""


class UncalibratedState:
    """Which inertial sensors have no calibration; see `FieldState` for the compass."""

    gyro_uncalibrated: int
    accel_uncalibrated: int
    bias_shown: int
    """See `RestState`."""


@compiled
def gyro_bias_var(s: UncalibratedState, usual: float) -> float:
    """Return the variance of the gyroscope's bias until a rest has shown it, (rad/s)2.

    Parameters
    ----------
    s : UncalibratedState
        Whether there is a calibration, and has been a rest.
    usual : float
        The same of a gyroscope that is calibrated.
    """
    if s.gyro_uncalibrated == 0 or s.bias_shown == 1:
        return usual
    return max(usual, UNCALIBRATED_GYRO_RADPS * UNCALIBRATED_GYRO_RADPS)


@compiled
def accel_bias_std(s: UncalibratedState, usual: float) -> float:
    """Return the standard deviation of the accelerometer's bias before anything tells it, m/s2.

    Parameters
    ----------
    s : UncalibratedState
        Whether there is a calibration.
    usual : float
        The same of an accelerometer that is calibrated.
    """
    return max(usual, UNCALIBRATED_ACCEL_MPS2) if s.accel_uncalibrated == 1 else usual


@compiled
def largest_accel_bias(s: UncalibratedState) -> float:
    """Return what the accelerometer's bias along an axis is at most, m/s2."""
    return UNCALIBRATED_MOST_MPS2 if s.accel_uncalibrated == 1 else CALIBRATED_MOST_MPS2
