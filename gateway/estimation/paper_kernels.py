"""The equations of the paper's estimator, compiled: one sample live, or a whole log at once.

`gateway.estimation.paper` says what they are and where they deviate from the print. Both ways of
running call the same functions, so a log gives bit for bit what its samples give one at a time.
"""

import math
from typing import Final

import numpy as np

from gateway.compiled import compiled
from gateway.estimation import flagbits
from gateway.estimation.record import FloatArray, IntArray
from gateway.geometry.geodesy import offset_deg
from gateway.geometry.quaternion import (
    from_euler,
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
    to_euler,
    wrap_pi,
)
from gateway.records import Quat, Vec3
from gateway.units import STANDARD_GRAVITY_MPS2, US_PER_S

NEVER: Final = -(1 << 62)
"""A time that has not come yet."""
GAP_US: Final = 500_000
"""A longer silence is not integrated over."""
GAIN_INTERVAL_S: Final = 0.01
"""The attitude gains are given for this interval; other intervals take the matching power."""
STALE_GPS_US: Final = 1_500_000
POSITION_HOLD_US: Final = 30_000_000
"""Dead reckoning longer than this is no position any more."""
STALE_MAG_US: Final = 2_000_000
MIN_COS_PITCH: Final = 0.05
"""Nose up or down, the accelerometer does not tell the roll."""

Place = Vec3
"""Latitude and longitude in degrees, height in metres."""

SAMPLE_COLUMNS: Final = 9
"""Low-passed specific force, high-passed rate (NaN if the sample is not sound), magnetic field
(NaN unless new)."""
FIX_COLUMNS: Final = 7
"""Place and velocity of a fix carried forward by its latency, and the declination in rad."""
OUT_COLUMNS: Final = 11
"""Attitude, place, velocity, flags."""


@compiled
def is_finite(v: Vec3) -> bool:
    """Tell whether all three are finite."""
    return math.isfinite(v[0]) and math.isfinite(v[1]) and math.isfinite(v[2])


@compiled
def blend(weight: float, predicted: Vec3, measured: Vec3) -> Vec3:
    """Weigh the predicted path against the measured one; weight 0 and 1 are exact."""
    w, v = weight, 1.0 - weight
    return (
        w * predicted[0] + v * measured[0],
        w * predicted[1] + v * measured[1],
        w * predicted[2] + v * measured[2],
    )


@compiled
def blend_angle(weight: float, predicted_rad: float, measured_rad: float) -> float:
    """Weigh two angles the shortest way round."""
    return measured_rad + weight * wrap_pi(predicted_rad - measured_rad)


@compiled
def tilt_of(accel: Vec3) -> tuple[float, float]:
    """Take roll and pitch from a specific force that is gravity alone."""
    roll_rad = math.atan2(-accel[1], -accel[2])
    level = math.sqrt(accel[1] * accel[1] + accel[2] * accel[2])
    return (roll_rad, math.atan2(accel[0], level))


@compiled
def turn(q_nb: Quat, accel: Vec3, gyro: Vec3, dt_s: float, alpha_gyro: float) -> Quat:
    """First complementary filter: gyroscope against the accelerometer's tilt."""
    step = from_rotation_vector((gyro[0] * dt_s, gyro[1] * dt_s, gyro[2] * dt_s))
    q_nb = normalise(multiply(q_nb, step))
    roll_rad, pitch_rad = tilt_of(accel)
    if math.cos(pitch_rad) < MIN_COS_PITCH:
        return q_nb
    weight = alpha_gyro ** (dt_s / GAIN_INTERVAL_S)
    roll, pitch, yaw = to_euler(q_nb)
    return from_euler(
        blend_angle(weight, roll, roll_rad), blend_angle(weight, pitch, pitch_rad), yaw
    )


@compiled
def turn_to_compass(
    q_nb: Quat, mag_b_ut: Vec3, declination_rad: float, time_us: int, mag_time_us: int, alpha: float
) -> Quat:
    """Second complementary filter: yaw against the tilt-compensated compass."""
    roll, pitch, yaw = to_euler(q_nb)
    level = rotate(from_euler(roll, pitch, 0.0), mag_b_ut)
    compass = math.atan2(-level[1], level[0])
    if math.isfinite(declination_rad):
        compass += declination_rad
    weight = 0.0
    if mag_time_us != NEVER and time_us != NEVER:
        dt_s = max(time_us - mag_time_us, 0) / US_PER_S
        weight = alpha ** (dt_s / GAIN_INTERVAL_S)
    return from_euler(roll, pitch, blend_angle(weight, yaw, compass))


@compiled
def advance(q_nb: Quat, accel: Vec3, dt_s: float, place: Place, vel: Vec3) -> tuple[Place, Vec3]:
    """Third complementary filter, its inertial path: integrate twice."""
    a = rotate(q_nb, accel)
    vel = (
        vel[0] + a[0] * dt_s,
        vel[1] + a[1] * dt_s,
        vel[2] + (a[2] + STANDARD_GRAVITY_MPS2) * dt_s,
    )
    lat, lon = offset_deg(place[0], place[1], place[2], vel[0] * dt_s, vel[1] * dt_s)
    return ((lat, lon, place[2] - vel[2] * dt_s), vel)


@compiled
def blend_fix(
    alpha: float, beta: float, place: Place, vel: Vec3, fix_place: Place, fix_vel: Vec3
) -> tuple[Place, Vec3]:
    """Third complementary filter, its blend: eq. 1, 2, 7 and 8 as recursions."""
    vel = blend(alpha, vel, fix_vel)
    # The longitude may wrap between the two; blend the shortest way round.
    fix_lon = place[1] + (fix_place[1] - place[1] + 180.0) % 360.0 - 180.0
    lat, lon, alt = blend(beta, place, (fix_place[0], fix_lon, fix_place[2]))
    return ((lat, (lon + 180.0) % 360.0 - 180.0, alt), vel)


@compiled
def level_start(accel: Vec3) -> Quat:
    """Begin with the accelerometer's tilt, facing north."""
    roll, pitch = tilt_of(accel)
    return from_euler(roll, pitch, 0.0)


@compiled
def three(table: FloatArray, row: int, column: int) -> Vec3:
    """Read three neighbouring columns."""
    return (table[row, column], table[row, column + 1], table[row, column + 2])


@compiled
def write(out: FloatArray, row: int, q_nb: Quat, place: Place, vel: Vec3, flags: int) -> None:
    """Write one row of `run`."""
    out[row, 0], out[row, 1], out[row, 2], out[row, 3] = q_nb
    out[row, 4], out[row, 5], out[row, 6] = place
    out[row, 7], out[row, 8], out[row, 9] = vel
    out[row, 10] = flags


@compiled
def flags_of(
    time_us: int,
    began: bool,
    mag_time_us: int,
    declination_rad: float,
    fix_time_us: int,
    sound: bool,
) -> int:
    """Tell what holds at a time."""
    flags = flagbits.ATTITUDE_VALID if began else 0
    if mag_time_us != NEVER and time_us - mag_time_us < STALE_MAG_US:
        flags |= flagbits.USING_MAG
        if math.isfinite(declination_rad):
            flags |= flagbits.HEADING_VALID
    if fix_time_us != NEVER:
        age_us = time_us - fix_time_us
        if age_us < POSITION_HOLD_US:
            flags |= flagbits.POSITION_VALID | flagbits.VELOCITY_VALID | flagbits.ALTITUDE_VALID
        if age_us < STALE_GPS_US:
            flags |= flagbits.USING_GPS
        else:
            flags |= flagbits.DEAD_RECKONING | flagbits.DEGRADED
    if not sound:
        flags |= flagbits.SENSOR_FAULT | flagbits.DEGRADED
    return flags


@compiled
def run(
    gains: tuple[float, float, float, float],
    at_fix: bool,
    declination_rad: float,
    time_us: IntArray,
    samples: FloatArray,
    fix_time_us: IntArray,
    fixes: FloatArray,
) -> FloatArray:
    """Run over a whole log.

    Parameters
    ----------
    gains : tuple of 4 floats
        `alpha_gyro`, `alpha_yaw`, `alpha_accel`, `beta_velocity`.
    at_fix : bool
        Whether place and velocity are blended at each fix, else at each sample.
    declination_rad : float
        Declination before the first fix; NaN if not known.
    time_us : ndarray of int, shape (n,)
        Never goes back.
    samples : ndarray, shape (n, SAMPLE_COLUMNS)
        At each sample, the fixes that are not later come first.
    fix_time_us : ndarray of int, shape (m,)
        Arrival of the usable fixes, never goes back.
    fixes : ndarray, shape (m, FIX_COLUMNS)
        The usable fixes.

    Returns
    -------
    ndarray, shape (n, OUT_COLUMNS)
        One row a sample.
    """
    out = np.empty((len(time_us), OUT_COLUMNS))
    alpha_gyro, alpha_yaw, alpha, beta = gains
    q = (1.0, 0.0, 0.0, 0.0)
    place = vel = fix_place = fix_vel = (math.nan, math.nan, math.nan)
    now_us = mag_us = last_fix_us = NEVER
    k = 0
    for i in range(len(time_us)):
        while k < len(fix_time_us) and fix_time_us[k] <= time_us[i]:
            fix_place, fix_vel = three(fixes, k, 0), three(fixes, k, 3)
            declination_rad, last_fix_us = fixes[k, 6], fix_time_us[k]
            if not math.isfinite(place[0]):
                place, vel = fix_place, fix_vel
            place, vel = blend_fix(alpha, beta, place, vel, fix_place, fix_vel)
            k += 1
        accel, gyro, mag = three(samples, i, 0), three(samples, i, 3), three(samples, i, 6)
        sound = is_finite(accel) and is_finite(gyro)
        if now_us == NEVER and sound:
            now_us, q = time_us[i], level_start(accel)
        if now_us != NEVER:
            dt_us, now_us = time_us[i] - now_us, time_us[i]
            if sound and 0 < dt_us <= GAP_US:
                dt_s = dt_us / US_PER_S
                q = turn(q, accel, gyro, dt_s, alpha_gyro)
                if math.isfinite(place[0]):
                    place, vel = advance(q, accel, dt_s, place, vel)
                    if not at_fix:
                        place, vel = blend_fix(alpha, beta, place, vel, fix_place, fix_vel)
            if is_finite(mag):
                q = turn_to_compass(q, mag, declination_rad, now_us, mag_us, alpha_yaw)
                mag_us = now_us
        flags = flags_of(time_us[i], now_us != NEVER, mag_us, declination_rad, last_fix_us, sound)
        write(out, i, q, place, vel, flags)
    return out
