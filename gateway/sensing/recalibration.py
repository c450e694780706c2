"""Remove a remaining error of the calibrated samples by changing their calibration."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.geometry.quaternion import body_axes, from_euler
from gateway.geometry.rotation import Matrix3
from gateway.records import Vec3
from gateway.sensing.calibration import NodeCalibration


def remove_gyro_error(calibration: NodeCalibration, error_b: Vec3) -> NodeCalibration:
    """Shift the gyroscope's bias so that `error_b` (rad/s) vanishes from calibrated samples."""
    bias = _shifted(calibration.gyro_bias_radps, calibration.mounting, None, error_b)
    return msgspec.structs.replace(calibration, gyro_bias_radps=bias)


def remove_accel_error(calibration: NodeCalibration, error_b: Vec3) -> NodeCalibration:
    """Shift the accelerometer's bias so that `error_b` (m/s2) vanishes."""
    matrix = calibration.accel_matrix
    bias = _shifted(calibration.accel_bias_mps2, calibration.mounting, matrix, error_b)
    return msgspec.structs.replace(calibration, accel_bias_mps2=bias)


def remove_mag_error(calibration: NodeCalibration, error_b: Vec3) -> NodeCalibration:
    """Shift the hard iron so that `error_b` (uT) vanishes."""
    matrix = calibration.mag_soft_iron
    bias = _shifted(calibration.mag_hard_iron_ut, calibration.mag_mounting, matrix, error_b)
    return msgspec.structs.replace(calibration, mag_hard_iron_ut=bias)


def remove_tilt(calibration: NodeCalibration, roll_pitch_yaw_rad: Vec3) -> NodeCalibration:
    """Turn both mountings so that an aircraft that seemed tilted by these angles is level."""
    turn = np.array(body_axes(from_euler(*roll_pitch_yaw_rad))).T
    return msgspec.structs.replace(
        calibration,
        mounting=_matrix(turn @ np.array(calibration.mounting)),
        mag_mounting=_matrix(turn @ np.array(calibration.mag_mounting)),
    )


def _shifted(bias: Vec3, mounting: Matrix3, matrix: Matrix3 | None, error_b: Vec3) -> Vec3:
    """Solve `R M (s - bias') = R M (s - bias) - error` for the new bias."""
    forward = np.array(mounting)
    if matrix is not None:
        forward = forward @ np.array(matrix)
    x, y, z = (float(v) for v in np.array(bias) + np.linalg.solve(forward, np.array(error_b)))
    return (x, y, z)


def _matrix(values: NDArray[np.float64]) -> Matrix3:
    a, b, c = ((float(row[0]), float(row[1]), float(row[2])) for row in values)
    return (a, b, c)
