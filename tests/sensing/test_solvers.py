import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.sensing.calibration import FACE_UP
from gateway.sensing.solvers import (
    CalibrationError,
    solve_accelerometer,
    solve_magnetometer,
    solve_mounting,
    solve_rest,
)

G = 9.80665
SIDES = G * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])


def sphere(rng: np.random.Generator, count: int, radius: float) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1)[:, None]


@pytest.mark.parametrize("seed", range(5))
def test_six_sides_give_bias_and_scale(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bias, scale = rng.normal(0, 0.3, 3), 1.0 + rng.normal(0, 0.02, 3)
    fit = solve_accelerometer(SIDES / scale + bias)
    np.testing.assert_allclose(fit.bias, bias, atol=1e-6)
    np.testing.assert_allclose(np.diag(fit.matrix), scale, atol=1e-7)
    assert fit.residual < 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_many_poses_give_the_skew_too(seed: int) -> None:
    rng = np.random.default_rng(seed)
    skew = rng.normal(0, 0.01, (3, 3))
    matrix = np.eye(3) + 0.5 * (skew + skew.T)
    bias = rng.normal(0, 0.3, 3)
    poses = np.vstack([SIDES, sphere(rng, 12, G)])
    fit = solve_accelerometer(poses @ np.linalg.inv(matrix).T + bias)
    np.testing.assert_allclose(fit.matrix, matrix, atol=1e-6)
    np.testing.assert_allclose(fit.bias, bias, atol=1e-5)


@pytest.mark.parametrize("poses", [SIDES[:5], np.vstack([SIDES[:4], SIDES[:4]])])
def test_missing_sides_are_refused(poses: np.ndarray) -> None:
    with pytest.raises(CalibrationError, match="side"):
        solve_accelerometer(poses)


@pytest.mark.parametrize("seed", range(5))
def test_magnetometer_ellipsoid(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spread = 0.1 * rng.normal(size=(3, 3))
    soft = np.eye(3) + 0.5 * (spread + spread.T)
    hard = rng.normal(0, 20.0, 3)
    raw = sphere(rng, 600, 45.0) @ np.linalg.inv(soft).T + hard + rng.normal(0, 0.2, (600, 3))
    fit = solve_magnetometer(raw, 45.0)
    np.testing.assert_allclose(fit.bias, hard, atol=0.2)
    np.testing.assert_allclose(fit.matrix, soft, atol=0.01)
    assert fit.residual == pytest.approx(0.2, rel=0.2)


def test_magnetometer_without_known_strength_keeps_the_mean() -> None:
    raw = sphere(np.random.default_rng(1), 300, 50.0) + 10.0
    fit = solve_magnetometer(raw)
    assert np.linalg.norm((raw - fit.bias) @ np.array(fit.matrix), axis=1).mean() == pytest.approx(
        50.0, rel=1e-3
    )


def test_magnetometer_that_was_only_turned_flat_is_refused() -> None:
    angle = np.linspace(0, 6.28, 300)
    flat = np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), np.full(300, 20.0)])
    with pytest.raises(CalibrationError, match="turn the aircraft"):
        solve_magnetometer(flat)
    with pytest.raises(CalibrationError, match="10 samples"):
        solve_magnetometer(flat[:10])
    with pytest.raises(CalibrationError, match="1 sample where"):
        solve_magnetometer(flat[:1])


@pytest.mark.parametrize("pitch_deg", [20.0, 45.0, 90.0])
@pytest.mark.parametrize("seed", range(4))
def test_mounting_from_level_and_nose_up(seed: int, pitch_deg: float) -> None:
    mounting = Rotation.random(random_state=seed).as_matrix()
    pitch = np.radians(pitch_deg)
    level_s = mounting.T @ np.array([0.0, 0.0, -G])
    raised_s = mounting.T @ np.array([G * np.sin(pitch), 0.0, -G * np.cos(pitch)])
    found = solve_mounting(tuple(level_s), tuple(raised_s))
    np.testing.assert_allclose(found, mounting, atol=1e-9)


def test_face_up_board_is_the_default_mounting() -> None:
    np.testing.assert_allclose(solve_mounting((0, 0, G), (5.0, 0, 8.0)), FACE_UP, atol=1e-12)


def test_nose_that_was_not_raised_is_refused() -> None:
    with pytest.raises(CalibrationError, match="nose"):
        solve_mounting((0, 0, G), (0.1, 0, G))


def test_rest() -> None:
    fit = solve_rest(np.random.default_rng(2).normal((0.01, -0.02, 0.03), 0.001, (500, 3)))
    assert fit.mean == pytest.approx((0.01, -0.02, 0.03), abs=2e-4)
    assert fit.residual == pytest.approx(0.001, rel=0.2)


@pytest.mark.parametrize(
    ("poses", "told"),
    [
        (SIDES + np.array([0.0, 2.1, 0.0]), "bias 2.10 m/s2"),
        (1.2 * SIDES, "scale error"),
        (SIDES * [[0.93], [1.0], [1.0], [1.0], [1.0], [1.0]] - [[0], [3], [0], [0], [0], [0]], ""),
    ],
)
def test_an_accelerometer_that_no_sensor_can_be_is_refused(poses: np.ndarray, told: str) -> None:
    with pytest.raises(CalibrationError, match=f"{told}.*still"):
        solve_accelerometer(poses)


@pytest.mark.parametrize(
    ("field", "told"),
    [
        (sphere(np.random.default_rng(1), 300, 45.0) + np.array([0, 0, 201]), "hard iron 201"),
        (sphere(np.random.default_rng(1), 300, 45.0) * [1.0, 2.1, 1.0], "soft iron"),
        (sphere(np.random.default_rng(1), 300, 120.0), "a field of 120 uT"),
        (
            sphere(np.random.default_rng(1), 300, 45.0)
            * (1.0 + 0.2 * np.random.default_rng(2).normal(size=(300, 1))),
            "residual",
        ),
    ],
)
def test_a_field_that_is_not_the_earths_is_refused(field: np.ndarray, told: str) -> None:
    with pytest.raises(CalibrationError, match=f"{told}.*iron"):
        solve_magnetometer(field)
