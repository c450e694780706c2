"""Beginnings: of the filter, of the heading, of position and velocity; and after a gap."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.covariance import decorrelate, propagate
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import (
    ACCEL_BIAS,
    BARO_BIAS,
    GYRO_BIAS,
    GYRO_SCALE,
    MAG_BIAS,
    POS,
    STATES,
    TILT,
    VEL,
    WANDER,
    EskfState,
)
from gateway.estimation.eskf.measure import compass_row
from gateway.estimation.kernel_record import as_quat, as_vec, write_quat, write_vec
from gateway.estimation.local_position import NEVER_S
from gateway.estimation.sensor_faults import ACCEL_LIMIT_MPS2, GYRO_LIMIT_RADPS, is_sound
from gateway.geometry.quaternion import from_euler, multiply, normalise
from gateway.records import NAN, Vec3

FIRST_TILT_VAR: Final = 0.05**2
NO_HEADING_VAR: Final = 3.0
FIRST_VELOCITY_VAR: Final = 0.5**2
GAP_TILT_RATE: Final = 0.05
"""Over a gap the attitude may have changed by this much a second, rad/s."""
GAP_ACCEL_MPS2: Final = 3.0
GAP_TILT_LIMIT_RAD: Final = 0.6
RELOCK_HEADING_VAR: Final = 0.3**2


@compiled
def start(s: EskfState, p: EskfGains) -> None:
    """Set a fresh state."""
    write_quat(s.q_nb, (1.0, 0.0, 0.0, 0.0))
    for k in range(3):
        s.P[GYRO_BIAS + k, GYRO_BIAS + k] = p.gyro_bias_var
        s.P[ACCEL_BIAS + k, ACCEL_BIAS + k] = p.accel_bias_var
        s.P[GYRO_SCALE + k, GYRO_SCALE + k] = p.gyro_scale_var
        s.wander_var[k] = p.gps_wander_var if k < 2 else p.gps_height_wander_var
        s.P[WANDER + k, WANDER + k] = s.wander_var[k]
        s.rate_b[k] = NAN
    s.declination_rad = NAN
    forget_times(s)


@compiled
def forget_times(s: EskfState) -> None:
    """Drop all that is tied to the clock."""
    s.mag_s = s.mag_used_s = s.fix_s = s.fix_valid_s = s.baro_s = s.pseudo_s = NEVER_S
    s.reject_last[0] = NEVER_S
    s.reject_s = s.rest_s = 0.0
    s.ring_count = s.at_rest = 0


@compiled
def begin(s: EskfState, p: EskfGains, time_us: int, gyro: Vec3, accel: Vec3) -> None:
    """Start at the first sound sample, level by its specific force."""
    s.fault = 0 if is_sound(gyro, GYRO_LIMIT_RADPS) and is_sound(accel, ACCEL_LIMIT_MPS2) else 1
    if s.fault == 1:
        return
    s.started, s.base_us, s.time_us, s.time_s = 1, time_us, time_us, 0.0
    write_vec(s.gyro_lp, gyro)
    write_vec(s.gyro_rest, gyro)
    write_vec(s.accel_lp, accel)
    write_vec(s.rate_b, gyro)
    roll = math.atan2(-accel[1], -accel[2])
    pitch = math.atan2(accel[0], math.hypot(accel[1], accel[2]))
    write_quat(s.q_nb, from_euler(roll, pitch, 0.0))
    decorrelate(s.P, TILT, FIRST_TILT_VAR)
    decorrelate(s.P, TILT + 1, FIRST_TILT_VAR)
    decorrelate(s.P, TILT + 2, NO_HEADING_VAR)
    for k in range(3):
        decorrelate(s.P, VEL + k, p.unaided_var)


@compiled
def turn_heading(s: EskfState, turn_rad: float) -> None:
    """Turn the whole attitude about down."""
    half = 0.5 * turn_rad
    turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    write_quat(s.q_nb, normalise(multiply(turn, as_quat(s.q_nb))))
    # The integrals stand in the old heading.
    s.ring_count = 0
    s.fix_valid_s = NEVER_S


@compiled
def start_heading_by_compass(s: EskfState, p: EskfGains, turn_rad: float) -> None:
    """Take the heading from the compass."""
    turn_heading(s, turn_rad)
    decorrelate(s.P, TILT + 2, p.mag_var)
    s.heading_known = 1


@compiled
def start_iron_search(s: EskfState, p: EskfGains) -> None:
    """Look for iron that the calibration left, once the GPS can tell it from the heading.

    A heading that came from the compass has the iron's error, reversed.
    """
    if s.iron_search_started == 1:
        return
    s.iron_search_started = 1
    by_compass = s.field_n[0] != 0.0 or s.field_n[1] != 0.0
    if by_compass:
        compass_row(s, as_vec(s.field_n))
    for k in range(3):
        decorrelate(s.P, MAG_BIAS + k, p.mag_bias_var)
        if by_compass:
            share = s.h[MAG_BIAS + k]
            set_covariance(s, TILT + 2, MAG_BIAS + k, -share * p.mag_bias_var)
            s.P[TILT + 2, TILT + 2] += share * share * p.mag_bias_var


@compiled
def start_heading_by_match(s: EskfState, turn_rad: float, variance: float) -> None:
    """Take the heading from GPS against inertial acceleration."""
    turn_heading(s, turn_rad)
    decorrelate(s.P, TILT + 2, variance)
    s.heading_known = s.heading_true = 1


@compiled
def restart_at(s: EskfState, p: EskfGains, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Take position and velocity from one fix alone.

    Parameters
    ----------
    s : EskfState
        Changed in place.
    p : EskfGains
        Constants.
    pos, vel : tuple of 3 floats
        The fix, metres from the origin and m/s.
    lag : float
        Its age, s.
    """
    propagate(s, p)
    for k in range(3):
        decorrelate(s.P, VEL + k, FIRST_VELOCITY_VAR)
        s.vel_n[k] = vel[k]
    for k in range(2):
        start_position(s, k, pos[k] + vel[k] * lag, p.gps_position_var)
    if s.has_height == 0:
        down = pos[2] + vel[2] * lag
        start_position(s, 2, down, p.gps_height_var)
        s.has_height = 1
        if s.baro_known == 1:
            restart_baro(s, p)
    s.aided = 1
    start_iron_search(s, p)
    s.off_last_m = s.contradiction_m = 0.0


@compiled
def restart_baro(s: EskfState, p: EskfGains) -> None:
    """Take the barometer's offset from the present height."""
    propagate(s, p)
    s.baro_bias_m = s.pos_n[2] - s.baro_down_m
    for j in range(STATES):
        s.P[BARO_BIAS, j] = s.P[POS + 2, j]
        s.P[j, BARO_BIAS] = s.P[j, POS + 2]
    s.P[BARO_BIAS, BARO_BIAS] = s.P[POS + 2, POS + 2] + p.baro_var


@compiled
def set_covariance(s: EskfState, i: int, j: int, covariance: float) -> None:
    """Set one covariance."""
    s.P[i, j] = s.P[j, i] = covariance


@compiled
def start_position(s: EskfState, k: int, value: float, noise_var: float) -> None:
    """Start one coordinate at a fix: the fix's slow error is then its own, reversed."""
    wander_var = s.wander_var[k]
    s.pos_n[k], s.wander_n[k] = value, 0.0
    decorrelate(s.P, POS + k, wander_var + noise_var)
    decorrelate(s.P, WANDER + k, wander_var)
    set_covariance(s, POS + k, WANDER + k, -wander_var)


@compiled
def relock_at(s: EskfState, p: EskfGains, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Start anew where fixes have insisted; whatever was wrong may be the heading."""
    restart_at(s, p, pos, vel, lag)
    s.P[TILT + 2, TILT + 2] += RELOCK_HEADING_VAR


@compiled
def end_dead_reckoning(s: EskfState, p: EskfGains) -> None:
    """Give position and velocity up; from here on the velocity only keeps the attitude level."""
    propagate(s, p)
    s.aided = 0
    for k in range(3):
        decorrelate(s.P, VEL + k, p.unaided_var)
        s.vel_n[k] = 0.0


@compiled
def bridge_gap(s: EskfState, p: EskfGains, dt: float) -> None:
    """Go on after a silence: straight ahead, and much less sure."""
    propagate(s, p)
    s.fault = 1
    turned = min(GAP_TILT_RATE * dt, GAP_TILT_LIMIT_RAD)
    for k in range(3):
        if s.aided == 1:
            s.pos_n[k] += s.vel_n[k] * dt
        s.P[TILT + k, TILT + k] += turned * turned
        s.P[VEL + k, VEL + k] += (GAP_ACCEL_MPS2 * dt) ** 2
        s.P[POS + k, POS + k] += (0.5 * GAP_ACCEL_MPS2 * dt * dt) ** 2
    s.ring_count = 0
    s.fix_valid_s = NEVER_S
    s.rest_s = 0.0
    s.at_rest = 0
