"""Unit quaternions of attitude: Hamilton, scalar first, body FRD to NED.

The functions take and return plain tuples of floats, so they cost the same inside a compiled
kernel and in a per-sample call; those for arrays, at the end, are compiled loops. Equation numbers
are those of Arfakhsyad et al., "UAV Data-Driven Modeling Software with Integrated 9-Axis IMU-GPS
Sensor Fusion and Data Filtering Algorithm".
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import address_of, array_at, compiled
from gateway.compiled.entry_point import EntryPoint
from gateway.records import Quat, Vec3

FloatArray = NDArray[np.float64]

_FLOAT: Final = np.dtype(np.float64)


@compiled
def multiply(p: Quat, q: Quat) -> Quat:
    """Compose two rotations: the Hamilton product `p * q`.

    It is the rotation `q` followed by `p`. Eq. 14; deviation: the printed second row has `-c1*d2`
    and the last row `b1*b2` instead of `b1*c2`, which is not a Hamilton product.
    """
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


@compiled
def normalise(q: Quat) -> Quat:
    """Scale to unit norm; the zero quaternion becomes the identity."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if norm == 0.0:
        return (1.0, 0.0, 0.0, 0.0)
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


@compiled
def difference(a: Vec3, b: Vec3) -> Vec3:
    """Subtract two vectors."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@compiled
def scaled(v: Vec3, factor: float) -> Vec3:
    """Multiply a vector by a number."""
    return (v[0] * factor, v[1] * factor, v[2] * factor)


@compiled
def is_below(v: Vec3, limit: float) -> bool:
    """Return whether every component is below a limit in magnitude; False if one is not finite."""
    return bool(abs(v[0]) < limit and abs(v[1]) < limit and abs(v[2]) < limit)


@compiled
def part_way(a: Vec3, b: Vec3, share: float) -> Vec3:
    """Interpolate linearly between two vectors; exact at the shares 0 and 1."""
    kept = 1.0 - share
    return (kept * a[0] + share * b[0], kept * a[1] + share * b[1], kept * a[2] + share * b[2])


@compiled
def norm_sq(v: Vec3) -> float:
    """Return the squared length of a vector."""
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@compiled
def rotate(q: Quat, v: Vec3) -> Vec3:
    """Rotate a vector from the body to the navigation frame: eq. 13, `q * v * conj(q)`."""
    w, x, y, z = q
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


@compiled
def rotate_inverse(q: Quat, v: Vec3) -> Vec3:
    """Rotate a vector from the navigation to the body frame."""
    return rotate((q[0], -q[1], -q[2], -q[3]), v)


@compiled
def body_axes(q: Quat) -> tuple[Vec3, Vec3, Vec3]:
    """Return the body's three axes in the navigation frame, the columns of `R_nb`."""
    return rotate(q, (1.0, 0.0, 0.0)), rotate(q, (0.0, 1.0, 0.0)), rotate(q, (0.0, 0.0, 1.0))


@compiled
def from_rotation_vector(v: Vec3) -> Quat:
    """Convert a rotation vector, axis times angle in rad, to a unit quaternion: eq. 9 to 12."""
    angle_sq = norm_sq(v)
    if angle_sq < 1e-12:
        # Series of sin(a/2)/a, because the closed form would divide by zero.
        scale = 0.5 - angle_sq / 48.0
        return normalise((1.0 - angle_sq / 8.0, v[0] * scale, v[1] * scale, v[2] * scale))
    angle = math.sqrt(angle_sq)
    scale = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), v[0] * scale, v[1] * scale, v[2] * scale)


@compiled
def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quat:
    """Build `q_nb` from intrinsic Z-Y-X angles (yaw, then pitch, then roll)."""
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@compiled
def to_euler(q: Quat) -> Vec3:
    """Return roll, pitch and yaw of `q_nb`: roll and yaw in (-pi, pi], pitch in [-pi/2, pi/2].

    Eq. 16; deviations: the printed pitch repeats the roll's numerator, and the first denominator
    has `S4` for `S3`; the angles have their usual names (roll phi, yaw psi).
    """
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    # This order of the arguments keeps NaN.
    pitch = math.asin(max(min(2.0 * (w * y - z * x), 1.0), -1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return (roll, pitch, yaw)


@compiled
def tilt(force_b: Vec3) -> tuple[float, float]:
    """Return roll and pitch of a body from a specific force that is only gravity."""
    level = math.hypot(force_b[1], force_b[2])
    return (math.atan2(-force_b[1], -force_b[2]), math.atan2(force_b[0], level))


def from_euler_array(angles_rad: FloatArray) -> FloatArray:
    """Apply `from_euler` to each row of roll, pitch and yaw, shape (n, 3); returns (n, 4)."""
    angles = np.ascontiguousarray(angles_rad, np.float64)
    found = np.empty((len(angles), 4))
    _from_euler_array(len(angles), address_of(angles), address_of(found))
    return found


@EntryPoint
def _from_euler_array(count: int, angles_at: int, found_at: int) -> None:
    angles = array_at(angles_at, (count, 3), _FLOAT)
    found = array_at(found_at, (count, 4), _FLOAT)
    for i in range(count):
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = from_euler(
            angles[i, 0], angles[i, 1], angles[i, 2]
        )


def integrate_rate(dt_s: FloatArray, gyro_b_radps: FloatArray, q_nb: FloatArray) -> FloatArray:
    """Integrate an attitude from the angular rate alone.

    Parameters
    ----------
    dt_s : ndarray, shape (n,)
        Interval of each sample.
    gyro_b_radps : ndarray, shape (n, 3)
        Rate in body FRD.
    q_nb : ndarray, shape (4,)
        Attitude before the first sample.

    Returns
    -------
    ndarray, shape (n, 4)
        Attitude at the end of each interval.
    """
    found = np.empty((len(dt_s), 4))
    inputs = [np.ascontiguousarray(part, np.float64) for part in (dt_s, gyro_b_radps, q_nb)]
    _integrate_rate(len(found), *map(address_of, (*inputs, found)))
    return found


@EntryPoint
def _integrate_rate(count: int, dt_at: int, gyro_at: int, begin_at: int, found_at: int) -> None:
    dt_s = array_at(dt_at, (count,), _FLOAT)
    gyro = array_at(gyro_at, (count, 3), _FLOAT)
    begin = array_at(begin_at, (4,), _FLOAT)
    found = array_at(found_at, (count, 4), _FLOAT)
    q = (begin[0], begin[1], begin[2], begin[3])
    for k in range(count):
        dt = dt_s[k]
        turn = from_rotation_vector((gyro[k, 0] * dt, gyro[k, 1] * dt, gyro[k, 2] * dt))
        q = normalise(multiply(q, turn))
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = q
