"""Whether gyroscope and accelerometer may be believed."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

STUCK_S: Final = 1.0
"""The same three numbers for so long, while the other sensor moves: the sensor is stuck."""
HOLD_S: Final = 0.2
"""A missing angular rate or force is held so long; then there is no turn, and gravity alone."""
GYRO_LIMIT_RADPS: Final = 40.0
ACCEL_LIMIT_MPS2: Final = 400.0
"""No sensor of this system reads more; what does is no measurement."""
TIMES_USUAL_HOLD: Final = 5.0
USUAL_HOLD_S: Final = 5.0
"""What both sensors repeat for this much longer than usual, on average over so long, is a hang."""
UNKNOWN_HOLD_S: Final = 60.0
"""So long they may usually repeat a sample before anything is known of them."""
USUAL_S: Final = 0.5
TIMES_USUAL: Final = 6.0
"""Noise and vibration change this much more at most."""
FASTEST_CHANGE_RADPS: Final = 2.0
FASTEST_TURN_RADPS2: Final = 200.0
FASTEST_CHANGE_MPS2: Final = 10.0
FASTEST_JERK_MPS3: Final = 1000.0
"""What an agile multirotor does, and a blow that is over within a sample."""
START_LEAST_MPS2: Final = 0.5 * STANDARD_GRAVITY_MPS2
START_MOST_MPS2: Final = 2.0 * STANDARD_GRAVITY_MPS2


class HealthState:
    """What the judgement needs to remember."""

    fault: int
    """1 while the newest sample was not usable as it came."""
    sound_s: float
    """Time since one was not, or since the last silence."""
    stuck_gyro_s: float
    stuck_accel_s: float
    repeated_s: float
    """For how long both sensors have repeated a sample."""
    usual_hold_s: float
    """For how long they usually do."""
    hangs: int
    """1 while they do so for too long."""
    missing_gyro_s: float
    missing_accel_s: float
    gyro_last: Annotated[FloatArray, (3,)]
    accel_last: Annotated[FloatArray, (3,)]
    gyro_held: Annotated[FloatArray, (3,)]
    accel_held: Annotated[FloatArray, (3,)]
    """The newest that were believed."""
    gyro_usual: float
    accel_usual: float
    """Change from sample to sample, on average over `USUAL_S`."""


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
def change_from(v: Vec3, last: FloatArray) -> float:
    """Return how far a vector is from another."""
    x, y, z = v[0] - last[0], v[1] - last[1], v[2] - last[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def least_change(v: Vec3, last: FloatArray, held: FloatArray) -> float:
    """Return how far a vector is from the last one, or if that is less, from the last believed."""
    change, from_last = change_from(v, held), change_from(v, last)
    return from_last if from_last < change else change


@compiled
def follow_change(usual: float, change: float, most: float, dt: float) -> float:
    """Return the average change with one more; one that is odd counts as the most that is not."""
    kept = USUAL_S / (USUAL_S + dt)
    return kept * usual + (1.0 - kept) * min(change, most)


@compiled
def is_odd(s: HealthState, gyro: Vec3, accel: Vec3, dt: float) -> bool:
    """Return whether a sample is far from all before it: noise on the sensors' bus, most often.

    A change that is real is seen by the next sample too. A bus that fails spoils both sensors.
    """
    gyro_most = FASTEST_CHANGE_RADPS + FASTEST_TURN_RADPS2 * dt + TIMES_USUAL * s.gyro_usual
    accel_most = FASTEST_CHANGE_MPS2 + FASTEST_JERK_MPS3 * dt + TIMES_USUAL * s.accel_usual
    turned = least_change(gyro, s.gyro_last, s.gyro_held)
    pulled = least_change(accel, s.accel_last, s.accel_held)
    if math.isfinite(turned + pulled):
        s.gyro_usual = follow_change(s.gyro_usual, turned, gyro_most, dt)
        s.accel_usual = follow_change(s.accel_usual, pulled, accel_most, dt)
    return turned > gyro_most or pulled > accel_most


@compiled
def is_blank(gyro: Vec3, accel: Vec3) -> bool:
    """Return whether a sample is all zeros, as of a sensor that has just been reset."""
    return not (gyro[0] or gyro[1] or gyro[2] or accel[0] or accel[1] or accel[2])


@compiled
def is_hanging(s: HealthState, gyro: Vec3, accel: Vec3, may_rest: bool, dt: float) -> bool:
    """Return whether both sensors have repeated a sample for too long; to be asked at each one.

    The bus of a sensor may hang, or a receiver repeat its last frame. A live sensor repeats no six
    numbers for long, but a log may hold each sample until the next, and an input without noise is
    always the same at rest, or in a motion that is written by hand.

    Parameters
    ----------
    s : HealthState
        Changed in place.
    gyro, accel : tuple of 3 floats
        Newest sample.
    may_rest : bool
        Whether that may be a rest.
    dt : float
        Time step, s.
    """
    if is_same(gyro, s.gyro_last) and is_same(accel, s.accel_last):
        s.repeated_s += dt
        most_s = max(HOLD_S, TIMES_USUAL_HOLD * s.usual_hold_s)
        s.hangs = 1 if s.repeated_s > most_s and not may_rest else 0
        return s.hangs == 1
    if s.hangs == 0:
        held_s = s.repeated_s + dt
        kept = USUAL_HOLD_S / (USUAL_HOLD_S + held_s)
        s.usual_hold_s = kept * s.usual_hold_s + (1.0 - kept) * held_s
    s.repeated_s, s.hangs = 0.0, 0
    return False


@compiled
def check_sensors(
    s: HealthState, gyro: Vec3, accel: Vec3, clipped: float, dt: float
) -> tuple[bool, bool]:
    """Return whether gyroscope and accelerometer may be believed, and set the fault.

    Parameters
    ----------
    s : HealthState
        Changed in place.
    gyro, accel : tuple of 3 floats
        Newest sample.
    clipped : float
        1 where a sensor touched the end of its range, which is a fault.
    dt : float
        Time step, s.

    Returns
    -------
    tuple of 2 bools
        False where a value is not finite or out of reason, stands still while the other moves, or
        is far from what came before, which alone is no fault.
    """
    same_gyro, same_accel = is_same(gyro, s.gyro_last), is_same(accel, s.accel_last)
    # Both standing still is a hang, or a perfectly quiet input: see `is_hanging`.
    s.stuck_gyro_s = s.stuck_gyro_s + dt if same_gyro and not same_accel else 0.0
    s.stuck_accel_s = s.stuck_accel_s + dt if same_accel and not same_gyro else 0.0
    odd = is_odd(s, gyro, accel, dt) or is_blank(gyro, accel)
    write_vec(s.gyro_last, gyro)
    write_vec(s.accel_last, accel)
    good_gyro = is_sound(gyro, GYRO_LIMIT_RADPS) and s.stuck_gyro_s < STUCK_S
    good_accel = is_sound(accel, ACCEL_LIMIT_MPS2) and s.stuck_accel_s < STUCK_S
    s.fault = 0 if good_gyro and good_accel and clipped == 0.0 else 1
    s.sound_s = s.sound_s + dt if s.fault == 0 else 0.0
    good_gyro, good_accel = good_gyro and not odd, good_accel and not odd
    if good_gyro:
        write_vec(s.gyro_held, gyro)
        s.missing_gyro_s = 0.0
    else:
        s.missing_gyro_s += dt
    if good_accel:
        write_vec(s.accel_held, accel)
        s.missing_accel_s = 0.0
    else:
        s.missing_accel_s += dt
    return good_gyro, good_accel


@compiled
def clipped_squares(s: HealthState) -> tuple[float, float]:
    """Return squares of what a sensor at the end of its range may leave out: as much as it tells.

    Returns
    -------
    tuple of 2 floats
        Of the angular rate, (rad/s)2, and of the specific force, (m/s2)2.
    """
    gyro, accel = s.gyro_held, s.accel_held
    return (
        gyro[0] * gyro[0] + gyro[1] * gyro[1] + gyro[2] * gyro[2],
        accel[0] * accel[0] + accel[1] * accel[1] + accel[2] * accel[2],
    )


@compiled
def rate_instead(s: HealthState, bias: Vec3) -> Vec3:
    """Return the rate for a sample without a good one: the last for a moment, then no turn."""
    return as_vec(s.gyro_held) if s.missing_gyro_s < HOLD_S else bias


@compiled
def force_instead(s: HealthState, level: Vec3) -> Vec3:
    """Return the force for a sample without a good one: the last for a moment, then gravity's."""
    return as_vec(s.accel_held) if s.missing_accel_s < HOLD_S else level
