import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.records import ImuFlags, ImuRaw, NodeId
from gateway.sensing.calibration import Correction, NodeCalibration
from gateway.sensing.procedure import (
    FIELD_SIDES,
    calibrate_accelerometer,
    calibrate_gyro,
    calibrate_level,
    calibrate_magnetometer,
    calibrate_mounting,
    field_sides,
    is_still,
    missing_sides,
)
from gateway.sensing.procedure import SIDES as SIDE_NAMES
from gateway.sensing.solvers import CalibrationError, NodeSamples, node_samples

G = 9.80665
SIDES = G * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
BIAS = np.array([0.2, -0.1, 0.3])


def pose(force: np.ndarray, seed: int = 0, rate: float = 0.0, shaking: float = 0.02) -> NodeSamples:
    """Five seconds in one pose, as a node would read them."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0, 5, 0.01)
    n = len(time_s)
    return NodeSamples(
        time_s=time_s,
        accel=force + BIAS + rng.normal(0, shaking, (n, 3)),
        gyro=rate + rng.normal(0, 0.1 * shaking, (n, 3)),
        mag_time_s=np.empty(0),
        mag=np.empty((0, 3)),
        moving=np.zeros(n, np.bool_),
    )


def test_gyro_bias_at_rest() -> None:
    after = calibrate_gyro(pose(SIDES[4], rate=0.05), NodeCalibration())
    assert after.gyro_bias_radps == pytest.approx((0.05, 0.05, 0.05), abs=1e-3)
    assert 0.001 < after.gyro_residual_radps < 0.003


def test_gyro_that_is_moved_is_refused() -> None:
    with pytest.raises(CalibrationError, match="still"):
        calibrate_gyro(pose(SIDES[4], shaking=3.0), NodeCalibration())


def test_six_poses_one_by_one() -> None:
    held = [pose(side, k) for k, side in enumerate(SIDES)]
    assert missing_sides([]) == list(SIDE_NAMES)
    assert missing_sides([held[0], held[0]]) == list(SIDE_NAMES[1:])
    assert missing_sides(held[1:]) == ["x arrow up"]
    assert missing_sides(held) == []
    after = calibrate_accelerometer(held, NodeCalibration())
    assert after.accel_bias_mps2 == pytest.approx(tuple(BIAS), abs=0.01)
    assert after.accel_residual_mps2 < 0.01


def test_six_poses_in_one_log() -> None:
    parts = [pose(side, k) for k, side in enumerate(SIDES)]
    whole = NodeSamples(
        time_s=np.arange(len(parts) * 500) * 0.01,
        accel=np.vstack([p.accel for p in parts]),
        gyro=np.vstack([p.gyro for p in parts]),
        mag_time_s=np.empty(0),
        mag=np.empty((0, 3)),
        moving=np.zeros(len(parts) * 500, np.bool_),
    )
    after = calibrate_accelerometer([whole], NodeCalibration())
    assert after.accel_bias_mps2 == pytest.approx(tuple(BIAS), abs=0.01)


def test_a_tilted_pose_is_no_side() -> None:
    half = np.sin(np.pi / 4)
    assert len(missing_sides([pose(G * np.array([half, half, 0.0]))])) == 6


def test_a_pose_that_moved_does_not_count() -> None:
    shaken = pose(SIDES[0], shaking=3.0)
    assert not is_still(shaken)
    assert missing_sides([shaken, pose(SIDES[1])]) == [SIDE_NAMES[0], *SIDE_NAMES[2:]]
    with pytest.raises(CalibrationError, match="1 pose where 6 are needed"):
        calibrate_accelerometer([shaken, pose(SIDES[1])], NodeCalibration())


def test_mounting_turns_the_magnetometer_along() -> None:
    mounting = Rotation.from_euler("zyx", [90, 10, 180], degrees=True).as_matrix()
    level = pose(mounting.T @ [0, 0, -G])
    raised = pose(mounting.T @ [G * np.sin(0.8), 0, -G * np.cos(0.8)], 1)
    before = NodeCalibration(accel_bias_mps2=tuple(BIAS))
    after = calibrate_mounting(level, raised, before)
    np.testing.assert_allclose(after.mounting, mounting, atol=2e-3)
    np.testing.assert_allclose(after.mag_mounting, after.mounting, atol=1e-12)


@pytest.mark.parametrize("tilt_deg", [(3.0, -2.0), (-5.0, 4.0), (0.0, 0.0)])
def test_level_takes_a_small_tilt_out(tilt_deg: tuple[float, float]) -> None:
    before = NodeCalibration(accel_bias_mps2=tuple(BIAS))
    tilt = Rotation.from_euler("xy", tilt_deg, degrees=True).as_matrix()
    force_s = np.linalg.solve(np.array(before.mounting), tilt.T @ [0, 0, -G])
    after = calibrate_level(pose(force_s), before)
    level = Correction(after.mounting, after.accel_matrix, after.accel_bias_mps2)
    assert level.apply(tuple(force_s + BIAS)) == pytest.approx((0, 0, -G), abs=0.02)


def test_magnetometer_from_raw_records() -> None:
    rng = np.random.default_rng(4)
    points = rng.normal(size=(400, 3))
    counts = np.rint(500 * points / np.linalg.norm(points, axis=1)[:, None] + [80, -40, 20])
    raws = [
        ImuRaw(
            time_us=10_000 * k,
            node=NodeId(1, 0),
            node_time_us=0,
            accel_raw=(0, 0, 4096),
            gyro_raw=(0, 0, 0),
            mag_raw=tuple(int(c) for c in row),
            temperature_raw=0,
            accel_range_g=8,
            gyro_range_dps=1000,
            mag_lsb_per_gauss=1000,
            flags=ImuFlags.MAG_NEW if k % 2 == 0 else ImuFlags(0),
        )
        for k, row in enumerate(counts.tolist())
    ]
    samples = node_samples(raws)
    assert samples.mag.shape == (200, 3)
    np.testing.assert_allclose(samples.mag_time_s[:3], [0.0, 0.02, 0.04])
    assert not samples.moving.any()
    assert samples.accel[0] == pytest.approx((0, 0, G))
    after = calibrate_magnetometer(samples, NodeCalibration())
    assert after.mag_hard_iron_ut == pytest.approx((8.0, -4.0, 2.0), abs=0.05)
    assert after.mag_residual_ut < 0.1


def test_field_sides_count_directions_about_the_hard_iron() -> None:
    rng = np.random.default_rng(1)
    all_sides = rng.normal(size=(4000, 3))
    all_sides *= 45.0 / np.linalg.norm(all_sides, axis=1)[:, None]
    iron = np.array([40.0, -25.0, 10.0])

    def seen(field: np.ndarray) -> int:
        none = np.empty((0, 3))
        return field_sides(NodeSamples(np.empty(0), none, none, np.empty(0), field, np.empty(0)))

    assert seen(np.empty((0, 3))) == 0
    assert seen(np.tile(iron, (50, 1))) <= 1
    assert seen(all_sides + iron) == FIELD_SIDES
    flat = all_sides * [1.0, 1.0, 0.05]
    assert seen(flat + iron) < FIELD_SIDES // 4
    half = all_sides[all_sides[:, 0] > 0.0]
    assert seen(half + iron) < 0.8 * FIELD_SIDES
