"""An accelerometer that nobody has calibrated has a larger bias than a calibration leaves."""

from typing import Final

from gateway.compiled import compiled

UNCALIBRATED_BIAS_MPS2: Final = 0.3
"""Standard deviation along an axis; an MPU6050's tolerance is 0.5 across and 0.8 upright."""
UNCALIBRATED_MOST_MPS2: Final = 1.5
CALIBRATED_MOST_MPS2: Final = 0.5
"""No bias is larger."""


class AccelerometerState:
    """Whether there is a calibration."""

    accel_uncalibrated: int
    """1 where nobody has calibrated the accelerometer."""


@compiled
def largest_bias_mps2(s: AccelerometerState) -> float:
    """Return what a bias along an axis is at most."""
    return UNCALIBRATED_MOST_MPS2 if s.accel_uncalibrated == 1 else CALIBRATED_MOST_MPS2
