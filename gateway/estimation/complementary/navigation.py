"""Position and velocity: dead reckoning between fixes, blended at each fix as of when it was valid.

Horizontally the paper's eq. 1, 2, 7 and 8 as recursions; the weights follow from a time constant,
so they suit any fix rate. Vertically the barometer, offset to the GPS height, blends in the same
way and also learns the error of the vertical acceleration.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import GPS_H_ACC
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.filtering.height_intake import compare_height, is_height_told
from gateway.estimation.kernel_record import FloatArray, as_quat, write_vec
from gateway.estimation.local_position import BARO_STALE_S
from gateway.geometry.quaternion import rotate
from gateway.records import NAN, Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

DRIFT_MPS2: Final = 1.0
"""Acceleration error that dead reckoning may have had, for the gates."""
BLUNDER_H_ACC_M: Final = 30.0
ACCEL_BIAS_LIMIT_MPS2: Final = 1.0
REST_DECAY_S: Final = 0.5


@compiled
def dead_reckon(s: ComplementaryState, force_b: Vec3, dt: float) -> None:
    """Integrate the acceleration twice: the inertial path of eq. 1, 2, 7 and 8.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    force_b : tuple of 3 floats
        Specific force in body FRD, m/s2.
    dt : float
        Time step, s.
    """
    force_i = rotate(as_quat(s.q_ib), force_b)
    b = s.accel_bias_b
    unbiased = (force_b[0] - b[0], force_b[1] - b[1], force_b[2] - b[2])
    north, east, down = rotate(as_quat(s.q_nb), unbiased)
    accel = (north, east, down + STANDARD_GRAVITY_MPS2 - s.accel_bias_d)
    if s.lost == 1:
        # With no attitude to turn it by, the force is of no use: straight on between fixes.
        accel = (0.0, 0.0, 0.0)
    for k in range(3):
        s.integrals[6 + k] += (s.integrals[3 + k] + 0.5 * accel[k] * dt) * dt
        s.integrals[3 + k] += accel[k] * dt
        s.integrals[k] += force_i[k] * dt
        s.pos_n[k] += (s.vel_n[k] + 0.5 * accel[k] * dt) * dt
        s.vel_n[k] += accel[k] * dt


@compiled
def restart_at(s: ComplementaryState, pos: Vec3, vel: Vec3, lag: float) -> None:
    """Take position and velocity from one fix alone."""
    write_vec(s.vel_n, vel)
    for k in range(2):
        s.pos_n[k] = pos[k] + vel[k] * lag
    down = pos[2] + vel[2] * lag
    if math.isfinite(down):
        start_height(s, down)


@compiled
def start_height(s: ComplementaryState, down_m: float) -> None:
    """Take the height from one fix alone; it tells what the barometer's is off by, too."""
    if s.baro_known == 1:
        s.baro_offset_m += down_m - s.pos_n[2]
    s.pos_n[2], s.has_height = down_m, 1


@compiled
def doubt_height(s: ComplementaryState, pos: Vec3) -> Vec3:
    """Return the place of a fix, without a height that is far from all before it.

    A first height is given up if the next two contradict it and agree with one another.
    """
    if not math.isfinite(pos[2]):
        return pos
    told, agrees = compare_height(s.fix_heights, -pos[2], s.time_s - s.fix_s)
    if s.has_height == 0:
        s.fix_heights[1], s.fix_height_agreed = -pos[2], 0
    elif not told:
        return (pos[0], pos[1], NAN)
    elif agrees:
        s.fix_height_agreed = 1
    elif s.fix_height_agreed == 0:
        s.has_height = 0
    return pos


@compiled
def is_plausible(
    s: ComplementaryState, p: ComplementaryGains, row: FloatArray, off_m: float, off_mps: float
) -> bool:
    """Judge a fix by its distance from dead reckoning, the wider the longer that has run."""
    age = min(s.time_s - s.fix_s, 120.0)
    h_acc = row[GPS_H_ACC]
    allowed_m = p.gps_gate_m + (0.5 * DRIFT_MPS2 * age + s.clipped_mps) * age
    if math.isfinite(h_acc):
        allowed_m += 3.0 * min(h_acc, BLUNDER_H_ACC_M)
    return off_m < allowed_m and off_mps < p.gps_gate_mps + DRIFT_MPS2 * age + s.clipped_mps


@compiled
def blend_fix(
    s: ComplementaryState,
    p: ComplementaryGains,
    pos: Vec3,
    vel: Vec3,
    past: tuple[Vec3, Vec3],
    lag: float,
) -> None:
    """Blend one accepted fix: eq. 1, 2, 7 and 8 at the time the fix was valid.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    pos, vel : tuple of 3 floats
        The fix.
    past : tuple
        Own position and velocity at that time.
    lag : float
        How long ago that was, s.
    """
    dt = max(s.time_s - s.fix_s, 1e-3)
    gain_vel = 1.0 - math.exp(-dt / p.tau_velocity_s)
    gain_pos = 1.0 - math.exp(-dt / p.tau_position_s)
    for k in range(2):
        step = gain_vel * (vel[k] - past[1][k])
        s.pos_n[k] += gain_pos * (pos[k] - past[0][k]) + step * lag
        s.vel_n[k] += step
    if not math.isfinite(pos[2]):
        return
    if s.has_height == 0:
        start_height(s, pos[2] + vel[2] * lag)
        return
    baro_fresh = s.baro_known == 1 and s.time_s - s.baro_s < BARO_STALE_S
    if baro_fresh:
        gain = 1.0 - math.exp(-dt / p.tau_baro_offset_s)
        shift = gain * (pos[2] - past[0][2])
        s.baro_offset_m += shift
        s.pos_n[2] += shift
    else:
        step = gain_vel * (vel[2] - past[1][2])
        s.pos_n[2] += gain_pos * (pos[2] - past[0][2]) + step * lag
        s.vel_n[2] += step


@compiled
def take_baro(s: ComplementaryState, p: ComplementaryGains, alt_m: float) -> None:
    """Blend one barometer height.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place.
    p : ComplementaryGains
        Constants.
    alt_m : float
        Pressure altitude, positive up.
    """
    if not is_height_told(s, alt_m):
        return
    down = -alt_m
    if s.baro_known == 0 or s.time_s - s.baro_s > BARO_STALE_S:
        if s.has_height == 0:
            s.pos_n[2], s.vel_n[2], s.baro_offset_m = down, 0.0, 0.0
        else:
            s.baro_offset_m = s.pos_n[2] - down
        s.baro_known = 1
        s.baro_s = s.time_s
        return
    dt = min(s.time_s - s.baro_s, 0.25 * p.tau_baro_s)
    s.baro_s = s.time_s
    error = down + s.baro_offset_m - s.pos_n[2]
    rate = dt / p.tau_baro_s
    s.pos_n[2] += 3.0 * rate * error
    s.vel_n[2] += 3.0 * rate / p.tau_baro_s * error
    bias = s.accel_bias_d - rate / (p.tau_baro_s * p.tau_baro_s) * error
    s.accel_bias_d = max(-ACCEL_BIAS_LIMIT_MPS2, min(ACCEL_BIAS_LIMIT_MPS2, bias))


@compiled
def stand_still(s: ComplementaryState, dt: float) -> None:
    """Let the velocity fade while the aircraft stands."""
    kept = math.exp(-dt / REST_DECAY_S)
    for k in range(3):
        s.vel_n[k] *= kept
