"""A node's calibration: counts in sensor axes to SI in body FRD."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Annotated, Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.geometry.rotation import Matrix3, is_rotation
from gateway.records import ImuFlags, ImuRaw, Int3, Vec3
from gateway.settings import Settings, setting
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2, UT_PER_GAUSS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

IDENTITY3: Final[Matrix3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FACE_UP: Final[Matrix3] = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Sensor x forward, y left, z up: the board is face up with its x arrow to the nose."""

FULL_SCALE_COUNTS: Final = 32768.0
GYRO_LSB_PER_DPS: Final = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
"""Counts per deg/s by range; MPU6050 register map, section 4.19."""
MAG_OVERFLOW: Final = -4096
"""Value of the HMC5883L for an axis beyond its range."""

_NO_OFFSET: Final[Vec3] = (0.0, 0.0, 0.0)

_Accel = Annotated[float, msgspec.Meta(ge=-50, le=50)]
_Rate = Annotated[float, msgspec.Meta(ge=-10, le=10)]
_Field = Annotated[float, msgspec.Meta(ge=-1000, le=1000)]
_Share = Annotated[float, msgspec.Meta(ge=-10, le=10)]
"""Bounds of the errors: a third of full scale of acceleration and rate, full scale of the field."""
_Rows = tuple[
    tuple[_Share, _Share, _Share], tuple[_Share, _Share, _Share], tuple[_Share, _Share, _Share]
]
_FLAT: Final = 1e-3
"""Determinant below which a matrix counts as singular."""
Number = TypeVar("Number", float, FloatArray)


class NodeCalibration(Settings, frozen=True):
    """The sensor errors of one IMU node, and its mounting.

    A calibrated vector is `R @ M @ (s - b)`: `s` in SI and sensor axes, `b` the bias, `M` the
    scale and misalignment, `R` the mounting rotation into body FRD.
    """

    mounting: Annotated[
        _Rows,
        setting(
            "Rotation from accelerometer and gyroscope axes to body FRD: rows of the matrix in "
            "settings files, angles as parameters.",
            rotation=True,
        ),
    ] = FACE_UP
    accel_bias_mps2: Annotated[
        tuple[_Accel, _Accel, _Accel],
        setting("Accelerometer bias in sensor axes; all zero if never calibrated.", "m/s2"),
    ] = _NO_OFFSET
    accel_matrix: Annotated[
        _Rows, setting("Rows of the accelerometer's scale and misalignment matrix.")
    ] = IDENTITY3
    gyro_bias_radps: Annotated[
        tuple[_Rate, _Rate, _Rate],
        setting("Gyroscope bias in sensor axes; all zero if never calibrated.", "rad/s"),
    ] = _NO_OFFSET
    mag_mounting: Annotated[
        _Rows,
        setting(
            "Rotation from magnetometer axes to body FRD: rows of the matrix in settings files, "
            "angles as parameters.",
            rotation=True,
        ),
    ] = FACE_UP
    mag_hard_iron_ut: Annotated[
        tuple[_Field, _Field, _Field],
        setting(
            "Field of the aircraft's own magnets in sensor axes; all zero if never calibrated.",
            "uT",
        ),
    ] = _NO_OFFSET
    mag_soft_iron: Annotated[
        _Rows, setting("Rows of the matrix that turns the measured ellipsoid into a sphere.")
    ] = IDENTITY3
    gyro_residual_radps: Annotated[
        float,
        setting("Residual of the last calibration: deviation at rest.", "rad/s", ge=0.0, le=10.0),
    ] = 0.0
    accel_residual_mps2: Annotated[
        float,
        setting(
            "Residual of the last calibration: difference between the poses.",
            "m/s2",
            ge=0.0,
            le=100.0,
        ),
    ] = 0.0
    mag_residual_ut: Annotated[
        float,
        setting(
            "Residual of the last calibration: difference of the field's strength.",
            "uT",
            ge=0.0,
            le=1000.0,
        ),
    ] = 0.0

    @property
    def missing(self) -> ImuFlags:
        """Flags of the sensors that were never calibrated, those with a bias of zero."""
        missing = ImuFlags.MAG_UNCALIBRATED if self.mag_hard_iron_ut == _NO_OFFSET else ImuFlags(0)
        missing |= ImuFlags.GYRO_UNCALIBRATED if self.gyro_bias_radps == _NO_OFFSET else 0
        return missing | (ImuFlags.ACCEL_UNCALIBRATED if self.accel_bias_mps2 == _NO_OFFSET else 0)

    def __post_init__(self) -> None:
        """Refuse matrices that are not rotations, or have no inverse."""
        for name in ("mounting", "mag_mounting"):
            if not is_rotation(getattr(self, name)):
                raise ValueError(f"{name} must be a rotation: orthogonal rows of length one")
        for name in ("accel_matrix", "mag_soft_iron"):
            if abs(np.linalg.det(getattr(self, name))) < _FLAT:
                raise ValueError(f"{name} must have an inverse: no row made of the others")


def compose(left: Matrix3, right: Matrix3) -> Matrix3:
    """Multiply two matrices: first `right`, then `left`."""
    (a, b, c), (d, e, f), (g, h, i) = right

    def row(x: float, y: float, z: float) -> Vec3:
        return (x * a + y * d + z * g, x * b + y * e + z * h, x * c + y * f + z * i)

    return (row(*left[0]), row(*left[1]), row(*left[2]))


@cache
def accel_scale(range_g: int) -> float:
    """Return m/s2 per count of the accelerometer."""
    return range_g * STANDARD_GRAVITY_MPS2 / FULL_SCALE_COUNTS


@cache
def gyro_scale(range_dps: int) -> float:
    """Return rad/s per count of the gyroscope."""
    per_count_dps = 1.0 / GYRO_LSB_PER_DPS.get(range_dps, FULL_SCALE_COUNTS / max(range_dps, 1))
    return per_count_dps * RAD_PER_DEG


@cache
def mag_scale(lsb_per_gauss: int) -> float:
    """Return uT per count of the magnetometer; NaN if its gain is unknown."""
    return UT_PER_GAUSS / lsb_per_gauss if lsb_per_gauss > 0 else math.nan


def mag_from_counts(raw: Int3, lsb_per_gauss: int) -> Vec3 | None:
    """Scale magnetometer counts to uT in sensor axes; None on an overflow, or if all are zero."""
    if lsb_per_gauss <= 0 or MAG_OVERFLOW in raw or not any(raw):
        return None
    scale = mag_scale(lsb_per_gauss)
    return (raw[0] * scale, raw[1] * scale, raw[2] * scale)


def temperature_from_counts(raw: Number) -> Number:
    """Convert the IMU's temperature word, or many of them, to deg C."""
    return raw / 340.0 + 36.53


def imu_counts(records: Sequence[ImuRaw]) -> FloatArray:
    """Return the counts of IMU payloads as columns; see `SensorChain.calibrated`."""
    rows = [
        (*r.accel_raw, *r.gyro_raw, *r.mag_raw, r.temperature_raw, *_ranges(r)) for r in records
    ]
    return np.array(rows, np.float64).reshape(-1, 13)


def _ranges(r: ImuRaw) -> Int3:
    return (r.accel_range_g, r.gyro_range_dps, r.mag_lsb_per_gauss)


def vectors_from_counts(
    scale_of: Callable[[int], float], counts: FloatArray, ranges: FloatArray
) -> FloatArray:
    """Scale an array of counts, shape (n, 3), each vector by its own range."""
    scaled = np.empty(counts.shape)
    for one in np.unique(ranges).tolist():
        scaled[ranges == one] = counts[ranges == one] * scale_of(int(one))
    return scaled


def new_field_ut(counts: FloatArray, flags: IntArray) -> FloatArray:
    """Scale the magnetometer's counts of many payloads to uT in sensor axes; NaN unless new."""
    state, raw = flags & int(ImuFlags.MAG_NEW | ImuFlags.MAG_ABSENT), counts[:, 6:9]
    is_new = state == int(ImuFlags.MAG_NEW)
    is_valid = raw.any(axis=1) & (raw != MAG_OVERFLOW).all(axis=1)
    field = vectors_from_counts(mag_scale, raw, counts[:, 12])
    field[~(is_new & is_valid)] = np.nan
    return field


class Correction:
    """One sensor's calibration, with its matrices multiplied: `v_b = matrix @ (v_s - bias)`."""

    def __init__(self, mounting: Matrix3, matrix: Matrix3, bias: Vec3) -> None:
        self._matrix = compose(mounting, matrix)
        self._bias = bias
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._matrix
        self._numbers = (xx, xy, xz, yx, yy, yz, zx, zy, zz, *bias)

    def apply(self, v: Vec3, scale: float = 1.0) -> Vec3:
        """Scale and correct one vector, such as counts, and rotate it into body axes."""
        # `transform` inlined, since this runs for every sensor of every sample.
        xx, xy, xz, yx, yy, yz, zx, zy, zz, bias_x, bias_y, bias_z = self._numbers
        x, y, z = v
        x, y, z = x * scale - bias_x, y * scale - bias_y, z * scale - bias_z
        return (xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z)

    def apply_all(self, vectors: FloatArray) -> FloatArray:
        """Correct an array of shape (n, 3), with exactly the results of `apply` for each row."""
        x, y, z = (column - bias for column, bias in zip(vectors.T, self._bias, strict=True))
        return np.column_stack([a * x + b * y + c * z for a, b, c in self._matrix])
