"""The compiled entry points: one sample in."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_latency import begin_latency, forget_velocities
from gateway.estimation.alignment.gps_velocity import forget_way
from gateway.estimation.alignment.pair_sums import doubt_pairs
from gateway.estimation.alignment.review import GAP_S, MOVING_MPS
from gateway.estimation.columns import CLIPPED, imu_vectors
from gateway.estimation.compass_lag import begin_lag, follow_rate, present_field
from gateway.estimation.complementary.accuracy import watch_accuracy, write_attitude_std
from gateway.estimation.complementary.complementary_output import (
    DEAD_RECKONING_MAX_S,
    write_output,
)
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.bias import update_bias
from gateway.estimation.complementary.errors.drift import (
    DOUBT,
    begin_drift,
    bias_std,
    doubt_sensors,
    end_level,
    note_turn,
    raise_attitude_variance,
    raise_bias_variance,
)
from gateway.estimation.complementary.errors.sensor_calibration import note_calibration
from gateway.estimation.complementary.heading import is_heading_good, take_mag
from gateway.estimation.complementary.intake import bridge_silence, take_gps
from gateway.estimation.complementary.navigation import (
    dead_reckon,
    stand_still,
    take_baro,
)
from gateway.estimation.complementary.reorientation import (
    lose_attitude,
    take_rest_bias,
    watch_gravity,
)
from gateway.estimation.complementary.tilt import (
    doubt_held_level,
    hold_level,
    refresh,
    strapdown,
    take_gravity,
)
from gateway.estimation.filtering.roughness import collect_roughness
from gateway.estimation.filtering.sample_clock import (
    begin_clock,
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
from gateway.estimation.local_position import NEVER_S
from gateway.estimation.magfield import is_field_told
from gateway.estimation.rest import is_pushed, outruns, watch_rest
from gateway.estimation.rest_bias import doubt_rest_bias, has_spun
from gateway.estimation.sensor_faults import (
    check_sensors,
    clipped_squares,
    force_instead,
    is_start,
    rate_instead,
)
from gateway.geometry.quaternion import rotate, rotate_inverse
from gateway.records import NAN, Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

EPOCH_S: Final = 0.1
"""Without GPS, the bias is updated this often."""

PULL_MPS2: Final = 0.5
"""An acceleration of this much, by GPS, shows more in the level than the bias does."""


@compiled
def start(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Set a fresh state."""
    write_quat(s.q_ib, (1.0, 0.0, 0.0, 0.0))
    write_quat(s.q_ei, (1.0, 0.0, 0.0, 0.0))
    refresh(s)
    for k in range(3):
        s.rate_b[k] = NAN
    begin_drift(s, p)
    s.gravity_tau_s = p.tau_accel_s
    s.declination_rad = p.declination_rad
    s.earth_dip_rad = NAN
    begin_latency(s, p.gps_latency_s)
    begin_lag(s)
    forget_times(s)


@compiled
def forget_times(s: ComplementaryState) -> None:
    """Drop all that is tied to the clock."""
    s.accuracy_s = NEVER_S
    s.mag_s = s.fix_s = s.fix_valid_s = s.pair_s = s.baro_s = NEVER_S
    s.reject_last[0] = NEVER_S
    forget_velocities(s)
    forget_way(s)
    s.reject_s = s.rest_s = s.epoch_s = 0.0
    s.ring_count = s.at_rest = 0


@compiled
def begin(
    s: ComplementaryState, p: ComplementaryGains, time_us: int, gyro: Vec3, accel: Vec3
) -> None:
    """Start at the first sound sample, level by its specific force."""
    if not is_start(s, gyro, accel):
        return
    begin_clock(s, time_us, gyro, accel)
    write_vec(s.force_lp_i, accel)
    # One sample may be anything: the alignment finds the level within the first second.
    lose_attitude(s, p)
    take_gravity(s, accel, 1.0, 1e-3)
    # Two turns: the first leaves a remainder where the start is upside down.
    take_gravity(s, accel, 1.0, 1e-3)
    s.tilt_sum[0] = s.tilt_sum[1] = 0.0
    refresh(s)
    write_attitude_std(s)


@compiled
def take_imu(
    s: ComplementaryState,
    p: ComplementaryGains,
    time_us: int,
    row: FloatArray,
) -> None:
    """Advance by one IMU sample; see `columns` for its row.

    A sample that is late is left out; a clock that went far back is a new clock.
    """
    gyro, accel, mag = imu_vectors(row)
    note_calibration(s, p, row)
    if s.started == 0:
        begin(s, p, time_us, gyro, accel)
        return
    dt = step_clock(s, time_us)
    if dt <= 0.0:
        if dt < -GAP_S:
            forget_times(s)
        return
    if is_silent(s, gyro, accel, is_moving(s, p), dt):
        bridge_silence(s, p, gyro, accel, dt)
        write_attitude_std(s)
        return
    move(s, p, gyro, accel, row[CLIPPED], dt)
    follow_rate(s, dt)
    misplaced = s.mag_misplaced
    if is_field_told(s, mag, dt):
        # Not while gravity holds the level: in fast turns its low-pass lags as well, which the dip
        # turns into heading, and recorded motion did better with the field as it came.
        present = present_field(s, mag)
        take_mag(s, p, present if s.level_by_gps == 1 else mag)
    elif s.mag_misplaced > misplaced:
        doubt_sensors(s, p)
        lose_attitude(s, p)
    refresh(s)


@compiled
def move(
    s: ComplementaryState, p: ComplementaryGains, gyro: Vec3, accel: Vec3, clipped: float, dt: float
) -> None:
    """Integrate one sample, or what stands in for it."""
    gyro_before, accel_before = as_vec(s.gyro_held), as_vec(s.accel_held)
    sound_gyro, sound_accel = check_sensors(s, gyro, accel, clipped, dt)
    newest, unseen_s = gyro, 0.0
    if sound_gyro and sound_accel:
        collect_roughness(s, gyro, accel, gyro_before, accel_before, dt)
        gyro, accel, unseen_s = mean_over_step(s, gyro_before, accel_before, gyro, accel, dt)
    if clipped != 0.0:
        doubt_clipped(s, dt)
    advance(s, p, gyro, accel, sound_gyro, sound_accel, dt)
    if unseen_s > 0.0:
        doubt_lost(s, gyro_before, newest, accel, unseen_s)


@compiled
def advance(
    s: ComplementaryState,
    p: ComplementaryGains,
    gyro: Vec3,
    accel: Vec3,
    sound_gyro: bool,
    sound_accel: bool,
    dt: float,
) -> None:
    """Integrate one sample and correct by gravity where GPS does not do it better."""
    if not sound_gyro:
        gyro = rate_instead(s, as_vec(s.bias_b))
    strapdown(s, gyro, dt)
    refresh(s)
    note_turn(s, dt)
    if not sound_accel:
        level = rotate_inverse(as_quat(s.q_nb), (0.0, 0.0, -STANDARD_GRAVITY_MPS2))
        accel = force_instead(s, level)
    since_fix = s.time_s - s.fix_s
    if sound_gyro and sound_accel:
        look_for_rest(s, p, gyro, accel, dt)
        watch_gravity(s, p)
    coasting = since_fix < p.coast_s and s.at_rest == 0 and is_under_way(s)
    by_gps = since_fix < FRESH_GPS_S or coasting
    if sound_accel and not (by_gps and is_heading_good(s)):
        if s.level_by_gps == 1:
            end_level(s, p)
            go_on_by_gravity(s)
        take_gravity(s, rotate(as_quat(s.q_ib), accel), s.gravity_tau_s, dt)
        s.epoch_s += dt
        if s.epoch_s >= EPOCH_S:
            if s.by_gps == 0 or s.pull_mps2 < PULL_MPS2:
                update_bias(s, p, s.gravity_tau_s, s.epoch_s)
            s.epoch_s = 0.0
    dead_reckon(s, accel, dt)
    if s.at_rest == 1 and since_fix > FRESH_GPS_S:
        stand_still(s, dt)
    s.ring_count = remember(s.ring, s.ring_count, s.time_s, s.integrals)
    watch_accuracy(s, p)


@compiled
def look_for_rest(
    s: ComplementaryState, p: ComplementaryGains, gyro: Vec3, accel: Vec3, dt: float
) -> None:
    """Look whether the aircraft stands, and what that says of the gyroscope's bias."""
    moving, rested, bias_b = is_moving(s, p), s.at_rest == 1, as_vec(s.bias_b)
    since_fix = s.time_s - s.fix_s
    turning = turns_steadily(s, bias_b, bias_std(s), dt) and since_fix > FRESH_GPS_S
    watch_rest(s, p, gyro, accel, moving or turning or is_pushed_on(s, dt), since_fix, dt)
    raise_bias_variance(s, DOUBT * doubt_rest_bias(s, bias_b, rested, moving, dt))
    if has_spun(s, bias_b):
        take_rest_bias(s, p)


@compiled
def is_pushed_on(s: ComplementaryState, dt: float) -> bool:
    """Return whether a steady force pushes, as far as the level is known."""
    std = STANDARD_GRAVITY_MPS2 * max(s.told_std[0], s.told_std[1])
    unsure = math.inf if s.lost == 1 else 2.0 * std * std
    return is_pushed(s, rotate(as_quat(s.q_eb), as_vec(s.accel_lp)), unsure, dt)


@compiled
def doubt_lost(
    s: ComplementaryState, gyro_before: Vec3, gyro: Vec3, accel: Vec3, unseen_s: float
) -> None:
    """Doubt the attitude where samples were lost: the mean of both ends stands in for them."""
    turned, pulled = unseen_variances(s, gyro_before, gyro, as_vec(s.bias_b), accel, unseen_s)
    s.unseen_m2ps2 += pulled
    raise_attitude_variance(s, math.sqrt(turned))
    doubt_held_level(s, turned)
    doubt_pairs(s, turned)


@compiled
def doubt_clipped(s: ComplementaryState, dt: float) -> None:
    """Doubt attitude and velocity where a sensor was at the end of its range."""
    turned_sq, pulled_sq = clipped_squares(s)
    raise_attitude_variance(s, math.sqrt(turned_sq) * dt)
    s.clipped_mps += math.sqrt(pulled_sq) * dt


@compiled
def go_on_by_gravity(s: ComplementaryState) -> None:
    """Let gravity's low-pass, which rested, hold the level from where it is."""
    hold_level(s)
    s.force_lp_s = max(s.force_lp_s, s.gravity_tau_s)
    s.turn_begins = 1


@compiled
def is_under_way(s: ComplementaryState) -> bool:
    """Return whether the last fixes saw the aircraft move."""
    return math.hypot(s.fix_vel[0], s.fix_vel[1]) > MOVING_MPS


@compiled
def is_moving(s: ComplementaryState, p: ComplementaryGains) -> bool:
    """Return whether GPS or dead reckoning says that the aircraft moves.

    A bias that has jumped has turned the level, which then pulls the speed: only fixes tell it.
    """
    since_fix = s.time_s - s.fix_s
    if since_fix > DEAD_RECKONING_MAX_S:
        return False
    fresh = since_fix <= FRESH_GPS_S
    if fresh and s.bias_jumped == 1:
        return math.hypot(s.fix_vel[0], s.fix_vel[1]) > p.rest_speed_mps
    unsure_sq = 0.0
    if not fresh:
        unsure_sq = s.told_speed_mps[0] ** 2 + s.told_speed_mps[1] ** 2
    return outruns(math.hypot(s.vel_n[0], s.vel_n[1]), unsure_sq, p)


KERNELS: Final[Kernels[ComplementaryState, ComplementaryGains]] = kernels_of(
    ComplementaryState, ComplementaryGains, start, take_imu, take_baro, take_gps, write_output
)
