"""Calibration from measurements: what a person's poses and turns tell about a node.

Every solver takes uncorrected samples (SI, sensor axes) and gives the parameters of
`NodeCalibration` together with the residual that tells how well they fit. They serve a log as
well as the live link.

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
from gateway.units import STANDARD_GRAVITY_MPS2

FloatArray = NDArray[np.float64]

STILL_S: Final = 1.0
STILL_GYRO_RADPS: Final = 0.05
STILL_ACCEL_MPS2: Final = 0.5
"""Greatest standard deviation of an axis within a still window."""
SAME_POSE_DEG: Final = 20.0
MIN_POSES: Final = 6
POSES_FOR_SKEW: Final = 9
"""From so many poses on, axes that are not square to one another can be told."""
MIN_TILT_DEG: Final = 15.0
MIN_SPREAD: Final = 1.0
"""Least way along every axis, in radii, over which a magnetometer must have been turned."""
MIN_MAG_SAMPLES: Final = 100


class CalibrationError(ValueError):
    """Measurements that do not determine what was asked; the text says what to do."""


@dataclass(frozen=True, slots=True)
class SphereFit:
    """Bias and matrix that bring vectors onto a sphere: `matrix @ (s - bias)`."""

    bias: Vec3
    matrix: Matrix3
    residual: float
    """RMS of the radius after the correction, in the unit of the samples."""
    residual_before: float
    """The same without it."""


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
    mag: FloatArray
    """Shape (m, 3), uT, only what was sampled anew."""


def node_samples(records: Sequence[ImuRaw]) -> NodeSamples:
    """Scale raw records without correcting them.

    Parameters
    ----------
    records : sequence of ImuRaw
        Of one node, in their order.

    Returns
    -------
    NodeSamples
    """
    fields = [
        mag_from_counts(r.mag_raw, r.mag_lsb_per_gauss)
        for r in records
        if ImuFlags.MAG_NEW in r.flags and ImuFlags.MAG_ABSENT not in r.flags
    ]
    return NodeSamples(
        time_s=np.array([r.time_us * 1e-6 for r in records]),
        accel=_rows([accel_from_counts(r.accel_raw, r.accel_range_g) for r in records]),
        gyro=_rows([gyro_from_counts(r.gyro_raw, r.gyro_range_dps) for r in records]),
        mag=_rows([field for field in fields if field is not None]),
    )


def still_windows(time_s: FloatArray, accel: FloatArray, gyro: FloatArray) -> list[slice]:
    """Find the spans of a log in which the node lay still.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Growing.
    accel, gyro : ndarray, shape (n, 3)
        m/s2 and rad/s, any axes.

    Returns
    -------
    list of slice
        Windows of `STILL_S`, in order, not overlapping.
    """
    if len(time_s) == 0:
        return []
    edges = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], STILL_S))
    found = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        window = slice(begin, end)
        if end - begin < 5:
            continue
        quiet = gyro[window].std(axis=0).max() < STILL_GYRO_RADPS
        if quiet and accel[window].std(axis=0).max() < STILL_ACCEL_MPS2:
            found.append(window)
    return found


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
        One row per pose; windows that point alike are averaged.
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

    Parameters
    ----------
    samples : ndarray, shape (n, 3)

    Returns
    -------
    RestFit

    Raises
    ------
    CalibrationError
        If there are none.
    """
    if len(samples) == 0:
        raise CalibrationError("the node did not lie still: lay it down and do not touch it")
    return RestFit(_vec3(samples.mean(axis=0)), float(samples.std(axis=0).max()))


def solve_accelerometer(poses: FloatArray) -> SphereFit:
    """Fit bias and scale so that every pose reads one gravity [1]_.

    Parameters
    ----------
    poses : ndarray, shape (m, 3)
        Mean specific force of each pose, m/s2, sensor axes; six or more, one on each side. Nine
        or more also tell the skew of the axes.

    Returns
    -------
    SphereFit
        In m/s2.

    Raises
    ------
    CalibrationError
        If poses are missing.
    """
    if len(poses) < MIN_POSES:
        raise CalibrationError(f"{len(poses)} poses where {MIN_POSES} are needed, one on each side")
    _check_spread(poses, STANDARD_GRAVITY_MPS2, "lay the node on every one of its six sides")
    return _fit_sphere(poses, STANDARD_GRAVITY_MPS2, skew=len(poses) >= POSES_FOR_SKEW)


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
        If it was not turned enough.
    """
    if len(field) < MIN_MAG_SAMPLES:
        raise CalibrationError(f"{len(field)} samples where {MIN_MAG_SAMPLES} are needed")
    centre = _sphere_centre(field)
    radius = float(np.linalg.norm(field - centre, axis=1).mean())
    _check_spread(field, radius, "turn the aircraft about all its axes, upside down too")
    return _fit_sphere(field, strength_ut or radius, skew=True, start=centre)


def solve_mounting(level: Vec3, nose_up: Vec3) -> Matrix3:
    """Find how the node is mounted from two poses of the aircraft.

    Parameters
    ----------
    level : tuple of 3 floats
        Mean specific force in sensor axes while the aircraft stood level.
    nose_up : tuple of 3 floats
        The same with the nose raised, by 15 to 90 deg.

    Returns
    -------
    Matrix3
        Rows of the rotation from sensor axes to body FRD.

    Raises
    ------
    CalibrationError
        If the two are too much alike.
    """
    up = np.array(level) / np.linalg.norm(level)
    raised = np.array(nose_up) / np.linalg.norm(nose_up)
    if _angle_deg(up, raised) < MIN_TILT_DEG:
        raise CalibrationError(f"raise the nose by more than {MIN_TILT_DEG:.0f} deg")
    # With the nose up the specific force leans forward in the body.
    forward = raised - up * (up @ raised)
    x = forward / np.linalg.norm(forward)
    z = -up
    return _matrix(np.array([x, np.cross(z, x), z]))


def level_residual_deg(mounting: Matrix3, level: Vec3) -> float:
    """Tell by what angle a level pose seems tilted under a mounting."""
    force_b = np.array(mounting) @ np.array(level)
    return _angle_deg(force_b, np.array([0.0, 0.0, -1.0]))


def _fit_sphere(
    points: FloatArray, radius: float, *, skew: bool, start: FloatArray | None = None
) -> SphereFit:
    """Least squares on the radius; the matrix is symmetric, for a turn leaves no trace in it."""
    centre = _sphere_centre(points) if start is None else start
    scale = radius / float(np.linalg.norm(points - centre, axis=1).mean())
    guess = np.array([*centre, scale, scale, scale, *([0.0, 0.0, 0.0] if skew else [])])

    def off(x: FloatArray) -> FloatArray:
        moved = (points - x[:3]) @ _symmetric(x[3:])
        return np.asarray(np.linalg.norm(moved, axis=1) - radius)

    found = least_squares(off, guess, x_scale=np.maximum(np.abs(guess), 1e-3))
    before = np.linalg.norm(points, axis=1) - radius
    return SphereFit(
        bias=_vec3(found.x[:3]),
        matrix=_matrix(_symmetric(found.x[3:])),
        residual=float(np.sqrt(np.mean(off(found.x) ** 2))),
        residual_before=float(np.sqrt(np.mean(before**2))),
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


def _rows(vectors: list[Vec3]) -> FloatArray:
    return np.array(vectors, float).reshape(-1, 3)


def _angle_deg(a: FloatArray, b: FloatArray) -> float:
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _vec3(v: FloatArray) -> Vec3:
    return (float(v[0]), float(v[1]), float(v[2]))


def _matrix(m: FloatArray) -> Matrix3:
    return (_vec3(m[0]), _vec3(m[1]), _vec3(m[2]))
