"""The calibration solver: from samples of poses and turns to a node's calibration."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.geometry.geomagnetism import MagneticField
from gateway.geometry.quaternion import from_euler, rotate_inverse
from gateway.geometry.rotation import Matrix3
from gateway.records import ImuFlags
from gateway.sensing import calibrating as solver
from gateway.sensing.calibration import FACE_UP, IDENTITY3, Correction, NodeCalibration
from tests.kit.records import raw_at

G = 9.80665
SIDES = G * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])


def sphere(rng: np.random.Generator, count: int, radius: float) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1)[:, None]


@pytest.mark.parametrize("seed", range(3))
def test_sphere_fit_finds_centre_and_radius(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre, radius = rng.normal(scale=20.0, size=3), float(rng.uniform(20.0, 60.0))
    found, found_radius = solver.fit_sphere(sphere(rng, 200, radius) + centre)
    assert found == pytest.approx(tuple(centre), abs=1e-9)
    assert found_radius == pytest.approx(radius)


@pytest.mark.parametrize("seed", range(5))
def test_six_sides_give_bias_and_scale(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bias, scale = rng.normal(0, 0.3, 3), 1.0 + rng.normal(0, 0.02, 3)
    fit = solver.fit_accelerometer(SIDES / scale + bias, NodeCalibration())
    np.testing.assert_allclose(fit.accel_bias_mps2, bias, atol=1e-6)
    np.testing.assert_allclose(np.diag(fit.accel_matrix), scale, atol=1e-7)
    assert fit.accel_residual_mps2 < 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_eighteen_poses_determine_bias_and_misalignment(seed: int) -> None:
    rng = np.random.default_rng(seed)
    skew = rng.normal(0, 0.01, (3, 3))
    matrix = np.eye(3) + 0.5 * (skew + skew.T)
    bias = rng.normal(0, 0.3, 3)
    poses = np.vstack([SIDES, sphere(rng, 12, G)])
    fit = solver.fit_accelerometer(poses @ np.linalg.inv(matrix).T + bias, NodeCalibration())
    np.testing.assert_allclose(fit.accel_matrix, matrix, atol=1e-6)
    np.testing.assert_allclose(fit.accel_bias_mps2, bias, atol=1e-5)


@pytest.mark.parametrize("poses", [SIDES[:5], np.vstack([SIDES[:4], SIDES[:4]])])
def test_missing_sides_are_refused(poses: np.ndarray) -> None:
    with pytest.raises(solver.CalibrationError, match="side"):
        solver.fit_accelerometer(poses, NodeCalibration())


@pytest.mark.parametrize("seed", range(5))
def test_magnetometer_ellipsoid_gives_hard_and_soft_iron(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spread = 0.1 * rng.normal(size=(3, 3))
    soft = np.eye(3) + 0.5 * (spread + spread.T)
    hard = rng.normal(0, 20.0, 3)
    raw = sphere(rng, 600, 45.0) @ np.linalg.inv(soft).T + hard + rng.normal(0, 0.2, (600, 3))
    fit = solver.calibrate_magnetometer(raw, NodeCalibration(), 45.0)
    np.testing.assert_allclose(fit.mag_hard_iron_ut, hard, atol=0.2)
    np.testing.assert_allclose(fit.mag_soft_iron, soft, atol=0.01)
    assert fit.mag_residual_ut == pytest.approx(0.2, rel=0.2)


def test_magnetometer_without_known_strength_keeps_the_mean() -> None:
    raw = sphere(np.random.default_rng(1), 300, 50.0) + 10.0
    fit = solver.calibrate_magnetometer(raw, NodeCalibration())
    strengths = np.linalg.norm((raw - fit.mag_hard_iron_ut) @ np.array(fit.mag_soft_iron), axis=1)
    assert strengths.mean() == pytest.approx(50.0, rel=1e-3)


def test_magnetometer_that_was_only_turned_flat_is_refused() -> None:
    angle = np.linspace(0, 6.28, 300)
    flat = np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), np.full(300, 20.0)])
    for count, why in ((300, "turn the aircraft"), (10, "10 samples"), (1, "1 sample where")):
        with pytest.raises(solver.CalibrationError, match=why):
            solver.calibrate_magnetometer(flat[:count], NodeCalibration())


@pytest.mark.parametrize("pitch_deg", [20.0, 45.0, 90.0])
@pytest.mark.parametrize("seed", range(4))
def test_level_and_nose_up_poses_give_the_mounting(seed: int, pitch_deg: float) -> None:
    mounting = Rotation.random(random_state=seed).as_matrix()
    pitch = np.radians(pitch_deg)
    level_s = mounting.T @ np.array([0.0, 0.0, -G])
    raised_s = mounting.T @ np.array([G * np.sin(pitch), 0.0, -G * np.cos(pitch)])
    found = solver.solve_mounting(tuple(level_s), tuple(raised_s))
    np.testing.assert_allclose(found, mounting, atol=1e-9)
    np.testing.assert_allclose(solver.solve_mounting((0, 0, G), (5.0, 0, 8.0)), FACE_UP, atol=1e-12)


def test_nose_that_was_not_raised_is_refused() -> None:
    with pytest.raises(solver.CalibrationError, match="nose"):
        solver.solve_mounting((0, 0, G), (0.1, 0, G))


@pytest.mark.parametrize(
    ("poses", "reason"),
    [
        (SIDES + np.array([0.0, 2.1, 0.0]), "bias 2.10 m/s2"),
        (1.2 * SIDES, "scale error"),
        (SIDES * [[0.93], [1.0], [1.0], [1.0], [1.0], [1.0]] - [[0], [3], [0], [0], [0], [0]], ""),
        # Two forces on every side.
        (np.vstack([SIDES, 1.15 * SIDES]), "residual 0.68 m/s2"),
    ],
)
def test_implausible_accelerometer_error_is_refused(poses: np.ndarray, reason: str) -> None:
    with pytest.raises(solver.CalibrationError, match=f"{reason}.*still"):
        solver.fit_accelerometer(poses, NodeCalibration())


EARTH = sphere(np.random.default_rng(1), 300, 45.0)


@pytest.mark.parametrize(
    ("field", "reason"),
    [
        (EARTH + np.array([0, 0, 201]), "hard iron 201"),
        (EARTH * [1.0, 2.1, 1.0], "soft iron"),
        (EARTH * (120.0 / 45.0), "the fit gave 120 uT"),
        (EARTH * (1.0 + 0.2 * np.random.default_rng(2).normal(size=(300, 1))), "residual"),
    ],
)
def test_field_outside_the_range_of_the_earth_is_refused(field: np.ndarray, reason: str) -> None:
    with pytest.raises(solver.CalibrationError, match=f"{reason}.*steel"):
        solver.calibrate_magnetometer(field, NodeCalibration())


def test_compass_at_rest_is_to_be_turned(rng: np.random.Generator) -> None:
    noise = np.array([22.0, 5.0, 40.0]) + rng.normal(0.0, 0.5, (300, 3))
    with pytest.raises(solver.MoreNeeded, match="turn the aircraft about all its axes"):
        solver.calibrate_magnetometer(noise, NodeCalibration())


ACCEL_BIAS = np.array([0.2, -0.1, 0.3])
GYRO_BIAS = np.array([0.02, -0.03, 0.01])
NO_TIMES, NO_VECTORS = np.empty(0), np.empty((0, 3))


def samples(
    accel: np.ndarray, gyro: np.ndarray, mag_time_s: np.ndarray = NO_TIMES,
    mag: np.ndarray = NO_VECTORS,
) -> solver.NodeSamples:  # fmt: skip
    """Return samples of 100 Hz."""
    still = np.zeros(len(accel), np.bool_)
    return solver.NodeSamples(0.01 * np.arange(len(accel)), accel, gyro, mag_time_s, mag, still)


def pose(
    force: np.ndarray, seed: int = 0, rate: float = 0.0, shaking: float = 0.02
) -> solver.NodeSamples:
    """Five seconds in one pose, as a node would read them."""
    rng = np.random.default_rng(seed)
    accel = force + ACCEL_BIAS + rng.normal(0, shaking, (500, 3))
    return samples(accel, rate + rng.normal(0, 0.1 * shaking, (500, 3)))


def joined(*parts: solver.NodeSamples) -> solver.NodeSamples:
    begins = np.cumsum([0.0, *(part.time_s[-1] + 0.01 for part in parts)])
    return samples(
        np.vstack([p.accel for p in parts]),
        np.vstack([p.gyro for p in parts]),
        np.concatenate([p.mag_time_s + t for p, t in zip(parts, begins, strict=False)]),
        np.vstack([p.mag for p in parts]),
    )


def test_mean_rate_at_rest_is_the_gyro_bias() -> None:
    after = solver.calibrate_gyro(pose(SIDES[4], rate=0.05), NodeCalibration())
    assert after.gyro_bias_radps == pytest.approx((0.05, 0.05, 0.05), abs=1e-3)
    assert 0.001 < after.gyro_residual_radps < 0.003


def test_moved_gyro_is_refused() -> None:
    with pytest.raises(solver.CalibrationError, match="the node was not at rest"):
        solver.calibrate_gyro(pose(SIDES[4], shaking=3.0), NodeCalibration())


def test_six_poses_one_by_one_give_the_accelerometer_bias() -> None:
    held = [pose(side, k) for k, side in enumerate(SIDES)]
    assert solver.sides_of([]) == set()
    assert solver.sides_of([held[0], held[0]]) == {0}
    assert solver.sides_of(held[1:]) == {1, 2, 3, 4, 5}
    assert solver.sides_of(held) == set(range(6))
    tilted = pose(G * np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0]))
    assert solver.sides_of([tilted]) == set()
    for parts in (held, [joined(*held)]):
        after = solver.calibrate_accelerometer(parts, NodeCalibration())
        assert after.accel_bias_mps2 == pytest.approx(tuple(ACCEL_BIAS), abs=0.01)
        assert after.accel_residual_mps2 < 0.01


def test_pose_in_motion_is_not_counted() -> None:
    shaken = pose(SIDES[0], shaking=3.0)
    assert not solver.still_windows(shaken)
    assert solver.sides_of([shaken, pose(SIDES[1])]) == {1}
    with pytest.raises(solver.CalibrationError, match="1 pose where 6 are needed"):
        solver.calibrate_accelerometer([shaken, pose(SIDES[1])], NodeCalibration())


def test_mounting_turns_the_magnetometer_along() -> None:
    mounting = Rotation.from_euler("zyx", [90, 10, 180], degrees=True).as_matrix()
    level = pose(mounting.T @ [0, 0, -G])
    raised = pose(mounting.T @ [G * np.sin(0.8), 0, -G * np.cos(0.8)], 1)
    before = NodeCalibration(accel_bias_mps2=tuple(ACCEL_BIAS))
    after = solver.calibrate_mounting(level, raised, before)
    np.testing.assert_allclose(after.mounting, mounting, atol=2e-3)
    np.testing.assert_allclose(after.mag_mounting, after.mounting, atol=1e-12)


@pytest.mark.parametrize("tilt_deg", [(3.0, -2.0), (-5.0, 4.0), (0.0, 0.0)])
def test_level_calibration_removes_a_small_tilt(tilt_deg: tuple[float, float]) -> None:
    before = NodeCalibration(accel_bias_mps2=tuple(ACCEL_BIAS))
    tilt = Rotation.from_euler("xy", tilt_deg, degrees=True).as_matrix()
    force_s = np.linalg.solve(np.array(before.mounting), tilt.T @ [0, 0, -G])
    after = solver.calibrate_level(pose(force_s), before)
    level = Correction(after.mounting, after.accel_matrix, after.accel_bias_mps2)
    assert level.apply(tuple(force_s + ACCEL_BIAS)) == pytest.approx((0, 0, -G), abs=0.02)


def test_magnetometer_is_calibrated_from_raw_records() -> None:
    rng = np.random.default_rng(4)
    counts = np.rint(sphere(rng, 400, 500.0) + np.array([80, -40, 20])).astype(int).tolist()
    flags = ImuFlags.MAG_NEW, ImuFlags(0)
    raws = [
        raw_at(10_000 * k, mag_raw=tuple(row), mag_lsb_per_gauss=1000, flags=flags[k % 2])
        for k, row in enumerate(counts)
    ]
    read = solver.node_samples(raws)
    assert read.mag.shape == (200, 3)
    np.testing.assert_allclose(read.mag_time_s[:3], [0.0, 0.02, 0.04])
    assert not read.moving.any()
    assert read.accel[0] == pytest.approx((0, 0, G))
    after = solver.calibrate_magnetometer(read.mag, NodeCalibration())
    assert after.mag_hard_iron_ut == pytest.approx((8.0, -4.0, 2.0), abs=0.05)
    assert after.mag_residual_ut < 0.1


def lying(
    seconds: float,
    turn_degps: float = 0.0,
    *,
    mag_hz: float = 75.0,
    gyro_noise: float = 0.002,
    accel_noise: float = 0.04,
    bias: np.ndarray = GYRO_BIAS,
    seed: int = 0,
) -> solver.NodeSamples:
    """A board face up, turning about the vertical, in the field of mid latitudes."""
    rng = np.random.default_rng(seed)
    n = round(100 * seconds)
    mag_time_s = np.arange(0.0, seconds if mag_hz else 0.0, 1.0 / (mag_hz or 1.0))
    heading = np.radians(turn_degps) * mag_time_s
    field = np.column_stack([20 * np.cos(heading), -20 * np.sin(heading), 0 * heading + 40.0])
    return samples(
        SIDES[4] + rng.normal(0, accel_noise, (n, 3)),
        bias + np.array([0, 0, np.radians(turn_degps)]) + rng.normal(0, gyro_noise, (n, 3)),
        mag_time_s,
        field + rng.normal(0, 0.5, field.shape) + [10.0, -5.0, 3.0],
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("mag_hz", [0.0, 15.0, 75.0])
def test_rest_gives_the_gyro_bias(seed: int, mag_hz: float) -> None:
    gyro = solver.gyro_at_rest(lying(10.0, mag_hz=mag_hz, seed=seed))
    assert gyro.mean(axis=0) == pytest.approx(GYRO_BIAS, abs=2e-4)


@pytest.mark.parametrize("turn_degps", [-2.8, 2.8, 1.0])
def test_steady_turn_is_no_rest(turn_degps: float) -> None:
    turn = lying(20.0, turn_degps)
    assert len(solver.still_windows(turn)) >= 19, "as quiet as on a table"
    with pytest.raises(solver.CalibrationError, match="3 s of rest"):
        solver.gyro_at_rest(turn)


def test_rest_is_found_among_the_turns_of_a_log() -> None:
    log = joined(lying(20.0, 2.8), lying(8.0, seed=1), lying(30.0, -2.8))
    after = solver.calibrate_gyro(log, NodeCalibration())
    assert after.gyro_bias_radps == pytest.approx(tuple(GYRO_BIAS), abs=5e-4)
    assert after.gyro_residual_radps < 0.003


def test_contradicting_rests_are_refused_without_a_magnetometer() -> None:
    log = joined(lying(8.0, mag_hz=0.0), lying(8.0, 2.8, mag_hz=0.0))
    with pytest.raises(solver.CalibrationError, match=r"2.8 °/s: .*turned steadily"):
        solver.gyro_at_rest(log)


def test_samples_in_motion_by_gps_are_no_rest() -> None:
    flown = lying(10.0, 2.8, mag_hz=0.0)
    assert solver.rest_spans(flown)
    flown.moving[:] = True
    assert solver.still_windows(flown) == []


@pytest.mark.parametrize(
    ("shape", "scale", "is_still"),
    [
        ({"gyro_noise": 0.8 * solver.STILL_GYRO_RADPS}, 1.0, True),
        ({"gyro_noise": 1.2 * solver.STILL_GYRO_RADPS}, 1.0, False),
        ({"accel_noise": 0.8 * solver.STILL_ACCEL_MPS2}, 1.0, True),
        ({"accel_noise": 1.2 * solver.STILL_ACCEL_MPS2}, 1.0, False),
        ({"bias": np.array([0.95 * solver.MAX_GYRO_BIAS_RADPS, 0, 0])}, 1.0, True),
        ({"bias": np.array([1.05 * solver.MAX_GYRO_BIAS_RADPS, 0, 0])}, 1.0, False),
        # The specific force of a banked turn.
        ({}, 1.14, True),
        ({}, 1.17, False),
    ],
)
def test_noise_bias_and_specific_force_limit_stillness(
    shape: dict[str, float], scale: float, is_still: bool
) -> None:
    found = lying(5.0, **shape)
    found.accel[:] *= scale
    assert bool(solver.still_windows(found)) == is_still


def test_rest_lasts_at_least_three_seconds() -> None:
    assert solver.rest_spans(lying(2.9)) == []
    assert solver.rest_spans(lying(3.5)) != []


def test_still_windows_and_poses_of_a_log() -> None:
    rng = np.random.default_rng(3)
    time_s = np.arange(0, 40, 0.01)
    side = SIDES[(time_s // 6).astype(int) % 6]
    turning = (time_s % 6) > 4
    accel = side + rng.normal(0, np.where(turning, 3.0, 0.02)[:, None], side.shape)
    gyro = rng.normal(0, np.where(turning, 1.0, 0.002)[:, None], side.shape)
    windows = solver.still_windows(samples(accel, gyro))
    assert 20 <= len(windows) <= 28
    poses = solver.distinct_poses(accel, windows)
    assert len(poses) == 6
    np.testing.assert_allclose(np.sort(poses[:, 0]), np.sort(SIDES[:, 0]), atol=0.05)


CALIBRATION = NodeCalibration(
    mounting=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    accel_bias_mps2=(0.1, -0.2, 0.3),
    accel_matrix=((1.1, 0.02, 0.0), (0.0, 0.9, 0.01), (0.0, 0.0, 1.05)),
    gyro_bias_radps=(0.01, 0.02, 0.03),
    mag_hard_iron_ut=(5.0, 6.0, 7.0),
    mag_soft_iron=((1.0, 0.1, 0.0), (0.1, 1.2, 0.0), (0.0, 0.0, 0.8)),
)
ERROR = (0.25, -0.5, 0.125)


def corrections(cal: NodeCalibration) -> dict[str, Correction]:
    return {
        "accel": Correction(cal.mounting, cal.accel_matrix, cal.accel_bias_mps2),
        "gyro": Correction(cal.mounting, IDENTITY3, cal.gyro_bias_radps),
        "mag": Correction(cal.mag_mounting, cal.mag_soft_iron, cal.mag_hard_iron_ut),
    }


@pytest.mark.parametrize("seed", range(4))
def test_joined_calibrations_equal_one_after_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def near_identity() -> Matrix3:
        rows = (np.eye(3) + 0.05 * rng.normal(size=(3, 3))).tolist()
        return tuple(map(tuple, rows))

    correction = msgspec.structs.replace(
        solver.IN_BODY_AXES,
        mounting=tuple(map(tuple, Rotation.random(random_state=seed).as_matrix().tolist())),
        accel_bias_mps2=ERROR,
        accel_matrix=near_identity(),
        gyro_bias_radps=ERROR,
        mag_hard_iron_ut=ERROR,
        mag_soft_iron=near_identity(),
        mag_residual_ut=0.5,
    )
    joined = solver.corrected_by(CALIBRATION, correction)
    raw = tuple(rng.normal(size=3).tolist())
    for sensor, both in corrections(joined).items():
        first = corrections(CALIBRATION)[sensor].apply(raw)
        assert both.apply(raw) == pytest.approx(corrections(correction)[sensor].apply(first))
    assert joined.mag_residual_ut == 0.5


def test_correction_of_one_sensor_leaves_the_others_to_the_last_bit() -> None:
    one = msgspec.structs.replace(solver.IN_BODY_AXES, gyro_bias_radps=ERROR)
    joined = solver.corrected_by(CALIBRATION, one)
    changed = {n for n in joined.__struct_fields__ if getattr(joined, n) != getattr(CALIBRATION, n)}
    assert changed == {"gyro_bias_radps"}


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 215.0])
def test_known_heading_gives_the_hard_iron(yaw_deg: float) -> None:
    field = MagneticField(math.radians(3.0), math.radians(64.0), 48.0)
    q_nb = from_euler(0.1, -0.2, math.radians(yaw_deg))
    north = 48.0 * math.cos(math.radians(64.0)) * np.array([math.cos(0.05236), math.sin(0.05236)])
    field_b = rotate_inverse(q_nb, (*north, 48.0 * math.sin(math.radians(64.0))))
    samples = pose(np.array(rotate_inverse(q_nb, (0.0, 0.0, -G))) - ACCEL_BIAS)
    offset = np.array([9.0, 8.0, 7.0])
    samples = replace(samples, mag_time_s=samples.time_s, mag=np.tile(field_b, (500, 1)) + offset)
    yaw_rad, axes = math.radians(yaw_deg), solver.IN_BODY_AXES
    found = solver.calibrate_magnetometer_by_yaw(samples, axes, yaw_rad, field)
    assert found.mag_hard_iron_ut == pytest.approx((9.0, 8.0, 7.0), abs=0.05)


def test_measured_tilt_is_removed() -> None:
    level, tilt = (0.0, 0.0, -G), (0.1, -0.05, 0.0)
    raw = np.array(CALIBRATION.mounting).T @ rotate_inverse(from_euler(*tilt), level)
    turned = solver.remove_tilt(CALIBRATION, tilt)
    assert np.array(turned.mounting) @ raw == pytest.approx(np.array(level), abs=1e-12)
    by = np.array(turned.mounting) @ np.array(CALIBRATION.mounting).T
    assert np.array(turned.mag_mounting) == pytest.approx(by @ CALIBRATION.mag_mounting, abs=1e-12)


def test_field_sides_count_directions_about_the_hard_iron() -> None:
    all_sides = sphere(np.random.default_rng(1), 4000, 45.0)
    offset = np.array([40.0, -25.0, 10.0])

    def seen(field: np.ndarray) -> int:
        return solver.field_sides(samples(NO_VECTORS, NO_VECTORS, NO_TIMES, field))

    assert seen(NO_VECTORS) == 0
    assert seen(np.tile(offset, (50, 1))) <= 1
    assert seen(all_sides + offset) == solver.FIELD_SIDES
    assert seen(all_sides * [1.0, 1.0, 0.05] + offset) < solver.FIELD_SIDES // 4
    assert seen(all_sides[all_sides[:, 0] > 0.0] + offset) < 0.8 * solver.FIELD_SIDES
