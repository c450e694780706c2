"""Absorb what a calibration still left wrong, as measured on calibrated samples."""

import numpy as np
from msgspec.structs import replace

from gateway.geometry.quaternion import from_euler, rotate
from gateway.records import Quat, Vec3
from gateway.sensing.calibration import IDENTITY3, Matrix3, NodeCalibration, compose


def absorb(calibration: NodeCalibration, kind: str, error_b: Vec3) -> NodeCalibration:
    """Correct a calibration by a remaining error of its own samples.

    A calibrated vector is `v_b = R @ M @ (s - b)`, so the bias that takes `error_b` away from it
    is `b + inv(R @ M) @ error_b`.

    Parameters
    ----------
    calibration : NodeCalibration
        The one under which the error was measured.
    kind : str
        `gyro`, `accel` or `mag`: an offset to subtract from calibrated samples, in rad/s, m/s2 or
        uT; `level`: the roll, pitch and yaw in rad that a level aircraft showed.
    error_b : tuple of 3 floats
        In body FRD.

    Returns
    -------
    NodeCalibration

    Raises
    ------
    ValueError
        If the kind is none of these.
    """
    c = calibration
    match kind:
        case "gyro":
            bias = _add(c.gyro_bias_radps, _to_sensor(c.mounting, error_b))
            return replace(c, gyro_bias_radps=bias)
        case "accel":
            error_s = _to_sensor(compose(c.mounting, c.accel_matrix), error_b)
            return replace(c, accel_bias_mps2=_add(c.accel_bias_mps2, error_s))
        case "mag":
            error_s = _to_sensor(compose(c.mag_mounting, c.mag_soft_iron), error_b)
            return replace(c, mag_hard_iron_ut=_add(c.mag_hard_iron_ut, error_s))
        case "level":
            # The attitude shown at level is the rotation from the body as mounted to the true one.
            turn = _rotation(from_euler(*error_b))
            return replace(
                c,
                mounting=compose(turn, c.mounting),
                mag_mounting=compose(turn, c.mag_mounting),
            )
    raise ValueError(f"no calibration of kind {kind!r}; there are gyro, accel, mag and level")


def _to_sensor(matrix: Matrix3, v_b: Vec3) -> Vec3:
    x, y, z = np.linalg.solve(np.array(matrix), np.array(v_b)).tolist()
    return (x, y, z)


def _rotation(q: Quat) -> Matrix3:
    x, y, z = (rotate(q, axis) for axis in IDENTITY3)
    return ((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]))


def _add(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
