"""Sensors that nobody has calibrated: what they are off by is more than a calibration leaves."""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import ACCEL_UNCALIBRATED, GYRO_UNCALIBRATED, MAG_UNCALIBRATED
from gateway.estimation.kernel_record import FloatArray
from gateway.units import RAD_PER_DEG

UNCALIBRATED_GYRO_RADPS: Final = 3.0 * RAD_PER_DEG
UNCALIBRATED_ACCEL_MPS2: Final = 0.3
"""Standard deviations of a bias along an axis; an MPU6050's tolerances are 20 deg/s, and 0.5 m/s2
across and 0.8 upright."""
UNCALIBRATED_MOST_MPS2: Final = 1.5
CALIBRATED_MOST_MPS2: Final = 0.5
"""No bias of an accelerometer is larger."""


class UncalibratedState:
    """Which sensors have no calibration."""

    mag_uncalibrated: int
    """See `FieldState`."""
    gyro_uncalibrated: int
    accel_uncalibrated: int
    bias_shown: int
    """See `RestState`."""


@compiled
def note_flags(s: UncalibratedState, row: FloatArray) -> tuple[bool, bool, bool]:
    """Note what a sample's row says of the calibration of its sensors.

    Parameters
    ----------
    s : UncalibratedState
        Changed in place.
    row : ndarray, shape (IMU_COLUMNS,)
        See `columns`.

    Returns
    -------
    mag, gyro, accel : bool
        Whether that is another than before: what was found of the sensor's error is out of it then.
    """
    mag, gyro = row[MAG_UNCALIBRATED] != 0.0, row[GYRO_UNCALIBRATED] != 0.0
    accel = row[ACCEL_UNCALIBRATED] != 0.0
    changed = (
        mag != (s.mag_uncalibrated == 1),
        gyro != (s.gyro_uncalibrated == 1),
        accel != (s.accel_uncalibrated == 1),
    )
    s.mag_uncalibrated, s.gyro_uncalibrated, s.accel_uncalibrated = int(mag), int(gyro), int(accel)
    return changed


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
