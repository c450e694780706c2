"""The steps of a calibration: what to measure, and how it changes the node's calibration.

Each step takes the samples of the operator's poses and the calibration so far, and returns the
calibration with its own part replaced. A log runs through the same steps.
"""

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.geometry.rotation import Matrix3
from gateway.records import Vec3
from gateway.sensing.calibration import Correction, NodeCalibration
from gateway.sensing.recalibration import remove_tilt
from gateway.sensing.solvers import (
    CalibrationError,
    NodeSamples,
    distinct_poses,
    solve_accelerometer,
    solve_magnetometer,
    solve_mounting,
    solve_rest,
)
from gateway.sensing.stillness import NOT_STILL, gyro_at_rest, still_windows
from gateway.units import STANDARD_GRAVITY_MPS2

FloatArray = NDArray[np.float64]

SIDES: Final = (
    *("x arrow up", "x arrow down", "y arrow up", "y arrow down"),
    *("chips up", "chips down"),
)
"""How the board lies when +x, -x, +y, -y, +z, -z reads gravity."""
FIELD_SIDES: Final = 24
FIELD_SPREAD: Final = 0.7
"""Least to greatest extent of readings on the axes; soft iron stretches them by some 20 %."""
SIDE_SHARE: Final = 0.8
"""Share of gravity that one axis must carry: 37 deg of tilt."""


def calibrate_gyro(samples: NodeSamples, calibration: NodeCalibration) -> NodeCalibration:
    """Take the mean rate at rest as the gyroscope's bias."""
    fit = solve_rest(gyro_at_rest(samples))
    return msgspec.structs.replace(
        calibration, gyro_bias_radps=fit.mean, gyro_residual_radps=fit.residual
    )


def calibrate_accelerometer(
    samples: Sequence[NodeSamples], calibration: NodeCalibration
) -> NodeCalibration:
    """Fit the accelerometer to the poses in the samples, each part one or more of them."""
    poses = [distinct_poses(s.accel, still_windows(s)) for s in samples]
    fit = solve_accelerometer(_distinct(np.vstack([np.empty((0, 3)), *poses])))
    return msgspec.structs.replace(
        calibration,
        accel_bias_mps2=fit.bias,
        accel_matrix=fit.matrix,
        accel_residual_mps2=fit.residual,
    )


def calibrate_magnetometer(
    samples: NodeSamples, calibration: NodeCalibration, strength_ut: float | None = None
) -> NodeCalibration:
    """Fit hard and soft iron to a field that was seen from all sides."""
    fit = solve_magnetometer(samples.mag, strength_ut)
    return msgspec.structs.replace(
        calibration,
        mag_hard_iron_ut=fit.bias,
        mag_soft_iron=fit.matrix,
        mag_residual_ut=fit.residual,
    )


def calibrate_mounting(
    level: NodeSamples, nose_up: NodeSamples, calibration: NodeCalibration
) -> NodeCalibration:
    """Find the mounting from a level and a nose-up pose; the magnetometer's turns with it."""
    mounting = solve_mounting(_force(level, calibration), _force(nose_up, calibration))
    # Both chips are on one board: their orientation to each other stays.
    between = np.linalg.solve(np.array(calibration.mounting), np.array(calibration.mag_mounting))
    return msgspec.structs.replace(
        calibration, mounting=mounting, mag_mounting=_matrix(np.array(mounting) @ between)
    )


def calibrate_level(samples: NodeSamples, calibration: NodeCalibration) -> NodeCalibration:
    """Correct the mounting by the small tilt that is measured on a level aircraft."""
    x, y, z = np.array(calibration.mounting) @ np.array(_force(samples, calibration))
    roll, pitch = np.arctan2(-y, -z), np.arctan2(x, np.hypot(y, z))
    return remove_tilt(calibration, (float(roll), float(pitch), 0.0))


def missing_sides(samples: Sequence[NodeSamples]) -> list[str]:
    """Name the sides on which the node was not laid yet, for the operator."""
    means = [distinct_poses(s.accel, still_windows(s)) for s in samples]
    seen = set()
    for mean in np.vstack([np.empty((0, 3)), *means]):
        axis = int(np.abs(mean).argmax())
        if abs(mean[axis]) > SIDE_SHARE * STANDARD_GRAVITY_MPS2:
            seen.add(2 * axis + int(mean[axis] < 0.0))
    return [name for number, name in enumerate(SIDES) if number not in seen]


def field_sides(samples: NodeSamples) -> int:
    """Count the sides, of `FIELD_SIDES`, from which the magnetometer has seen the field.

    Hard iron is not known yet, so directions are taken from the middle of the readings. It is found
    only once the readings spread alike on all axes; until then fewer sides count.
    """
    if len(samples.mag) == 0:
        return 0
    low, high = samples.mag.min(axis=0), samples.mag.max(axis=0)
    direction = samples.mag - 0.5 * (low + high)
    # Each face of a cube around the middle, in four.
    axis = np.abs(direction).argmax(axis=1)
    others = np.take_along_axis(direction, (axis[:, np.newaxis] + [0, 1, 2]) % 3, axis=1) > 0.0
    sides = len(np.unique(axis * 8 + others @ [4, 2, 1]))
    extent = high - low
    spread = extent.min() / extent.max() if extent.max() > 0.0 else 0.0
    return int(sides * min(1.0, spread / FIELD_SPREAD))


def is_still(samples: NodeSamples) -> bool:
    """Return whether the node lay still for at least one window."""
    return bool(still_windows(samples))


def _distinct(poses: FloatArray) -> FloatArray:
    return distinct_poses(poses, [slice(k, k + 1) for k in range(len(poses))])


def _force(samples: NodeSamples, calibration: NodeCalibration) -> Vec3:
    """Mean specific force at rest, bias and scale taken out, in sensor axes."""
    parts = [samples.accel[window] for window in still_windows(samples)]
    if not parts:
        raise CalibrationError(NOT_STILL)
    mean = solve_rest(np.vstack(parts)).mean
    identity: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return Correction(identity, calibration.accel_matrix, calibration.accel_bias_mps2).apply(mean)


def _matrix(m: FloatArray) -> Matrix3:
    a, b, c = ((float(r[0]), float(r[1]), float(r[2])) for r in m)
    return (a, b, c)
