"""Calibration from measurements: sensor errors from an operator's poses and turns.

Every solver takes uncorrected samples (SI, sensor axes) and returns the parameters of
`NodeCalibration` together with the residual, which shows how well they fit. They work on a log and
on the live link.

References
----------
.. [1] I. Frosio, F. Pedersini and N. A. Borghese, "Autocalibration of MEMS accelerometers",
   IEEE Trans. Instrumentation and Measurement 58(6), 2009.
.. [2] T. Ozyagcilar, "Calibrating an eCompass in the presence of hard- and soft-iron
   interference", Freescale AN4246, 2015.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gateway.geometry.rotation import Matrix3
from gateway.records import ImuFlags, ImuRaw, Vec3
from gateway.sensing.calibration import (
    accel_from_counts,
    gyro_from_counts,
    mag_from_counts,
)
from gateway.units import STANDARD_GRAVITY_MPS2, counted

FloatArray = NDArray[np.float64]

SAME_POSE_DEG: Final = 20.0
MIN_POSES: Final = 6
POSES_FOR_SKEW: Final = 9
"""With at least this many poses, axes that are not orthogonal can be fitted."""
MIN_TILT_DEG: Final = 15.0
MIN_SPREAD: Final = 1.0
"""Least way along every axis, in radii, over which a magnetometer must have been turned."""
MIN_MAG_SAMPLES: Final = 100

# No intact sensor of this kind has larger errors: the poses were wrong.
MAX_ACCEL_BIAS_MPS2: Final = 2.0
"""Twice what the MPU6050's data sheet allows, for what soldering adds."""
MAX_ACCEL_SCALE_OFF: Final = 0.15
MAX_ACCEL_RESIDUAL_MPS2: Final = 0.5
FIELD_UT: Final = (15.0, 100.0)
"""Strength of the field: the Earth's is 22 to 67 uT, the sensor's scale may be off by a third."""
MAX_HARD_IRON_UT: Final = 200.0
MAX_SOFT_IRON: Final = 2.0
"""Longest axis of the ellipsoid over the shortest."""
MAX_MAG_RESIDUAL: Final = 0.1
"""Share of the field's strength."""


class CalibrationError(ValueError):
    """Measurements that do not determine the calibration; the text says what to do."""


@dataclass(frozen=True, slots=True)
class SphereFit:
    """Bias and matrix that bring vectors onto a sphere: `matrix @ (s - bias)`."""

    bias: Vec3
    matrix: Matrix3
    residual: float
    """RMS of the radius after the correction, in the unit of the samples."""


@dataclass(frozen=True, slots=True)
class RestFit:
    """A mean over samples at rest."""

    mean: Vec3
    residual: float
    """Standard deviation of the worst axis."""


@dataclass(frozen=True, slots=True)
class NodeSamples:
    """Samples of one node in SI and sensor axes, nothing corrected."""

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
    """Shape (n,), where the node moves according to GPS."""


def node_samples(records: Sequence[ImuRaw], moving: Sequence[bool] | None = None) -> NodeSamples:
    """Scale raw records without correcting them."""
    fields = [
        (r.time_us * 1e-6, field)
        for r in records
        if ImuFlags.MAG_NEW in r.flags
        and ImuFlags.MAG_ABSENT not in r.flags
        and (field := mag_from_counts(r.mag_raw, r.mag_lsb_per_gauss)) is not None
    ]
    return NodeSamples(
        time_s=np.array([r.time_us * 1e-6 for r in records]),
        accel=_rows([accel_from_counts(r.accel_raw, r.accel_range_g) for r in records]),
        gyro=_rows([gyro_from_counts(r.gyro_raw, r.gyro_range_dps) for r in records]),
        mag_time_s=np.array([time_s for time_s, _ in fields]),
        mag=_rows([field for _, field in fields]),
        moving=np.zeros(len(records), np.bool_) if moving is None else np.array(moving, np.bool_),
    )


def distinct_poses(accel: FloatArray, windows: list[slice]) -> FloatArray:
    """Average the specific force of each pose that the node was laid in.

    Parameters
    ----------
    accel : ndarray, shape (n, 3)
        m/s2, sensor axes.
    windows : list of slice
        See `still_windows`.

    Returns
    -------
    ndarray, shape (m, 3)
        One row per pose; windows of the same direction are averaged.
    """
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


def solve_rest(samples: FloatArray) -> RestFit:
    """Average samples at rest: the bias of a gyroscope, the direction of gravity.

    `stillness` decides whether they are at rest.

    Parameters
    ----------
    samples : ndarray, shape (n, 3)

    Returns
    -------
    RestFit

    """
    return RestFit(_vec3(samples.mean(axis=0)), float(samples.std(axis=0).max()))


def solve_accelerometer(poses: FloatArray) -> SphereFit:
    """Fit bias and scale so that every pose reads one gravity [1]_.

    Parameters
    ----------
    poses : ndarray, shape (m, 3)
        Mean specific force of each pose, m/s2, sensor axes; six or more, one on each side. Nine or
        more also determine the skew of the axes.

    Returns
    -------
    SphereFit
        In m/s2.

    Raises
    ------
    CalibrationError
        If poses are missing, or if the result is too large for a sensor error.
    """
    if len(poses) < MIN_POSES:
        found = counted(len(poses), "pose")
        raise CalibrationError(f"{found} where {MIN_POSES} are needed, one on each side")
    _check_spread(poses, STANDARD_GRAVITY_MPS2, "lay the node on every one of its six sides")
    fit = _fit_sphere(poses, STANDARD_GRAVITY_MPS2, skew=len(poses) >= POSES_FOR_SKEW)
    scale_off = float(np.abs(np.linalg.eigvalsh(np.array(fit.matrix)) - 1.0).max())
    advice = "hold every side still; a sensor that always does this is broken"
    _check_bound("bias", _length(fit.bias), MAX_ACCEL_BIAS_MPS2, " m/s2", advice)
    _check_bound("scale error", scale_off, MAX_ACCEL_SCALE_OFF, "", advice)
    _check_bound("residual", fit.residual, MAX_ACCEL_RESIDUAL_MPS2, " m/s2", advice)
    return fit


def solve_magnetometer(field: FloatArray, strength_ut: float | None = None) -> SphereFit:
    """Fit hard and soft iron so that the field has one strength all round [2]_.

    Parameters
    ----------
    field : ndarray, shape (n, 3)
        uT, sensor axes, while the aircraft was turned about all its axes.
    strength_ut : float, optional
        Strength to scale to; the mean of the samples about their centre if not known.

    Returns
    -------
    SphereFit
        In uT.

    Raises
    ------
    CalibrationError
        If it was not turned enough, or if the measured field cannot be the Earth's.
    """
    if len(field) < MIN_MAG_SAMPLES:
        found = counted(len(field), "sample")
        raise CalibrationError(f"{found} where {MIN_MAG_SAMPLES} are needed")
    centre = _sphere_centre(field)
    radius = float(np.linalg.norm(field - centre, axis=1).mean())
    _check_spread(field, radius, "turn the aircraft about all its axes, upside down too")
    advice = "keep away from iron and currents, and turn it further"
    if not FIELD_UT[0] <= radius <= FIELD_UT[1]:
        raise CalibrationError(f"a field of {radius:.0f} uT is not the Earth's: {advice}")
    fit = _fit_sphere(field, strength_ut or radius, skew=True, start=centre)
    axes = np.abs(np.linalg.eigvalsh(np.array(fit.matrix)))
    _check_bound("hard iron", _length(fit.bias), MAX_HARD_IRON_UT, " uT", advice)
    _check_bound("soft iron", float(axes.max() / axes.min()), MAX_SOFT_IRON, "", advice)
    _check_bound("residual", fit.residual, MAX_MAG_RESIDUAL * radius, " uT", advice)
    return fit


def solve_mounting(level: Vec3, nose_up: Vec3) -> Matrix3:
    """Find how the node is mounted from two poses of the aircraft."""
    up = np.array(level) / np.linalg.norm(level)
    raised = np.array(nose_up) / np.linalg.norm(nose_up)
    if _angle_deg(up, raised) < MIN_TILT_DEG:
        raise CalibrationError(f"raise the nose by more than {MIN_TILT_DEG:.0f} deg")
    # With the nose up the specific force leans forward in the body.
    forward = raised - up * (up @ raised)
    x = forward / np.linalg.norm(forward)
    z = -up
    return _matrix(np.array([x, np.cross(z, x), z]))


def _fit_sphere(
    points: FloatArray, radius: float, *, skew: bool, start: FloatArray | None = None
) -> SphereFit:
    """Fit the radius by least squares; the matrix is symmetric: no rotation is observable."""
    centre = _sphere_centre(points) if start is None else start
    scale = radius / float(np.linalg.norm(points - centre, axis=1).mean())
    guess = np.array([*centre, scale, scale, scale, *([0.0, 0.0, 0.0] if skew else [])])

    def off(x: FloatArray) -> FloatArray:
        moved = (points - x[:3]) @ _symmetric(x[3:])
        return np.asarray(np.linalg.norm(moved, axis=1) - radius)

    found = least_squares(off, guess, x_scale=np.maximum(np.abs(guess), 1e-3))
    return SphereFit(
        bias=_vec3(found.x[:3]),
        matrix=_matrix(_symmetric(found.x[3:])),
        residual=float(np.sqrt(np.mean(off(found.x) ** 2))),
    )


def _symmetric(x: FloatArray) -> FloatArray:
    a, b, c = x[:3]
    d, e, f = x[3:] if len(x) > 3 else (0.0, 0.0, 0.0)
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


def _sphere_centre(points: FloatArray) -> FloatArray:
    """Solve `2 c . p + k = |p|^2` for the centre."""
    design = np.column_stack([2.0 * points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)
    return np.asarray(solution[:3])


def _check_spread(points: FloatArray, radius: float, advice: str) -> None:
    if np.ptp(points, axis=0).min() < MIN_SPREAD * radius:
        raise CalibrationError(f"not all directions were seen: {advice}")


def _check_bound(what: str, found: float, bound: float, unit: str, advice: str) -> None:
    if not found <= bound:
        raise CalibrationError(f"{what} {found:.2f}{unit}, where {bound:.2f} is the most: {advice}")


def _length(v: Vec3) -> float:
    return float(np.linalg.norm(v))


def _rows(vectors: list[Vec3]) -> FloatArray:
    return np.array(vectors, float).reshape(-1, 3)


def _angle_deg(a: FloatArray, b: FloatArray) -> float:
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _vec3(v: FloatArray) -> Vec3:
    return (float(v[0]), float(v[1]), float(v[2]))


def _matrix(m: FloatArray) -> Matrix3:
    return (_vec3(m[0]), _vec3(m[1]), _vec3(m[2]))
