"""Rotation matrices and their angles."""

import numpy as np
import pytest

from gateway.geometry.quaternion import from_euler, rotate
from gateway.geometry.rotation import euler_deg_from_matrix, is_rotation, matrix_from_euler_deg
from gateway.records import Vec3


@pytest.mark.parametrize("seed", range(20))
def test_matrix_equals_quaternion_rotation_in_both_directions(seed: int) -> None:
    roll, pitch, yaw = np.random.default_rng(seed).uniform((-180, -90, -180), (180, 90, 180))
    matrix = matrix_from_euler_deg((roll, pitch, yaw))
    q = from_euler(*np.radians((roll, pitch, yaw)))
    for axis in np.eye(3):
        assert np.array(matrix) @ axis == pytest.approx(rotate(q, tuple(axis)), abs=1e-12)
    assert euler_deg_from_matrix(matrix) == pytest.approx((roll, pitch, yaw), abs=1e-9)


def test_quarters_of_a_turn_are_exact() -> None:
    assert matrix_from_euler_deg((180.0, 0.0, 0.0)) == ((1, 0, 0), (0, -1, 0), (0, 0, -1))
    assert matrix_from_euler_deg((0.0, 0.0, -90.0)) == ((0, 1, 0), (-1, 0, 0), (0, 0, 1))
    assert "-0.0" not in str(matrix_from_euler_deg((180.0, 90.0, -180.0)))


@pytest.mark.parametrize("angles", [(30.0, 90.0, 45.0), (-170.0, -90.0, 20.0), (0.0, 90.0, 0.0)])
def test_vertical_pitch_gives_angles_of_the_same_rotation(angles: Vec3) -> None:
    matrix = matrix_from_euler_deg(angles)
    again = euler_deg_from_matrix(matrix)
    assert again[0] == 0.0
    np.testing.assert_allclose(matrix_from_euler_deg(again), matrix, atol=1e-9)


@pytest.mark.parametrize(("decimals", "is_valid"), [(4, True), (1, False)])
def test_rotation_may_be_rounded_a_little(decimals: int, is_valid: bool) -> None:
    matrix = np.round(matrix_from_euler_deg((10.0, 20.0, 30.0)), decimals)
    assert is_rotation(tuple(map(tuple, matrix.tolist()))) == is_valid
    assert not is_rotation(tuple(map(tuple, (-matrix).tolist())))
