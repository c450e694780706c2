"""The equations of the paper's estimator, compiled: one sample live, or a whole log at once.

`gateway.estimation.paper.paper` says what they are and where they deviate from the print. Both ways
of running call the same functions, so a log gives bit for bit what its samples give one at a time.
"""

import math
from typing import Annotated, Final

import numpy as np

from gateway.compiled import address_of, array_at, compiled, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation import flagbits
from gateway.estimation.history import SLOTS, recall, remember
from gateway.estimation.kernel_record import (
    FloatArray,
    IntArray,
    as_vec,
    layout,
    write_vec,
)
from gateway.estimation.rest import RestGains, RestState, begin_rest, watch_rest
from gateway.estimation.sensor_faults import (
    HealthState,
    check_sensors,
    force_instead,
    rate_instead,
)
from gateway.geometry.angle import wrap_180, wrap_pi
from gateway.geometry.geodesy import offset_deg
from gateway.geometry.quaternion import (
    from_euler,
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
    rotate_inverse,
    to_euler,
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
MAX_ACCEL_MPS2: Final = 500.0
MAX_RATE_RADPS: Final = 50.0
"""No sensor of this kind tells more: such a value is a fault."""
BIAS_TAU_S: Final = 5.0
"""Time constant by which the gyroscope's bias is followed at rest."""

Place = Vec3
"""Latitude and longitude in degrees, height in metres."""

SAMPLE_COLUMNS: Final = 9
"""Low-passed specific force, high-passed rate (NaN if the sample is not sound), magnetic field
(NaN unless new)."""
FIX_COLUMNS: Final = 7
"""Place and velocity of a fix as of when it was valid, and the declination in rad."""
OUT_COLUMNS: Final = 11
"""Attitude, place, velocity, flags."""


class Memory(RestState, HealthState):
    """What the inertial sensors showed recently."""

    bias_b: Annotated[FloatArray, (3,)]
    """Of the gyroscope, as it last showed at rest."""
    integrals: Annotated[FloatArray, (6,)]
    """Of the acceleration in NED: once, and twice."""
    ring: Annotated[FloatArray, (SLOTS, 7)]
    ring_count: int
    past: Annotated[FloatArray, (6,)]
    """Scratch: the integrals as they were."""


MEMORY_LAYOUT: Final = layout(Memory)
REST_LAYOUT: Final = layout(RestGains)
FLOAT: Final = np.dtype(np.float64)
INT: Final = np.dtype(np.int64)


@compiled
def is_finite(v: Vec3) -> bool:
    """Return whether all three are finite."""
    return math.isfinite(v[0]) and math.isfinite(v[1]) and math.isfinite(v[2])


@compiled
def is_field(v: Vec3) -> bool:
    """Return whether a compass told a field: zeros are what one tells that was reset."""
    return is_finite(v) and bool(v[0] or v[1] or v[2])


@compiled
def is_sound(accel: Vec3, gyro: Vec3) -> bool:
    """Return whether a sample is finite and within what sensors can tell."""
    force = max(abs(accel[0]), abs(accel[1]), abs(accel[2]))
    rate = max(abs(gyro[0]), abs(gyro[1]), abs(gyro[2]))
    finite = is_finite(accel) and is_finite(gyro)
    return finite and force < MAX_ACCEL_MPS2 and rate < MAX_RATE_RADPS


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
def unbiased(
    s: Memory,
    p: RestGains,
    gyro: Vec3,
    accel: Vec3,
    fix_vel: Vec3,
    fix_age_us: int,
    dt_s: float,
) -> Vec3:
    """Take off the rate what the gyroscope last showed at rest."""
    speed_sq = fix_vel[0] * fix_vel[0] + fix_vel[1] * fix_vel[1] + fix_vel[2] * fix_vel[2]
    moving = fix_age_us < STALE_GPS_US and speed_sq > p.rest_speed_mps * p.rest_speed_mps
    watch_rest(s, p, gyro, accel, moving, fix_age_us / US_PER_S, dt_s)
    if s.at_rest == 1:
        # A mean while this rest is young, then a low-pass.
        share = dt_s / min(s.rest_s - p.rest_time_s + dt_s, BIAS_TAU_S)
        write_vec(s.bias_b, blend(1.0 - share, as_vec(s.bias_b), as_vec(s.gyro_rest)))
    return (gyro[0] - s.bias_b[0], gyro[1] - s.bias_b[1], gyro[2] - s.bias_b[2])


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
def advance(
    s: Memory, q_nb: Quat, accel: Vec3, dt_s: float, now_us: int, place: Place, vel: Vec3
) -> tuple[Place, Vec3]:
    """Third complementary filter, its inertial path: integrate twice; NaN before the first fix."""
    a = rotate(q_nb, accel)
    step = (a[0] * dt_s, a[1] * dt_s, (a[2] + STANDARD_GRAVITY_MPS2) * dt_s)
    for k in range(3):
        s.integrals[k] += step[k]
        s.integrals[3 + k] += s.integrals[k] * dt_s
    s.ring_count = remember(s.ring, s.ring_count, now_us / US_PER_S, s.integrals)
    vel = (vel[0] + step[0], vel[1] + step[1], vel[2] + step[2])
    lat, lon = offset_deg(place[0], place[1], place[2], vel[0] * dt_s, vel[1] * dt_s)
    return ((lat, lon, place[2] - vel[2] * dt_s), vel)


@compiled
def step(
    s: Memory,
    p: RestGains,
    alpha_gyro: float,
    q_nb: Quat,
    accel: Vec3,
    gyro: Vec3,
    place: Place,
    vel: Vec3,
    fix_vel: Vec3,
    fix_age_us: int,
    now_us: int,
    dt_s: float,
) -> tuple[Vec3, Quat, Place, Vec3]:
    """Advance all that the inertial sensors drive; the rate comes back without its bias.

    A sample that is far from all others is bridged.
    """
    good_gyro, good_accel = check_sensors(s, gyro, accel, 0.0, dt_s)
    if not good_gyro:
        gyro = rate_instead(s, as_vec(s.bias_b))
    if not good_accel:
        accel = force_instead(s, rotate_inverse(q_nb, (0.0, 0.0, -STANDARD_GRAVITY_MPS2)))
    gyro = unbiased(s, p, gyro, accel, fix_vel, fix_age_us, dt_s)
    q_nb = turn(q_nb, accel, gyro, dt_s, alpha_gyro)
    place, vel = advance(s, q_nb, accel, dt_s, now_us, place, vel)
    return (gyro, q_nb, place, vel)


@compiled
def carry_forward(
    s: Memory, place: Place, vel: Vec3, arrival_us: int, now_us: int, latency_s: float
) -> tuple[Place, Vec3]:
    """Move a fix from when it was valid to the newest sample by what that time has brought."""
    valid_s = arrival_us / US_PER_S - latency_s
    # After a gap the sample that is to come does not make up for it.
    until_us = now_us if abs(arrival_us - now_us) <= GAP_US else arrival_us
    lag_s = latency_s + (until_us - arrival_us) / US_PER_S
    now_s, now, past = now_us / US_PER_S, s.integrals, s.past
    seen_s = now_s - recall(s.ring, s.ring_count, valid_s, now_s, now, past)
    gained = (now[0] - past[0], now[1] - past[1], now[2] - past[2])
    north_m = vel[0] * lag_s + now[3] - past[3] - past[0] * seen_s
    east_m = vel[1] * lag_s + now[4] - past[4] - past[1] * seen_s
    down_m = vel[2] * lag_s + now[5] - past[5] - past[2] * seen_s
    lat, lon = offset_deg(place[0], place[1], place[2], north_m, east_m)
    return (
        (lat, lon, place[2] - down_m),
        (vel[0] + gained[0], vel[1] + gained[1], vel[2] + gained[2]),
    )


@compiled
def blend_fix(
    alpha: float, beta: float, place: Place, vel: Vec3, fix_place: Place, fix_vel: Vec3
) -> tuple[Place, Vec3]:
    """Third complementary filter, its blend: eq. 1, 2, 7 and 8 as recursions."""
    vel = blend(alpha, vel, fix_vel)
    # The longitude may wrap between the two; blend the shortest way round.
    fix_lon = place[1] + wrap_180(fix_place[1] - place[1])
    lat, lon, alt = blend(beta, place, (fix_place[0], fix_lon, fix_place[2]))
    return ((lat, wrap_180(lon), alt), vel)


@compiled
def level_start(s: Memory, accel: Vec3, gyro: Vec3) -> Quat:
    """Begin with the accelerometer's tilt, facing north."""
    write_vec(s.accel_held, accel)
    write_vec(s.gyro_held, gyro)
    begin_rest(s, gyro, accel)
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
    """Return what holds at a time."""
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


def run(
    gains: tuple[float, float, float, float, float],
    rest: RestGains,
    memory: Memory,
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
    gains : tuple of 5 floats
        `alpha_gyro`, `alpha_yaw`, `alpha_accel`, `beta_velocity`, `gps_latency_s`.
    rest : RestGains
        What is taken for rest.
    memory : Memory
        Changed in place.
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
    arrays = [np.ascontiguousarray(part) for part in (time_us, samples, fix_time_us, fixes)]
    out = np.empty((len(time_us), OUT_COLUMNS))
    places = [address_of(part) for part in (rest, memory, *arrays, out)]
    run_at(*gains, int(at_fix), declination_rad, len(time_us), len(fix_time_us), *places)
    return out


@EntryPoint
def run_at(
    alpha_gyro: float,
    alpha_yaw: float,
    alpha: float,
    beta: float,
    latency_s: float,
    at_fix: int,
    declination_rad: float,
    count: int,
    fix_count: int,
    rest_at: int,
    memory_at: int,
    times_us: int,
    samples_at: int,
    fix_times_us: int,
    fixes_at: int,
    out_at: int,
) -> None:
    """Do `run` on arrays by their addresses."""
    rest, memory = record_at(rest_at, REST_LAYOUT), record_at(memory_at, MEMORY_LAYOUT)
    time_us = array_at(times_us, (count,), INT)
    samples = array_at(samples_at, (count, SAMPLE_COLUMNS), FLOAT)
    fix_time_us = array_at(fix_times_us, (fix_count,), INT)
    fixes = array_at(fixes_at, (fix_count, FIX_COLUMNS), FLOAT)
    out = array_at(out_at, (count, OUT_COLUMNS), FLOAT)
    _run(
        alpha_gyro, alpha_yaw, alpha, beta, latency_s, at_fix != 0, declination_rad, rest, memory,
        time_us, samples, fix_time_us, fixes, out,
    )  # fmt: skip


@compiled
def _run(
    alpha_gyro: float,
    alpha_yaw: float,
    alpha: float,
    beta: float,
    latency_s: float,
    at_fix: bool,
    declination_rad: float,
    rest: RestGains,
    memory: Memory,
    time_us: IntArray,
    samples: FloatArray,
    fix_time_us: IntArray,
    fixes: FloatArray,
    out: FloatArray,
) -> None:
    """Do `run`."""
    q = (1.0, 0.0, 0.0, 0.0)
    place = vel = fix_place = fix_vel = (math.nan, math.nan, math.nan)
    now_us = mag_us = last_fix_us = NEVER
    k = 0
    for i in range(time_us.shape[0]):
        while k < fix_time_us.shape[0] and fix_time_us[k] <= time_us[i]:
            fix_place, fix_vel = carry_forward(
                memory, three(fixes, k, 0), three(fixes, k, 3), fix_time_us[k], now_us, latency_s
            )
            declination_rad, last_fix_us = fixes[k, 6], fix_time_us[k]
            if not math.isfinite(place[0]):
                place, vel = fix_place, fix_vel
            place, vel = blend_fix(alpha, beta, place, vel, fix_place, fix_vel)
            k += 1
        accel, gyro, mag = three(samples, i, 0), three(samples, i, 3), three(samples, i, 6)
        sound = is_sound(accel, gyro)
        if now_us == NEVER and sound:
            now_us, q = time_us[i], level_start(memory, accel, gyro)
        if now_us != NEVER:
            dt_us, now_us = time_us[i] - now_us, time_us[i]
            if sound and 0 < dt_us <= GAP_US:
                dt_s, age_us = dt_us / US_PER_S, now_us - last_fix_us
                _, q, place, vel = step(
                    memory, rest, alpha_gyro, q, accel, gyro, place, vel, fix_vel, age_us,
                    now_us, dt_s,
                )  # fmt: skip
                if not at_fix:
                    place, vel = blend_fix(alpha, beta, place, vel, fix_place, fix_vel)
            if is_field(mag):
                q = turn_to_compass(q, mag, declination_rad, now_us, mag_us, alpha_yaw)
                mag_us = now_us
        flags = flags_of(time_us[i], now_us != NEVER, mag_us, declination_rad, last_fix_us, sound)
        write(out, i, q, place, vel, flags)
