"""Whether gyroscope and accelerometer may be believed."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, write_vec
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

STUCK_S: Final = 1.0
"""The same three numbers for so long, while the other sensor moves: the sensor is stuck."""
HOLD_S: Final = 0.2
"""A missing angular rate is held so long, then taken for zero."""
GYRO_LIMIT_RADPS: Final = 40.0
ACCEL_LIMIT_MPS2: Final = 400.0
"""No sensor of this system reads more; what does is no measurement."""
START_LEAST_MPS2: Final = 0.5 * STANDARD_GRAVITY_MPS2
START_MOST_MPS2: Final = 2.0 * STANDARD_GRAVITY_MPS2


class HealthState:
    """What the judgement needs to remember."""

    fault: int
    """1 while the newest sample was not usable as it came."""
    stuck_gyro_s: float
    stuck_accel_s: float
    missing_gyro_s: float
    gyro_last: Annotated[FloatArray, (3,)]
    accel_last: Annotated[FloatArray, (3,)]


@compiled
def is_sound(v: Vec3, limit: float) -> bool:
    """Return whether a vector is finite and within what a sensor can read."""
    return bool(abs(v[0]) < limit and abs(v[1]) < limit and abs(v[2]) < limit)


@compiled
def is_start(s: HealthState, gyro: Vec3, accel: Vec3) -> bool:
    """Return whether an estimator may begin with a sample, and set the fault if not.

    A sensor that has just been woken may send zeros; what is far from gravity tells no level.
    """
    norm = math.sqrt(accel[0] * accel[0] + accel[1] * accel[1] + accel[2] * accel[2])
    sound = is_sound(gyro, GYRO_LIMIT_RADPS) and is_sound(accel, ACCEL_LIMIT_MPS2)
    s.fault = 0 if sound and START_LEAST_MPS2 < norm < START_MOST_MPS2 else 1
    return s.fault == 0


@compiled
def is_same(v: Vec3, last: FloatArray) -> bool:
    """Return whether a vector repeats the last one exactly."""
    return bool(v[0] == last[0] and v[1] == last[1] and v[2] == last[2])


@compiled
def check_sensors(s: HealthState, gyro: Vec3, accel: Vec3, dt: float) -> tuple[bool, bool]:
    """Return whether gyroscope and accelerometer may be believed.

    Parameters
    ----------
    s : HealthState
        Changed in place.
    gyro, accel : tuple of 3 floats
        Newest sample.
    dt : float
        Time step, s.

    Returns
    -------
    tuple of 2 bools
        False where a value is not finite or out of reason, or stands still while the other moves.
    """
    same_gyro, same_accel = is_same(gyro, s.gyro_last), is_same(accel, s.accel_last)
    # Both standing still is a perfectly quiet input, not a fault.
    s.stuck_gyro_s = s.stuck_gyro_s + dt if same_gyro and not same_accel else 0.0
    s.stuck_accel_s = s.stuck_accel_s + dt if same_accel and not same_gyro else 0.0
    write_vec(s.gyro_last, gyro)
    write_vec(s.accel_last, accel)
    return (
        is_sound(gyro, GYRO_LIMIT_RADPS) and s.stuck_gyro_s < STUCK_S,
        is_sound(accel, ACCEL_LIMIT_MPS2) and s.stuck_accel_s < STUCK_S,
    )
