"""The filter sample by sample, and its entry points for compiled code.

The steps for an IMU sample are: clock, gap and fault checks, prediction, rest, the measurements
that replace GPS, and the compass. Barometer samples and fixes arrive between IMU samples.
"""

import math
from typing import Final

import numpy as np

from gateway.compiled import array_at, compiled, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation import columns as col
from gateway.estimation.columns import FLAG, gps_flags, imu_vectors
from gateway.estimation.eskf import faults, integrity, magnetometer, predict, rest, update
from gateway.estimation.eskf.fixes import update_gps
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import (
    ACCEL_BIAS,
    ATT,
    GPS_CLIMB,
    GPS_ERROR,
    GYRO_BIAS,
    GYRO_SCALE,
    HARD_IRON,
    MAG_LATENCY,
    NEVER_S,
    POS,
    VEL,
    State,
)
from gateway.estimation.record import FloatArray, as_quat, as_vec, layout, write_quat, write_vec
from gateway.estimation.reference import NO_DECLINATION_RAD
from gateway.geometry.geodesy import offset_deg
from gateway.geometry.quaternion import norm_sq
from gateway.records import NAN, UNKNOWN_VEC3, Vec3
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

START_SHARES: Final = (0.5, 2.0)
"""Limits of the first force, in multiples of gravity, for an initial level."""
UNAIDED_SCALE: Final = 0.01
"""Gyroscope scale error before the first fix: a third of an MPU6050's tolerance."""
MAX_ALTITUDE_M: Final = 30_000.0
"""Largest valid pressure altitude."""
LEVEL_VALID_RAD: Final = 0.1
"""Maximum standard deviation of a valid level."""
COMPASS_RAD: Final = 2.0 * RAD_PER_DEG
"""Error of the heading by the declination, the compass axes on their board, and soft iron. It is
only added in the output: it is constant, so averages over a flight, as in the smoother, do not
reduce it."""
PRESSURE_STD_M: Final = 100.0
"""Standard deviation of the pressure altitude by the weather: 12 hPa."""
UNAIDED_VALID_S: Final = 1.0
"""Time after its fix for which a position that is not estimated is valid."""

STATE_LAYOUT: Final = layout(State)
GAINS_LAYOUT: Final = layout(Gains)
FLOAT: Final = np.dtype(np.float64)
INT: Final = np.dtype(np.int64)
FLOAT_SIZE: Final = FLOAT.itemsize


@compiled
def start(s: State, p: Gains) -> None:
    """Initialise a state of zeros."""
    write_quat(s.q_nb, (1.0, 0.0, 0.0, 0.0))
    write_quat(s.q_ib, (1.0, 0.0, 0.0, 0.0))
    for k in range(3):
        s.P[GYRO_BIAS + k, GYRO_BIAS + k] = integrity.gyro_bias_var(s, p)
        s.P[ACCEL_BIAS + k, ACCEL_BIAS + k] = integrity.accel_bias_var(s, p)
        s.P[HARD_IRON + k, HARD_IRON + k] = magnetometer.hard_iron_var(s, p)
        s.P[GYRO_SCALE + k, GYRO_SCALE + k] = UNAIDED_SCALE * UNAIDED_SCALE
        s.gps_error_var[k] = p.gps_error_var if k < 2 else p.gps_height_error_var
        s.P[GPS_ERROR + k, GPS_ERROR + k] = s.gps_error_var[k]
        s.rate_b[k] = s.fix_vel[k] = NAN
    s.gps_climb_error_var = p.gps_climb_error_var
    s.P[GPS_CLIMB, GPS_CLIMB] = s.gps_climb_error_var
    s.mag_latency_s = p.mag_latency_s
    s.P[MAG_LATENCY, MAG_LATENCY] = p.mag_latency_std_sq
    s.declination_rad = p.declination_rad
    s.earth_dip_rad = s.earth_norm_ut = NAN
    s.fix_excess = 1.0
    s.gps_latency_s = p.gps_latency_s
    clear_times(s)


@compiled
def clear_times(s: State) -> None:
    """Clear all state that depends on the clock."""
    s.mag_s = s.mag_used_s = s.fix_s = s.update_s = s.level_s = NEVER_S
    s.baro_s = s.rejected_s = s.track_s = s.zero_s = NEVER_S
    s.reject_s, s.zero_velocity_wrong = 0.0, 0
    faults.close_gap(s)


@compiled
def update_imu(s: State, p: Gains, time_us: int, row: FloatArray) -> None:
    """Advance by one IMU sample; see `columns` for its row.

    A late sample is ignored; a clock that has gone back far counts as restarted.
    """
    gyro, accel, mag = imu_vectors(row)
    s.means = 1 if row[col.MEANS] != 0.0 else 0
    check_calibration(s, p, row)
    if s.started == 0:
        begin(s, p, time_us, gyro, accel)
        return
    dt = (time_us - s.time_us) * 1e-6
    if dt <= 0.0:
        s.fault = 1
        if dt < -faults.GAP_S:
            restart_clock(s, time_us)
        return
    s.time_us, s.time_s = time_us, (time_us - s.base_us) * 1e-6
    since_s = s.time_s - s.imu_s
    if faults.is_hanging(s, gyro, accel, rest.is_moving(s, p), dt):
        s.fault = 1
    elif since_s > faults.gap_limit_s(s):
        end_gap(s, p, gyro, accel, row[col.CLIPPED], since_s)
    else:
        s.imu_s = s.time_s
        advance(s, p, gyro, accel, mag, row[col.CLIPPED], since_s)


@compiled
def end_gap(s: State, p: Gains, gyro: Vec3, accel: Vec3, clipped: float, since_s: float) -> None:
    """Bridge a gap at the first valid sample after it."""
    if not faults.is_within_limits(gyro, accel) or norm_sq(gyro) + norm_sq(accel) == 0.0:
        s.fault = 1
        return
    faults.bridge_gap(s, p, gyro, accel, since_s)
    faults.follow_step(s, gyro, since_s)
    faults.check_sensors(s, gyro, accel, clipped, since_s)
    s.imu_s, s.sound_s = s.time_s, 0.0


@compiled
def advance(
    s: State, p: Gains, gyro: Vec3, accel: Vec3, mag: Vec3, clipped: float, dt: float
) -> None:
    """Advance by one sample without a gap before it."""
    if move(s, p, gyro, accel, clipped, dt):
        rest.detect_rest(s, p, gyro, accel, dt)
    if s.pending_s >= predict.COVARIANCE_INTERVAL_S:
        predict.propagate(s, p)
    level(s, p)
    misplaced = s.mag_misplaced
    if magnetometer.is_sound_field(s, mag, dt):
        magnetometer.update_mag(s, p, mag)
    elif s.mag_misplaced > misplaced:
        # The heading, and the sensor errors estimated with it, are from wrong axes.
        integrity.discard_calibration(s, p)
        integrity.lose_attitude(s, p)


@compiled
def begin(s: State, p: Gains, time_us: int, gyro: Vec3, accel: Vec3) -> None:
    """Start at the first valid sample; gravity gives the level within the first second."""
    force = math.sqrt(norm_sq(accel)) / STANDARD_GRAVITY_MPS2
    sound = faults.is_within_limits(gyro, accel)
    s.fault = 0 if sound and START_SHARES[0] < force < START_SHARES[1] else 1
    if s.fault == 1:
        return
    s.started, s.base_us, s.time_us, s.time_s, s.imu_s = 1, time_us, time_us, 0.0, 0.0
    for k in range(3):
        s.imu_mean[k] = s.gyro_mean[k] = gyro[k]
        s.imu_mean[3 + k] = accel[k]
        s.imu_held[k], s.imu_held[3 + k] = gyro[k], accel[k]
        s.force_lp_i[0, k] = s.force_lp_i[1, k] = accel[k]
    write_vec(s.rate_b, gyro)
    s.usual_repeat_s = faults.UNKNOWN_REPEAT_S
    integrity.lose_attitude(s, p)


@compiled
def restart_clock(s: State, time_us: int) -> None:
    """Continue on a new clock after a gap of unknown length."""
    s.base_us, s.time_us, s.time_s, s.imu_s = time_us, time_us, 0.0, 0.0
    clear_times(s)
    if s.aided == 1:
        integrity.end_aiding(s)


@compiled
def check_calibration(s: State, p: Gains, row: FloatArray) -> None:
    """Discard the estimated errors of a sensor whose calibration has changed."""
    bits = 1 if row[col.GYRO_UNCALIBRATED] != 0.0 else 0
    bits |= 2 if row[col.ACCEL_UNCALIBRATED] != 0.0 else 0
    bits |= 4 if row[col.MAG_UNCALIBRATED] != 0.0 else 0
    changed = bits ^ s.uncalibrated
    s.uncalibrated = bits
    if changed & 1:
        integrity.reset_gyro_bias(s, p)
    if changed & 2:
        integrity.reset_accel_bias(s, p)
    if changed & 4:
        magnetometer.reset_hard_iron(s, p)


@compiled
def move(s: State, p: Gains, gyro: Vec3, accel: Vec3, clipped: float, dt: float) -> bool:
    """Integrate one sample or its substitute; return whether both sensors were valid."""
    sound_gyro, sound_accel = faults.check_sensors(s, gyro, accel, clipped, dt)
    sound = sound_gyro and sound_accel
    if sound:
        faults.follow_step(s, gyro, dt)
        mean_gyro, mean_accel = faults.interpolate(s, s.imu_before, gyro, accel, dt)
        predict.add_vibration(s, p, gyro, accel, dt)
        gyro, accel = mean_gyro, mean_accel
    held_gyro, held_accel = faults.substitutes(s)
    gyro, accel = gyro if sound_gyro else held_gyro, accel if sound_accel else held_accel
    predict.integrate(s, p, gyro, accel, dt)
    if clipped != 0.0:
        # The part above the range may be as large as the clipped reading.
        for k in range(3):
            s.pending_noise[0] += (dt * s.imu_held[k]) ** 2
            s.pending_noise[1] += (dt * s.imu_held[3 + k]) ** 2
    predict.store_integrals(s)
    return sound


@compiled
def level(s: State, p: Gains) -> None:
    """Update by rest, and by gravity if GPS does not give the velocity."""
    since_s = s.time_s - s.level_s
    if since_s < update.LEVEL_INTERVAL_S:
        return
    s.level_s = s.time_s
    if s.aided == 1 and s.time_s - s.fix_s > p.dead_reckoning_s:
        predict.propagate(s, p)
        integrity.end_aiding(s)
    if s.aided == 0:
        integrity.level_by_gravity(s, p, min(since_s, 1.0))
    if s.at_rest == 1:
        update.update_rest(s, p)


@compiled
def update_baro(s: State, p: Gains, alt_m: float) -> None:
    """Use one pressure altitude, m, positive up."""
    if s.started == 0 or not abs(alt_m) < MAX_ALTITUDE_M:
        return
    s.baro_down_m = -alt_m
    if s.has_height == 0:
        s.pos_n[2] = -alt_m
    elif s.time_s - s.baro_s > col.BARO_STALE_S:
        update.restart_baro(s, p)
    else:
        update.update_height(s, p)
    s.baro_s = s.time_s


@compiled
def write_output(s: State, p: Gains, row: FloatArray) -> None:
    """Write the output row, see `columns`."""
    write_quat(row[col.NAV_QUAT : col.NAV_QUAT + 4], as_quat(s.q_nb))
    write_vec(row[col.NAV_RATE : col.NAV_RATE + 3], as_vec(s.rate_b))
    row[col.NAV_FLAGS] = float(flags_of(s, p))
    write_vec(row[col.NAV_ATTITUDE_STD : col.NAV_ATTITUDE_STD + 3], UNKNOWN_VEC3)
    if s.started == 1:
        write_std(row, col.NAV_ATTITUDE_STD, s, ATT)
        row[col.NAV_ATTITUDE_STD + 2] = heading_std_rad(s)
    write_position(s, p, row)


@compiled
def write_std(row: FloatArray, column: int, s: State, first: int) -> None:
    """Write three standard deviations."""
    for k in range(3):
        row[column + k] = math.sqrt(max(s.P[first + k, first + k], 0.0))


@compiled
def heading_std_rad(s: State) -> float:
    """Return the standard deviation of the heading with its systematic errors."""
    if s.heading_known == 0:
        return math.sqrt(predict.NO_HEADING_VAR)
    variance = max(s.P[ATT + 2, ATT + 2], 0.0) + COMPASS_RAD * COMPASS_RAD
    if s.heading_true == 0:
        variance += NO_DECLINATION_RAD * NO_DECLINATION_RAD
    return math.sqrt(variance)


@compiled
def write_position(s: State, p: Gains, row: FloatArray) -> None:
    """Write position, velocity and their standard deviations; unknown ones are NaN."""
    write_vec(row[col.NAV_VEL : col.NAV_VEL + 3], UNKNOWN_VEC3)
    row[col.NAV_VEL_STD : col.NAV_POS_STD + 3] = NAN
    row[col.NAV_LAT] = row[col.NAV_LON] = NAN
    if s.has_height == 1 or s.baro_s != NEVER_S:
        height_std_m = math.sqrt(s.P[POS + 2, POS + 2]) if s.has_height == 1 else PRESSURE_STD_M
        row[col.NAV_ALT], row[col.NAV_POS_STD + 2] = -s.pos_n[2], height_std_m
    else:
        row[col.NAV_ALT] = NAN
    if s.has_origin == 0:
        return
    north, east = s.pos_n[0] + s.blend_n[0], s.pos_n[1] + s.blend_n[1]
    row[col.NAV_LAT], row[col.NAV_LON] = offset_deg(s.origin[0], s.origin[1], 0.0, north, east)
    if s.aided == 1:
        write_vec(row[col.NAV_VEL : col.NAV_VEL + 3], as_vec(s.vel_n))
        write_std(row, col.NAV_VEL_STD, s, VEL)
        for k in range(2):
            row[col.NAV_POS_STD + k] = math.hypot(math.sqrt(s.P[POS + k, POS + k]), s.blend_n[k])
    elif s.time_s - s.fix_s < col.FRESH_GPS_S:
        write_vec(row[col.NAV_VEL : col.NAV_VEL + 3], as_vec(s.fix_vel))
        for k in range(3):
            unseen_mps = faults.UNSEEN_MPS2 * (s.time_s - s.fix_s + s.gps_latency_s)
            usual = p.gps_velocity_var if k < 2 else p.gps_climb_var + s.gps_climb_error_var
            row[col.NAV_VEL_STD + k] = math.sqrt(usual + unseen_mps * unseen_mps)
            if k < 2:
                fix_std_m = math.sqrt(s.gps_error_var[k] + p.gps_position_var)
                row[col.NAV_POS_STD + k] = math.hypot(fix_std_m, s.blend_n[k])


@compiled
def flags_of(s: State, p: Gains) -> int:
    """Return the flags, see `NavFlags`."""
    flags: int = FLAG.AT_REST if s.at_rest == 1 else 0
    if s.time_s - s.mag_s < magnetometer.STALE_MAG_S:
        flags |= FLAG.MAG_DISTURBED if s.mag_disturbed == 1 else FLAG.USING_MAG
    if s.mag_misplaced == 1:
        flags |= FLAG.MAG_DISTURBED | FLAG.MAG_MISPLACED | FLAG.DEGRADED
    if s.time_s - s.baro_s < col.BARO_STALE_S:
        flags |= FLAG.USING_BARO
    if s.fault == 1:
        flags |= FLAG.SENSOR_FAULT
    if s.fault == 1 or predict.is_accel_degraded(s):
        flags |= FLAG.DEGRADED
    if s.started == 1 and max(s.P[ATT, ATT], s.P[ATT + 1, ATT + 1]) < LEVEL_VALID_RAD**2:
        flags |= FLAG.ATTITUDE_VALID
    if s.heading_known == 1 and s.heading_true == 1 and heading_std_rad(s) < col.HEADING_VALID_RAD:
        flags |= FLAG.HEADING_VALID
    if s.has_height == 1 or s.baro_s != NEVER_S:
        flags |= FLAG.ALTITUDE_VALID
    return flags if s.fix_s == NEVER_S else flags | aiding_flags(s, p)


@compiled
def aiding_flags(s: State, p: Gains) -> int:
    """Return the flags of position and velocity."""
    hold_s = p.dead_reckoning_s if s.aided == 1 else UNAIDED_VALID_S
    flags: int = gps_flags(s.time_s - s.fix_s, s.time_s - s.rejected_s, hold_s)
    if s.aided == 0 and not math.isfinite(s.fix_vel[0] + s.fix_vel[1] + s.fix_vel[2]):
        flags &= ~FLAG.VELOCITY_VALID
    return flags


@compiled
def row_at(matrix: int, row: int, columns: int) -> FloatArray:
    """View a row of a matrix at an address."""
    return array_at(matrix + row * columns * FLOAT_SIZE, (columns,), FLOAT)  # type: ignore[no-any-return]


@EntryPoint
def begin_state(state: int, gains: int) -> None:
    """Initialise a state of zeros."""
    start(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT))


@EntryPoint
def imu_steps(
    state: int, gains: int, count: int, times_us: int, samples: int, outputs: int
) -> None:
    """Advance by IMU samples, and write a row after each."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    time_us = array_at(times_us, (count,), INT)
    for i in range(count):
        update_imu(s, p, time_us[i], row_at(samples, i, col.IMU_COLUMNS))
        write_output(s, p, row_at(outputs, i, col.NAV_COLUMNS))


@EntryPoint
def baro_step(state: int, gains: int, alt_m: float) -> None:
    """Use one barometer sample."""
    update_baro(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT), alt_m)


@EntryPoint
def gps_step(state: int, gains: int, arrival_us: int, fix: int) -> None:
    """Use one fix."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    update_gps(s, p, arrival_us, row_at(fix, 0, col.GPS_COLUMNS))


class LogArrays:
    """Lengths and addresses of the arrays of a `SampleLog`, with the same names."""

    imu_count: int
    imu_time_us: int
    imu: int
    baro_count: int
    baro_time_us: int
    baro_alt_m: int
    gps_count: int
    gps_time_us: int
    gps: int


LOG_LAYOUT: Final = layout(LogArrays)


@compiled
def update_aiding(
    s: State, p: Gains, log: LogArrays, until_us: int, baros: int, fixes: int
) -> tuple[int, int]:
    """Use the heights, then the fixes up to a time; return the total numbers used so far."""
    baro_time_us = array_at(log.baro_time_us, (log.baro_count,), INT)
    baro_alt_m = array_at(log.baro_alt_m, (log.baro_count,), FLOAT)
    gps_time_us = array_at(log.gps_time_us, (log.gps_count,), INT)
    while baros < log.baro_count and baro_time_us[baros] <= until_us:
        update_baro(s, p, baro_alt_m[baros])
        baros += 1
    while fixes < log.gps_count and gps_time_us[fixes] <= until_us:
        update_gps(s, p, gps_time_us[fixes], row_at(log.gps, fixes, col.GPS_COLUMNS))
        fixes += 1
    return baros, fixes


@EntryPoint
def run(state: int, gains: int, log_at: int, outputs: int) -> None:
    """Advance over a log; heights, then fixes, are used before the first IMU sample not earlier."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    log = record_at(log_at, LOG_LAYOUT)
    imu_time_us = array_at(log.imu_time_us, (log.imu_count,), INT)
    baros = fixes = 0
    for i in range(log.imu_count):
        baros, fixes = update_aiding(s, p, log, imu_time_us[i], baros, fixes)
        update_imu(s, p, imu_time_us[i], row_at(log.imu, i, col.IMU_COLUMNS))
        write_output(s, p, row_at(outputs, i, col.NAV_COLUMNS))
