"""Rest is told from a steady turn, which is as quiet."""

import numpy as np
import pytest

from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.procedure import calibrate_gyro
from gateway.sensing.solvers import CalibrationError, NodeSamples, distinct_poses
from gateway.sensing.stillness import (
    MAX_GYRO_BIAS_RADPS,
    STILL_ACCEL_MPS2,
    STILL_GYRO_RADPS,
    gyro_at_rest,
    rest_spans,
    still_windows,
)

G = 9.80665
SIDES = G * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
BIAS = np.array([0.02, -0.03, 0.01])


def lying(
    seconds: float,
    turn_degps: float = 0.0,
    *,
    mag_hz: float = 75.0,
    gyro_noise: float = 0.002,
    accel_noise: float = 0.04,
    bias: np.ndarray = BIAS,
    seed: int = 0,
) -> NodeSamples:
    """A board face up, turning about the vertical, in the field of mid latitudes."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds, 0.01)
    mag_time_s = np.arange(0.0, seconds if mag_hz else 0.0, 1.0 / (mag_hz or 1.0))
    heading = np.radians(turn_degps) * mag_time_s
    field = np.column_stack([20 * np.cos(heading), -20 * np.sin(heading), 0 * heading + 40.0])
    n = len(time_s)
    return NodeSamples(
        time_s=time_s,
        accel=SIDES[4] + rng.normal(0, accel_noise, (n, 3)),
        gyro=bias + np.array([0, 0, np.radians(turn_degps)]) + rng.normal(0, gyro_noise, (n, 3)),
        mag_time_s=mag_time_s,
        mag=field + rng.normal(0, 0.5, field.shape) + [10.0, -5.0, 3.0],
        moving=np.zeros(n, np.bool_),
    )


def joined(*parts: NodeSamples) -> NodeSamples:
    begins = np.cumsum([0.0, *(part.time_s[-1] + 0.01 for part in parts)])
    return NodeSamples(
        time_s=np.concatenate([p.time_s + t for p, t in zip(parts, begins, strict=False)]),
        accel=np.vstack([p.accel for p in parts]),
        gyro=np.vstack([p.gyro for p in parts]),
        mag_time_s=np.concatenate([p.mag_time_s + t for p, t in zip(parts, begins, strict=False)]),
        mag=np.vstack([p.mag for p in parts]),
        moving=np.concatenate([p.moving for p in parts]),
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("mag_hz", [0.0, 15.0, 75.0])
def test_the_bias_of_a_rest(seed: int, mag_hz: float) -> None:
    gyro = gyro_at_rest(lying(10.0, mag_hz=mag_hz, seed=seed))
    assert gyro.mean(axis=0) == pytest.approx(BIAS, abs=2e-4)


@pytest.mark.parametrize("turn_degps", [-2.8, 2.8, 1.0])
def test_a_steady_turn_is_no_rest(turn_degps: float) -> None:
    turn = lying(20.0, turn_degps)
    assert len(still_windows(turn)) >= 19, "as quiet as on a table"
    with pytest.raises(CalibrationError, match="3 s of rest"):
        gyro_at_rest(turn)


def test_the_rest_of_a_log_is_found_among_its_turns() -> None:
    log = joined(lying(20.0, 2.8), lying(8.0, seed=1), lying(30.0, -2.8))
    after = calibrate_gyro(log, NodeCalibration())
    assert after.gyro_bias_radps == pytest.approx(tuple(BIAS), abs=5e-4)
    assert after.gyro_residual_radps < 0.003


def test_without_a_magnetometer_contradicting_rests_are_refused() -> None:
    log = joined(lying(8.0, mag_hz=0.0), lying(8.0, 2.8, mag_hz=0.0))
    with pytest.raises(CalibrationError, match=r"2.8 deg/s apart.*turned steadily"):
        gyro_at_rest(log)


def test_what_gps_sees_moving_is_no_rest() -> None:
    flown = lying(10.0, 2.8, mag_hz=0.0)
    assert rest_spans(flown)
    flown.moving[:] = True
    assert still_windows(flown) == []


@pytest.mark.parametrize(
    ("shape", "is_still"),
    [
        ({"gyro_noise": 0.8 * STILL_GYRO_RADPS}, True),
        ({"gyro_noise": 1.2 * STILL_GYRO_RADPS}, False),
        ({"accel_noise": 0.8 * STILL_ACCEL_MPS2}, True),
        ({"accel_noise": 1.2 * STILL_ACCEL_MPS2}, False),
        ({"bias": np.array([0.95 * MAX_GYRO_BIAS_RADPS, 0, 0])}, True),
        ({"bias": np.array([1.05 * MAX_GYRO_BIAS_RADPS, 0, 0])}, False),
    ],
)
def test_the_limits_of_stillness(shape: dict[str, float], is_still: bool) -> None:
    assert bool(still_windows(lying(5.0, **shape))) == is_still


@pytest.mark.parametrize(("limit", "most"), [(STILL_GYRO_RADPS, 0.03), (STILL_ACCEL_MPS2, 0.5)])
def test_a_hand_that_trembles_is_not_still(limit: float, most: float) -> None:
    """About 2 deg/s and a twentieth of gravity: no table trembles so."""
    assert limit < most


@pytest.mark.parametrize(("scale", "is_still"), [(1.0, True), (1.14, True), (1.17, False)])
def test_a_banked_turn_weighs_too_much(scale: float, is_still: bool) -> None:
    turn = lying(5.0, mag_hz=0.0)
    turn.accel[:] *= scale
    assert bool(still_windows(turn)) == is_still


def test_a_rest_takes_three_seconds() -> None:
    assert rest_spans(lying(2.9)) == []
    assert rest_spans(lying(3.5)) != []


def test_still_windows_and_poses_of_a_log() -> None:
    rng = np.random.default_rng(3)
    time_s = np.arange(0, 40, 0.01)
    side = SIDES[(time_s // 6).astype(int) % 6]
    turning = (time_s % 6) > 4
    n = len(time_s)
    samples = NodeSamples(
        time_s,
        accel=side + rng.normal(0, np.where(turning, 3.0, 0.02)[:, None], (n, 3)),
        gyro=rng.normal(0, np.where(turning, 1.0, 0.002)[:, None], (n, 3)),
        mag_time_s=np.empty(0),
        mag=np.empty((0, 3)),
        moving=np.zeros(n, np.bool_),
    )
    windows = still_windows(samples)
    assert 20 <= len(windows) <= 28
    poses = distinct_poses(samples.accel, windows)
    assert len(poses) == 6
    np.testing.assert_allclose(np.sort(poses[:, 0]), np.sort(SIDES[:, 0]), atol=0.05)
