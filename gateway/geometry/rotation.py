"""Rotation matrices, and their Euler angles."""

import math

import numpy as np

from gateway.records import Vec3

Matrix3 = tuple[Vec3, Vec3, Vec3]

_GIMBAL_LOCK = 1e-9
"""Cosine of the pitch below which roll and yaw count as rotations about the same axis."""


def matrix_from_euler_deg(roll_pitch_yaw_deg: Vec3) -> Matrix3:
    """Build a matrix from intrinsic Z-Y-X angles: yaw, then pitch, then roll.

    It transforms vectors from the rotated to the original axes; multiples of 90 degrees give exact
    zeros and ones.
    """
    (cr, sr), (cp, sp), (cy, sy) = (_cos_sin(angle) for angle in roll_pitch_yaw_deg)
    # Adding zero changes a negative zero to a positive one.
    return (
        (cy * cp + 0.0, cy * sp * sr - sy * cr + 0.0, cy * sp * cr + sy * sr + 0.0),
        (sy * cp + 0.0, sy * sp * sr + cy * cr + 0.0, sy * sp * cr - cy * sr + 0.0),
        (-sp + 0.0, cp * sr + 0.0, cp * cr + 0.0),
    )


def euler_deg_from_matrix(matrix: Matrix3) -> Vec3:
    """Return the angles of `matrix_from_euler_deg`, the pitch from -90 to 90.

    At a pitch of 90 degrees, only the sum or difference of roll and yaw is determined, and the roll
    is set to zero.
    """
    (xx, xy, _), (yx, yy, _), (zx, zy, zz) = matrix
    level = math.hypot(xx, yx)
    pitch = math.atan2(-zx, level)
    if level > _GIMBAL_LOCK:
        roll, yaw = math.atan2(zy, zz), math.atan2(yx, xx)
    else:
        roll, yaw = 0.0, math.atan2(-xy, yy)
    return (math.degrees(roll), math.degrees(pitch), math.degrees(yaw))


def is_rotation(matrix: Matrix3) -> bool:
    """Return whether the rows are orthonormal and right-handed.

    The tolerance is a thousandth in every product of two rows, which may be rounded by a user.
    """
    rows = np.array(matrix)
    is_orthonormal = np.abs(rows @ rows.T - np.eye(3)).max() <= 1e-3
    return bool(is_orthonormal and np.linalg.det(rows) > 0.0)


def _cos_sin(angle_deg: float) -> tuple[float, float]:
    quarters, rest_deg = divmod(angle_deg, 90.0)
    if rest_deg == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    angle = math.radians(angle_deg)
    return math.cos(angle), math.sin(angle)
