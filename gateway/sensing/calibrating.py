"""Calibration from measurements: one solver for every way to calibrate.

Samples of an operator's poses and turns become the parameters of a `NodeCalibration`, with the
residual that shows how well they fit. `mavgate calibrate`, a recording and the commands of a ground
station use the same steps. Samples are raw, in sensor axes, or calibrated already, in body axes:
then the steps start from `IN_BODY_AXES`, and `corrected_by` combines the two calibrations.

A sensor with low noise is not necessarily at rest. In a steady turn the gyroscope has as little
noise as on a table, and its mean is the turn rate; but then the magnetic field rotates, and GPS
measures the motion.

References
----------
.. [1] I. Frosio, F. Pedersini and N. A. Borghese, "Autocalibration of MEMS accelerometers",
   IEEE Trans. Instrumentation and Measurement 58(6), 2009.
.. [2] T. Ozyagcilar, "Calibrating an eCompass in the presence of hard- and soft-iron
   interference", Freescale AN4246, 2015.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.geometry.geomagnetism import MagneticField
from gateway.geometry.quaternion import body_axes, from_euler, rotate_inverse, tilt
from gateway.geometry.rotation import Matrix3
from gateway.records import ImuRaw, Vec3
from gateway.sensing.calibration import (
    IDENTITY3,
    Correction,
    NodeCalibration,
    accel_scale,
    gyro_scale,
    imu_counts,
    new_field_ut,
    vectors_from_counts,
)
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2, counted

FloatArray = NDArray[np.float64]

SAME_POSE_DEG: Final = 20.0
MIN_POSES: Final = 6
POSES_FOR_SKEW: Final = 9
"""Least number of poses for a fit of axes that are not orthogonal."""
MIN_TILT_DEG: Final = 15.0
MIN_SPREAD: Final = 1.2
"""Least extent of the samples along every axis, in radii; 2 is full coverage."""
FIT_STEPS: Final = 50
FIT_STEP: Final = 1e-9
"""Relative step of the parameters below which the fit ends."""
MIN_MAG_SAMPLES: Final = 100

# Larger errors mean wrong poses: no intact sensor of this kind has them.
MAX_ACCEL_BIAS_MPS2: Final = 2.0
"""Twice the limit of the MPU6050's data sheet, since soldering increases the bias."""
MAX_ACCEL_SCALE_OFF: Final = 0.15
MAX_ACCEL_RESIDUAL_MPS2: Final = 0.5
FIELD_UT: Final = (15.0, 100.0)
"""Accepted field strength: the Earth's is 22 to 67 uT, and the scale may be wrong by a third."""
MAX_HARD_IRON_UT: Final = 200.0
IRON_ADVICE: Final = "keep away from steel and currents"
MAX_SOFT_IRON: Final = 2.0
"""Maximum ratio of the longest axis of the ellipsoid to the shortest."""
MAX_MAG_RESIDUAL: Final = 0.1
"""Maximum residual as a share of the field strength."""


STILL_S: Final = 1.0
STILL_GYRO_RADPS: Final = 0.02
STILL_ACCEL_MPS2: Final = 0.3
"""Maximum standard deviation of an axis in a still window: ten times the MPU6050's noise."""
MIN_WINDOW_SAMPLES: Final = 5

MAX_GYRO_BIAS_RADPS: Final = 20.0 * RAD_PER_DEG
"""Maximum bias according to the MPU6050's data sheet: a larger rate is a rotation."""
MAX_FORCE_OFF_MPS2: Final = 1.5
"""Maximum deviation from gravity at rest, by bias and scale of an uncalibrated sensor."""
REST_WINDOWS: Final = 3
"""Least number of successive still windows of a rest: in fewer, a slow turn is not detected."""
MAX_FIELD_DRIFT_UTPS: Final = 0.2
"""Maximum change of the field at rest: that of a turn of 0.6 °/s at mid latitudes, and three times
that of noise."""
MIN_FIELD_SAMPLES: Final = 20
MAX_RESTS_APART_RADPS: Final = 0.02
"""Maximum difference of the mean rates of rests in one log; more means that one was a turn."""

NOT_STILL: Final = "the node was not at rest: lay it down and do not touch it"

FIELD_SIDES: Final = 24
FIELD_SPREAD: Final = 0.7
"""Least ratio of the extents of readings on the axes; soft iron stretches them by some 20 %."""
SIDE_SHARE: Final = 0.8
"""Least share of gravity on one axis: 37 deg of tilt."""
MAX_TILT_RAD: Final = 30.0 * RAD_PER_DEG
"""Maximum tilt of the mounting; a larger one means that the aircraft was not level."""

IN_BODY_AXES: Final = NodeCalibration(mounting=IDENTITY3, mag_mounting=IDENTITY3)
"""Calibration of samples that are already calibrated."""
_PARTS: Final = (
    ("mounting", "accel_matrix", "accel_bias_mps2", "accel_residual_mps2"),
    ("mounting", "", "gyro_bias_radps", "gyro_residual_radps"),
    ("mag_mounting", "mag_soft_iron", "mag_hard_iron_ut", "mag_residual_ut"),
)
"""Names of rotation, matrix, bias and residual of each sensor."""


class CalibrationStep(StrEnum):
    """The calibrations, in the recommended order."""

    MOUNTING = "mounting"
    GYRO = "gyro"
    ACCEL = "accel"
    LEVEL = "level"
    MAG = "mag"


class CalibrationError(ValueError):
    """Measurements that do not determine the calibration; the text gives the remedy."""


class MoreNeeded(CalibrationError):  # noqa: N818 - not an error while samples are collected
    """Not all directions were measured yet."""


@dataclass(frozen=True, slots=True)
class NodeSamples:
    """Samples of one node in SI; in sensor axes and uncorrected, or in body axes."""

    time_s: FloatArray
    """Shape (n,)."""
    accel: FloatArray
    """Shape (n, 3), m/s2."""
    gyro: FloatArray
    """Shape (n, 3), rad/s."""
    mag_time_s: FloatArray
    """Shape (m,), only new samples."""
    mag: FloatArray
    """Shape (m, 3), uT."""
    moving: NDArray[np.bool_]
    """Shape (n,), True where the node moves according to GPS."""


def node_samples(records: Sequence[ImuRaw], moving: Sequence[bool] | None = None) -> NodeSamples:
    """Scale raw records without correcting them."""
    time_s, counts = np.array([r.time_us * 1e-6 for r in records]), imu_counts(records)
    field = new_field_ut(counts, np.array([int(r.flags) for r in records], np.int64))
    is_new = np.isfinite(field[:, 0])
    return NodeSamples(
        time_s=time_s,
        accel=vectors_from_counts(accel_scale, counts[:, 0:3], counts[:, 10]),
        gyro=vectors_from_counts(gyro_scale, counts[:, 3:6], counts[:, 11]),
        mag_time_s=time_s[is_new],
        mag=field[is_new],
        moving=np.zeros(len(records), np.bool_) if moving is None else np.array(moving, np.bool_),
    )


def distinct_poses(accel: FloatArray, windows: list[slice]) -> FloatArray:
    """Average the specific force of each pose of the node."""
    poses: list[list[FloatArray]] = []
    for window in windows:
        mean = np.asarray(accel[window].mean(axis=0))
        for pose in poses:
            if _angle_deg(np.mean(pose, axis=0), mean) < SAME_POSE_DEG:
                pose.append(mean)
                break
        else:
            poses.append([mean])
    return np.array([np.mean(pose, axis=0) for pose in poses]).reshape(-1, 3)


def fit_accelerometer(poses: FloatArray, calibration: NodeCalibration) -> NodeCalibration:
    """Fit bias and scale so that every pose, shape (n, 3), measures one gravity [1]_."""
    if len(poses) < MIN_POSES:
        found = counted(len(poses), "pose")
        raise MoreNeeded(f"{found} where {MIN_POSES} are needed, one on each side")
    _check_spread(poses, STANDARD_GRAVITY_MPS2, "lay the node on every one of its six sides")
    skew = len(poses) >= POSES_FOR_SKEW
    bias, matrix, residual = _fit_sphere(poses, STANDARD_GRAVITY_MPS2, skew=skew)
    scale_off = float(np.abs(np.linalg.eigvalsh(np.array(matrix)) - 1.0).max())
    advice = "hold every side still; a sensor that always does this is broken"
    _check_bound("bias", math.hypot(*bias), MAX_ACCEL_BIAS_MPS2, " m/s2", advice)
    _check_bound("scale error", scale_off, MAX_ACCEL_SCALE_OFF, "", advice)
    _check_bound("residual", residual, MAX_ACCEL_RESIDUAL_MPS2, " m/s2", advice)
    return msgspec.structs.replace(
        calibration, accel_bias_mps2=bias, accel_matrix=matrix, accel_residual_mps2=residual
    )


def calibrate_magnetometer(
    field: FloatArray, calibration: NodeCalibration, strength_ut: float | None = None
) -> NodeCalibration:
    """Fit hard and soft iron so that the field has the same strength in all directions [2]_.

    Parameters
    ----------
    field : ndarray, shape (n, 3)
        Field in sensor axes, uT, while the aircraft was turned about all its axes.
    calibration : NodeCalibration
        Its other values are kept.
    strength_ut : float, optional
        Strength to scale to; by default the mean of the samples about their centre.

    Raises
    ------
    CalibrationError
        If it was not turned enough, or if the measured field cannot be the Earth's.
    """
    if len(field) < MIN_MAG_SAMPLES:
        found = counted(len(field), "sample")
        raise MoreNeeded(f"{found} where {MIN_MAG_SAMPLES} are needed")
    centre, _ = _sphere(field)
    radius = float(np.linalg.norm(field - centre, axis=1).mean())
    # At rest the radius of the fit would be that of the noise alone.
    least_ut = max(radius, FIELD_UT[0])
    _check_spread(field, least_ut, "turn the aircraft about all its axes, upside down too")
    advice = f"{IRON_ADVICE}, and turn it further"
    if not FIELD_UT[0] <= radius <= FIELD_UT[1]:
        text = f"the fit gave {radius:.0f} uT, which is not the Earth's field"
        raise CalibrationError(f"{text}: {advice}")
    bias, matrix, residual = _fit_sphere(field, strength_ut or radius, skew=True, start=centre)
    axes = np.abs(np.linalg.eigvalsh(np.array(matrix)))
    _check_bound("hard iron", math.hypot(*bias), MAX_HARD_IRON_UT, " uT", advice)
    _check_bound("soft iron", float(axes.max() / axes.min()), MAX_SOFT_IRON, "", advice)
    _check_bound("residual", residual, MAX_MAG_RESIDUAL * radius, " uT", advice)
    return msgspec.structs.replace(
        calibration, mag_hard_iron_ut=bias, mag_soft_iron=matrix, mag_residual_ut=residual
    )


def solve_mounting(level: Vec3, nose_up: Vec3) -> Matrix3:
    """Find the mounting of the node from two poses of the aircraft."""
    up = np.array(level) / np.linalg.norm(level)
    raised = np.array(nose_up) / np.linalg.norm(nose_up)
    if _angle_deg(up, raised) < MIN_TILT_DEG:
        raise CalibrationError(f"raise the nose by more than {MIN_TILT_DEG:.0f}°")
    # With the nose up the specific force has a forward component in the body.
    forward = raised - up * (up @ raised)
    x = forward / np.linalg.norm(forward)
    z = -up
    return _matrix(np.array([x, np.cross(z, x), z]))


def _fit_sphere(
    points: FloatArray, radius: float, *, skew: bool, start: FloatArray | None = None
) -> tuple[Vec3, Matrix3, float]:
    """Fit the radius by least squares (Gauss-Newton).

    Returns bias and symmetric matrix that bring the points onto the sphere, `matrix @ (p - bias)`,
    and the RMS error of the radius.

    With `d = p - c`, `u = A d` and `n = u / |u|` the residual is `|u| - radius`, its derivatives
    are `-A n` by the centre and `n_j d_k + n_k d_j` by an element of the matrix.
    """
    centre = _sphere(points)[0] if start is None else start
    scale = radius / float(np.linalg.norm(points - centre, axis=1).mean())
    x = np.array([*centre, scale, scale, scale, *([0.0, 0.0, 0.0] if skew else [])])
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))[: len(x) - 3]
    for _ in range(FIT_STEPS):
        matrix, apart = _symmetric(x[3:]), points - x[:3]
        moved = apart @ matrix
        lengths = np.linalg.norm(moved, axis=1)
        normals = moved / lengths[:, np.newaxis]
        slopes = [
            normals[:, j] * apart[:, k] + (normals[:, k] * apart[:, j] if j != k else 0.0)
            for j, k in pairs
        ]
        jacobian = np.column_stack([-(normals @ matrix), *slopes])
        step, *_ = np.linalg.lstsq(jacobian, radius - lengths, rcond=None)
        x = x + step
        if np.abs(step).max() <= FIT_STEP * np.abs(x).max():
            break
    lengths = np.linalg.norm((points - x[:3]) @ _symmetric(x[3:]), axis=1)
    residual = float(np.sqrt(np.mean((lengths - radius) ** 2)))
    return _vec3(x[:3]), _matrix(_symmetric(x[3:])), residual


def _symmetric(x: FloatArray) -> FloatArray:
    a, b, c = x[:3]
    d, e, f = x[3:] if len(x) > 3 else (0.0, 0.0, 0.0)
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


def fit_sphere(points: FloatArray) -> tuple[Vec3, float]:
    """Fit a sphere by linear least squares: `|p|^2 = 2 c.p + (r^2 - |c|^2)`.

    Returns centre and radius of at least four points, shape (n, 3); the radius is NaN if they are
    not on a sphere.
    """
    centre, rest = _sphere(points)
    square = rest + float(centre @ centre)
    return _vec3(centre), math.sqrt(square) if square > 0.0 else math.nan


def _sphere(points: FloatArray) -> tuple[FloatArray, float]:
    design = np.column_stack([2.0 * points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)
    return np.asarray(solution[:3]), float(solution[3])


def _check_spread(points: FloatArray, radius: float, advice: str) -> None:
    if np.ptp(points, axis=0).min() < MIN_SPREAD * radius:
        raise MoreNeeded(f"not all directions were measured: {advice}")


def _check_bound(what: str, found: float, bound: float, unit: str, advice: str) -> None:
    if not found <= bound:
        raise CalibrationError(f"{what} {found:.2f}{unit} is above {bound:.2f}: {advice}")


def _angle_deg(a: FloatArray, b: FloatArray) -> float:
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _vec3(v: FloatArray) -> Vec3:
    return (float(v[0]), float(v[1]), float(v[2]))


def _matrix(m: FloatArray) -> Matrix3:
    return (_vec3(m[0]), _vec3(m[1]), _vec3(m[2]))


def still_windows(samples: NodeSamples) -> list[slice]:
    """Find the spans of a log in which the node was still."""
    time_s = samples.time_s
    if len(time_s) == 0:
        return []
    edges = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], STILL_S))
    windows = [slice(*pair) for pair in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    return [window for window in windows if _is_still(samples, window)]


def rest_spans(samples: NodeSamples) -> list[slice]:
    """Find the spans in which the node was still and did not turn."""
    spans = []
    for run in _runs(still_windows(samples)):
        for begin in range(0, len(run) - REST_WINDOWS + 1, REST_WINDOWS):
            last = len(run) if len(run) - begin < 2 * REST_WINDOWS else begin + REST_WINDOWS
            span = slice(run[begin].start, run[last - 1].stop)
            if not _turns(samples, span):
                spans.append(span)
    return spans


def gyro_at_rest(samples: NodeSamples) -> FloatArray:
    """Return the gyroscope's samples at rest, whose mean is its bias."""
    spans = rest_spans(samples)
    if not spans:
        raise CalibrationError(f"no {REST_WINDOWS * STILL_S:.0f} s of rest: {NOT_STILL}")
    means = np.array([samples.gyro[span].mean(axis=0) for span in spans])
    apart = float(np.ptp(means, axis=0).max())
    if apart > MAX_RESTS_APART_RADPS:
        raise CalibrationError(
            f"the rates of {len(spans)} apparent rests differ by {apart / RAD_PER_DEG:.1f} °/s: "
            "the node turned steadily in some of them; calibrate from a recording on the ground"
        )
    return np.vstack([samples.gyro[span] for span in spans])


def _is_still(samples: NodeSamples, window: slice) -> bool:
    gyro, accel = samples.gyro[window], samples.accel[window]
    if len(gyro) < MIN_WINDOW_SAMPLES or samples.moving[window].any():
        return False
    quiet = gyro.std(axis=0).max() < STILL_GYRO_RADPS
    if not quiet or accel.std(axis=0).max() >= STILL_ACCEL_MPS2:
        return False
    force_mps2 = float(np.linalg.norm(accel.mean(axis=0)))
    slow = np.abs(gyro.mean(axis=0)).max() <= MAX_GYRO_BIAS_RADPS
    return bool(slow and abs(force_mps2 - STANDARD_GRAVITY_MPS2) <= MAX_FORCE_OFF_MPS2)


def _runs(windows: list[slice]) -> list[list[slice]]:
    runs: list[list[slice]] = []
    for window in windows:
        if runs and runs[-1][-1].stop == window.start:
            runs[-1].append(window)
        else:
            runs.append([window])
    return runs


def _turns(samples: NodeSamples, span: slice) -> bool:
    """Return whether the field rotated; False without a magnetometer."""
    begin_s, end_s = samples.time_s[span.start], samples.time_s[span.stop - 1]
    within: NDArray[np.bool_] = (samples.mag_time_s >= begin_s) & (samples.mag_time_s <= end_s)
    if int(within.sum()) < MIN_FIELD_SAMPLES:
        return False
    slope = np.polyfit(samples.mag_time_s[within] - begin_s, samples.mag[within], 1)[0]
    return float(np.linalg.norm(slope)) > MAX_FIELD_DRIFT_UTPS


def calibrate_gyro(samples: NodeSamples, calibration: NodeCalibration) -> NodeCalibration:
    """Use the mean rate at rest as the gyroscope's bias."""
    gyro = gyro_at_rest(samples)
    return msgspec.structs.replace(
        calibration,
        gyro_bias_radps=_vec3(gyro.mean(axis=0)),
        gyro_residual_radps=float(gyro.std(axis=0).max()),
    )


def calibrate_accelerometer(
    samples: Sequence[NodeSamples], calibration: NodeCalibration
) -> NodeCalibration:
    """Fit the accelerometer to the poses in the samples; each part has one or more poses."""
    poses = _poses_of(samples)
    distinct = distinct_poses(poses, [slice(k, k + 1) for k in range(len(poses))])
    return fit_accelerometer(distinct, calibration)


def calibrate_mounting(
    level: NodeSamples, nose_up: NodeSamples, calibration: NodeCalibration
) -> NodeCalibration:
    """Find the mounting from a level and a nose-up pose; the magnetometer's is rotated with it."""
    mounting = solve_mounting(_force(level, calibration), _force(nose_up, calibration))
    # Both chips are on one board, so their relative orientation does not change.
    between = np.linalg.solve(np.array(calibration.mounting), np.array(calibration.mag_mounting))
    return msgspec.structs.replace(
        calibration, mounting=mounting, mag_mounting=_matrix(np.array(mounting) @ between)
    )


def calibrate_level(samples: NodeSamples, calibration: NodeCalibration) -> NodeCalibration:
    """Correct the mounting by the small tilt measured on a level aircraft."""
    x, y, z = np.array(calibration.mounting) @ np.array(_force(samples, calibration))
    roll, pitch = tilt((x, y, z))
    if max(abs(roll), abs(pitch)) > MAX_TILT_RAD:
        raise CalibrationError("it was not level")
    return remove_tilt(calibration, (roll, pitch, 0.0))


def calibrate_accelerometer_level(
    samples: NodeSamples, calibration: NodeCalibration
) -> NodeCalibration:
    """Use the specific force of a level aircraft beyond gravity as the accelerometer's bias."""
    x, y, z = np.array(calibration.mounting) @ np.array(_force(samples, calibration))
    error_b = np.array([x, y, z + STANDARD_GRAVITY_MPS2])
    if np.abs(error_b).max() > MAX_ACCEL_BIAS_MPS2:
        raise CalibrationError("it was moved or not level")
    shift = msgspec.structs.replace(IN_BODY_AXES, accel_bias_mps2=_vec3(error_b))
    return corrected_by(calibration, shift)


def calibrate_magnetometer_by_yaw(
    samples: NodeSamples, calibration: NodeCalibration, yaw_rad: float, field: MagneticField
) -> NodeCalibration:
    """Use the field beyond the Earth's, at rest at a known true heading, as hard iron.

    The samples are already calibrated, in body axes; `calibration` is `IN_BODY_AXES`.
    """
    windows = still_windows(samples)
    if not windows or len(samples.mag) < MIN_FIELD_SAMPLES:
        raise CalibrationError(NOT_STILL if not windows else "there is no magnetometer")
    q_nb = from_euler(*tilt(_force(samples, calibration)), yaw_rad)
    level = field.strength_ut * math.cos(field.inclination_rad)
    north = level * math.cos(field.declination_rad), level * math.sin(field.declination_rad)
    down = field.strength_ut * math.sin(field.inclination_rad)
    error_b = samples.mag.mean(axis=0) - np.array(rotate_inverse(q_nb, (*north, down)))
    _check_bound("hard iron", float(np.linalg.norm(error_b)), MAX_HARD_IRON_UT, " uT", IRON_ADVICE)
    return msgspec.structs.replace(calibration, mag_hard_iron_ut=_vec3(error_b))


def corrected_by(calibration: NodeCalibration, correction: NodeCalibration) -> NodeCalibration:
    """Combine a calibration with one that was measured on samples calibrated by it.

    If the first gives `v = R1 M1 (s - b1)` and the second `R2 M2 (v - b2)`, both together are
    `R M (s - b)` with `R = R2 R1`, `M = R1' M2 R1 M1` and `b = b1 + inv(R1 M1) b2`.
    """
    changes: dict[str, object] = {}
    for rotation, matrix, bias, residual in _PARTS:
        mounting = np.array(getattr(calibration, rotation))
        own = np.array(getattr(calibration, matrix)) if matrix else np.eye(3)
        by = np.array(getattr(correction, matrix)) if matrix else np.eye(3)
        turn, shift = np.array(getattr(correction, rotation)), np.array(getattr(correction, bias))
        if (turn != np.eye(3)).any():
            changes[rotation] = _matrix(turn @ mounting)
        if matrix and (by != np.eye(3)).any():
            changes[matrix] = _matrix(mounting.T @ by @ mounting @ own)
        if shift.any():
            moved = np.linalg.solve(mounting @ own, shift)
            changes[bias] = _vec3(np.array(getattr(calibration, bias)) + moved)
        if getattr(correction, residual):
            changes[residual] = getattr(correction, residual)
    return msgspec.structs.replace(calibration, **changes)


def sides_of(samples: Sequence[NodeSamples]) -> set[int]:
    """Return the lower sides: 0 to 5 where +x, -x, +y, -y, +z, -z measures gravity."""
    seen = set()
    for mean in _poses_of(samples):
        axis = int(np.abs(mean).argmax())
        if abs(mean[axis]) > SIDE_SHARE * STANDARD_GRAVITY_MPS2:
            seen.add(2 * axis + int(mean[axis] < 0.0))
    return seen


def field_sides(samples: NodeSamples) -> int:
    """Count the sides, of `FIELD_SIDES`, from which the magnetometer has measured the field.

    Hard iron is not known yet, so directions are from the middle of the readings. That is correct
    only once the readings have equal spreads on all axes; until then fewer sides count.
    """
    if len(samples.mag) == 0:
        return 0
    low, high = samples.mag.min(axis=0), samples.mag.max(axis=0)
    direction = samples.mag - 0.5 * (low + high)
    # Each face of a cube around the middle is divided into four.
    axis = np.abs(direction).argmax(axis=1)
    others = np.take_along_axis(direction, (axis[:, np.newaxis] + [0, 1, 2]) % 3, axis=1) > 0.0
    sides = len(np.unique(axis * 8 + others @ [4, 2, 1]))
    extent = high - low
    spread = extent.min() / extent.max() if extent.max() > 0.0 else 0.0
    return int(sides * min(1.0, spread / FIELD_SPREAD))


def _poses_of(samples: Sequence[NodeSamples]) -> FloatArray:
    """Average the specific force of each pose in each part of the samples."""
    poses = [distinct_poses(part.accel, still_windows(part)) for part in samples]
    return np.vstack([np.empty((0, 3)), *poses])


def _force(samples: NodeSamples, calibration: NodeCalibration) -> Vec3:
    """Return the mean specific force at rest, corrected for bias and scale, in sensor axes."""
    parts = [samples.accel[window] for window in still_windows(samples)]
    if not parts:
        raise CalibrationError(NOT_STILL)
    mean = _vec3(np.vstack(parts).mean(axis=0))
    return Correction(IDENTITY3, calibration.accel_matrix, calibration.accel_bias_mps2).apply(mean)


def remove_tilt(calibration: NodeCalibration, roll_pitch_yaw_rad: Vec3) -> NodeCalibration:
    """Rotate both mountings so that an aircraft with these apparent angles is level."""
    turn = np.array(body_axes(from_euler(*roll_pitch_yaw_rad))).T
    return msgspec.structs.replace(
        calibration,
        mounting=_matrix(turn @ np.array(calibration.mounting)),
        mag_mounting=_matrix(turn @ np.array(calibration.mag_mounting)),
    )
