"""The compiled entry points: one sample in."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.pair_sums import doubt_pairs
from gateway.estimation.alignment.review import GAP_LOST_RAD, GAP_S
from gateway.estimation.alignment.wahba import carry_frame
from gateway.estimation.columns import CLIPPED, imu_vectors
from gateway.estimation.compass_lag import follow_rate, present_field
from gateway.estimation.eskf.covariance import level_variance, propagate
from gateway.estimation.eskf.eskf_output import write_output
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import ACCEL_BIAS, GYRO_BIAS, VEL, EskfState
from gateway.estimation.eskf.fixes import take_gps
from gateway.estimation.eskf.iron import (
    doubt_iron_anew,
    doubt_standing_field,
    follow_field,
    look_for_iron,
    update_by_dip,
)
from gateway.estimation.eskf.measure import (
    update_by_baro,
    update_by_compass,
    update_by_rest,
    update_by_velocity,
)
from gateway.estimation.eskf.recovery import (
    check_rest,
    lose_attitude,
    raise_bias_variance,
    take_rest_bias,
    watch_gravity,
)
from gateway.estimation.eskf.start import (
    begin,
    bridge_gap,
    bridge_silence,
    end_dead_reckoning,
    forget_times,
    note_calibration,
    rate_of,
    restart_baro,
    start,
    start_heading_by_compass,
)
from gateway.estimation.eskf.unaided_velocity import unaided_density, watch_way
from gateway.estimation.filtering.field_jump import has_jumped
from gateway.estimation.filtering.height_intake import is_height_told
from gateway.estimation.filtering.roughness import collect_roughness
from gateway.estimation.filtering.sample_clock import (
    is_silent,
    mean_over_step,
    step_clock,
    unseen_variances,
)
from gateway.estimation.filtering.sample_loop import kernels_of
from gateway.estimation.filtering.steady_turn import turns_steadily
from gateway.estimation.flagbits import FRESH_GPS_S
from gateway.estimation.history import remember
from gateway.estimation.kernel import Kernels
from gateway.estimation.kernel_record import (
    FloatArray,
    as_quat,
    as_vec,
    write_quat,
    write_vec,
)
from gateway.estimation.local_position import BARO_STALE_S
from gateway.estimation.magfield import (
    MIN_FIELD_UT,
    STALE_MAG_S,
    field_unlikeness,
    is_field_told,
    steepness,
    take_field,
)
from gateway.estimation.rest import (
    is_pushed,
    may_be_pushed,
    outruns,
    watch_rest,
)
from gateway.estimation.rest_bias import BIAS_CHANGE_RADPS, doubt_rest_bias, has_spun
from gateway.estimation.sensor_faults import (
    check_sensors,
    clipped_squares,
    force_instead,
    rate_instead,
)
from gateway.geometry.quaternion import (
    body_axes,
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
    rotate_inverse,
)
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

COVARIANCE_S: Final = 0.02
"""The covariance is propagated this often, and before each measurement."""
PSEUDO_S: Final = 0.1
"""Between measurements that stand in for a sensor."""
COMPASS_S: Final = 0.045
"""Between compass measurements; its slow error makes more of them useless."""


@compiled
def take_imu(
    s: EskfState,
    p: EskfGains,
    time_us: int,
    row: FloatArray,
) -> None:
    """Advance by one IMU sample; see `columns` for its row.

    A sample that is late is left out; a clock that went far back is a new clock.
    """
    gyro, accel, mag = imu_vectors(row)
    note_calibration(s, p, row)
    if s.started == 0:
        s.hold_s = p.dead_reckoning_s
        begin(s, p, time_us, gyro, accel)
        return
    dt = step_clock(s, time_us)
    if dt <= 0.0:
        if dt < -GAP_S:
            bridge_gap(s, p, 1.0)
            forget_times(s)
        return
    if is_silent(s, gyro, accel, is_moving(s, p), dt):
        bridge_silence(s, p, gyro, accel, dt)
        return
    sound = move(s, gyro, accel, row[CLIPPED], dt)
    if row[CLIPPED] != 0.0:
        doubt_clipped(s, dt)
    if sound:
        check_rest(s, p, gyro, accel)
        look_for_rest(s, p, gyro, accel, dt)
        watch_gravity(s, p)
    if s.pending_s >= COVARIANCE_S:
        propagate(s, p)
    take_substitutes(s, p)
    follow_rate(s, dt)
    misplaced = s.mag_misplaced
    if is_field_told(s, mag, dt):
        take_mag(s, p, mag)
    elif s.mag_misplaced > misplaced:
        raise_bias_variance(s, BIAS_CHANGE_RADPS)
        lose_attitude(s, p)


@compiled
def look_for_rest(s: EskfState, p: EskfGains, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Look whether the aircraft stands, and what that says of the gyroscope's bias."""
    moving, rested = is_moving(s, p), s.at_rest == 1
    turning, pushed = is_turning(s, dt), is_pushed_on(s, dt)
    watch_rest(s, p, gyro, accel, moving or turning or pushed, s.time_s - s.fix_s, dt)
    bias_b = as_vec(s.gyro_bias_b)
    raise_bias_variance(s, doubt_rest_bias(s, bias_b, rested, moving, dt))
    if has_spun(s, bias_b):
        take_rest_bias(s, p)


@compiled
def move(s: EskfState, gyro: Vec3, accel: Vec3, clipped: float, dt: float) -> bool:
    """Integrate one sample, or what stands in for it; tells whether both sensors were sound."""
    gyro_before, accel_before = as_vec(s.gyro_held), as_vec(s.accel_held)
    sound_gyro, sound_accel = check_sensors(s, gyro, accel, clipped, dt)
    if sound_gyro and sound_accel:
        collect_roughness(s, gyro, accel, gyro_before, accel_before, dt)
        rate, force, unseen_s = mean_over_step(s, gyro_before, accel_before, gyro, accel, dt)
        if unseen_s > 0.0:
            doubt_lost(s, gyro_before, gyro, accel, unseen_s)
        gyro, accel = rate, force
    if not sound_gyro:
        gyro = rate_instead(s, as_vec(s.gyro_bias_b))
    if not sound_accel:
        accel = force_instead(s, level_force(s))
    integrate(s, gyro, accel, dt)
    return sound_gyro and sound_accel


@compiled
def doubt_lost(s: EskfState, gyro_before: Vec3, gyro: Vec3, accel: Vec3, unseen_s: float) -> None:
    """Add noise where samples were lost: the mean of both ends stands in for them."""
    steady = as_vec(s.gyro_bias_b)
    turned, pulled = unseen_variances(s, gyro_before, gyro, steady, accel, unseen_s)
    s.unseen_rad2 += turned
    s.unseen_m2ps2 += pulled
    doubt_pairs(s, turned)


@compiled
def doubt_clipped(s: EskfState, dt: float) -> None:
    """Add noise where a sensor was at the end of its range."""
    turned_sq, pulled_sq = clipped_squares(s)
    s.unseen_rad2 += dt * dt * turned_sq
    s.unseen_m2ps2 += dt * dt * pulled_sq


@compiled
def level_force(s: EskfState) -> Vec3:
    """Return what the accelerometer would read if nothing accelerated."""
    f = rotate_inverse(as_quat(s.q_nb), (0.0, 0.0, -STANDARD_GRAVITY_MPS2))
    b = s.accel_bias_b
    return (f[0] + b[0], f[1] + b[1], f[2] + b[2])


@compiled
def is_moving(s: EskfState, p: EskfGains) -> bool:
    """Return whether GPS or dead reckoning says that it moves, or without any the way it went.

    A bias that has jumped has turned the level, which then pulls the speed: only fixes tell it.
    """
    if s.aided == 0 and s.flies == 1 and may_be_pushed(s):
        return True
    fresh = s.time_s - s.fix_s < FRESH_GPS_S
    if s.aided == 0 or (fresh and s.bias_jumped == 1):
        return fresh and math.hypot(s.fix_vel[0], s.fix_vel[1]) > p.rest_speed_mps
    unsure_sq = 0.0 if fresh else s.P[VEL, VEL] + s.P[VEL + 1, VEL + 1]
    return outruns(math.hypot(s.vel_n[0], s.vel_n[1]), unsure_sq, p)


@compiled
def is_turning(s: EskfState, dt: float) -> bool:
    """Return whether it turns steadily, where GPS does not tell that it stands."""
    variance = max(s.P[GYRO_BIAS, GYRO_BIAS], s.P[GYRO_BIAS + 1, GYRO_BIAS + 1])
    std = math.sqrt(max(variance, s.P[GYRO_BIAS + 2, GYRO_BIAS + 2]))
    turning = turns_steadily(s, as_vec(s.gyro_bias_b), std, dt)
    return turning and s.time_s - s.fix_s > FRESH_GPS_S


@compiled
def is_pushed_on(s: EskfState, dt: float) -> bool:
    """Return whether a steady force pushes, as far as the level is known."""
    known = STANDARD_GRAVITY_MPS2**2 * level_variance(s) + 2.0 * s.P[ACCEL_BIAS, ACCEL_BIAS]
    unsure = math.inf if s.lost == 1 else known
    return is_pushed(s, rotate(as_quat(s.q_nb), as_vec(s.accel_lp)), unsure, dt)


@compiled
def integrate(s: EskfState, gyro: Vec3, accel: Vec3, dt: float) -> None:
    """Advance the nominal state and collect what the covariance will need.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    gyro, accel : tuple of 3 floats
        Newest sample in body FRD, biases still in.
    dt : float
        Time step, s.
    """
    c = s.accel_bias_b
    rate = rate_of(s, gyro)
    write_vec(s.rate_b, rate)
    carry_frame(s, rate, dt)
    # The force of the interval acts, on average, at the attitude half way through it.
    half = from_rotation_vector((0.5 * rate[0] * dt, 0.5 * rate[1] * dt, 0.5 * rate[2] * dt))
    q = multiply(as_quat(s.q_nb), half)
    write_quat(s.q_nb, normalise(multiply(q, half)))
    x, y, z = body_axes(q)
    f0, f1, f2 = accel[0] - c[0], accel[1] - c[1], accel[2] - c[2]
    s.pending_s += dt
    s.pending_rad += dt * math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    force_i = rotate(as_quat(s.q_ib), (f0, f1, f2))
    follows = s.aided == 0 and s.time_s - s.fix_s < FRESH_GPS_S and math.isfinite(s.fix_vel[2])
    for k in range(3):
        force = x[k] * f0 + y[k] * f1 + z[k] * f2
        s.pending_force_n[k] += force * dt
        s.pending_turn[k, 0] += x[k] * dt
        s.pending_turn[k, 1] += y[k] * dt
        s.pending_turn[k, 2] += z[k] * dt
        s.pending_scaled[k, 0] += x[k] * gyro[0] * dt
        s.pending_scaled[k, 1] += y[k] * gyro[1] * dt
        s.pending_scaled[k, 2] += z[k] * gyro[2] * dt
        a = force + STANDARD_GRAVITY_MPS2 if k == 2 else force
        s.integrals[6 + k] += (s.integrals[3 + k] + 0.5 * a * dt) * dt
        s.integrals[3 + k] += a * dt
        s.integrals[k] += force_i[k] * dt
        s.pending_accel_sq += a * a * dt
        if s.aided == 1:
            s.pos_n[k] += (s.vel_n[k] + 0.5 * a * dt) * dt
        elif follows:
            s.pos_n[k] += s.fix_vel[k] * dt
        s.vel_n[k] += a * dt
    s.ring_count = remember(s.ring, s.ring_count, s.time_s, s.integrals)


@compiled
def take_substitutes(s: EskfState, p: EskfGains) -> None:
    """Use rest, or the little motion to be expected, where GPS does not tell the velocity."""
    if s.time_s - s.pseudo_s < PSEUDO_S:
        return
    dt = min(s.time_s - s.pseudo_s, 1.0)
    s.pseudo_s = s.time_s
    if s.aided == 1 and s.time_s - s.fix_s > p.dead_reckoning_s:
        end_dead_reckoning(s, p)
    if s.aided == 0:
        propagate(s, p)
        if s.lost == 0 and level_variance(s) > GAP_LOST_RAD**2:
            lose_attitude(s, p)
        watch_way(s, dt)
    if s.at_rest == 1:
        update_by_rest(s, p)
    elif s.aided == 0 and s.lost == 0:
        update_by_velocity(s, p, unaided_density(s, p) / dt)


@compiled
def recent_unlikeness(s: EskfState, p: EskfGains, norm: float, dip: float, dt: float) -> float:
    """Return by what to divide a field's weight: what disturbs the compass lasts for a while."""
    now = field_unlikeness(s, norm, dip)
    kept = p.field_memory_s / (p.field_memory_s + dt)
    s.mag_unlike = kept * s.mag_unlike + (1.0 - kept) * now
    return max(now, s.mag_unlike)


@compiled
def take_mag(s: EskfState, p: EskfGains, mag_b: Vec3) -> None:
    """Use one magnetometer sample.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    mag_b : tuple of 3 floats
        Calibrated field in body FRD, uT.
    """
    b = s.mag_bias_b
    present = present_field(s, (mag_b[0] - b[0], mag_b[1] - b[1], mag_b[2] - b[2]))
    if s.lost == 1:
        return
    if has_jumped(s, mag_b):
        doubt_iron_anew(s, p)
    look_for_iron(s, p, mag_b, s.time_s - s.mag_s)
    field = rotate(as_quat(s.q_nb), present)
    level = math.hypot(field[0], field[1])
    norm = math.hypot(level, field[2])
    if norm < MIN_FIELD_UT or level < 0.05 * norm or s.time_s <= s.mag_s:
        return
    dip = math.asin(field[2] / norm)
    dt = min(s.time_s - s.mag_s, STALE_MAG_S)
    update_by_dip(s, p, field, dt)
    follow_field(s, dip, dt)
    weight = take_field(s, p, norm, field[2]) / recent_unlikeness(s, p, norm, dip, dt)
    doubt_standing_field(s, p, dt)
    known = math.isfinite(s.declination_rad)
    declination = s.declination_rad if known else 0.0
    if weight == 0.0:
        return
    if s.heading_known == 0:
        turn_rad = declination - math.atan2(field[1], field[0])
        start_heading_by_compass(s, p, field, turn_rad, p.mag_var * steepness(dip) / weight)
        s.heading_true = 1 if known else 0
    elif s.time_s - s.mag_used_s >= COMPASS_S:
        since = min(s.time_s - s.mag_used_s, STALE_MAG_S)
        s.mag_used_s = s.time_s
        write_vec(s.field_n, field)
        update_by_compass(s, p, field, declination, weight, since)


@compiled
def take_baro(s: EskfState, p: EskfGains, alt_m: float) -> None:
    """Use one barometer height.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    alt_m : float
        Pressure altitude, positive up.
    """
    if not is_height_told(s, alt_m):
        return
    s.baro_down_m = -alt_m
    if s.has_height == 0:
        s.pos_n[2] = -alt_m
    elif s.baro_known == 0 or s.time_s - s.baro_s > BARO_STALE_S:
        restart_baro(s, p)
    else:
        update_by_baro(s, p, -alt_m)
    s.baro_known, s.baro_s = 1, s.time_s


KERNELS: Final[Kernels[EskfState, EskfGains]] = kernels_of(
    EskfState, EskfGains, start, take_imu, take_baro, take_gps, write_output
)
