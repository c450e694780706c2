"""Propagation and scalar updates of the covariance.

The transition matrix is the identity and five 3x3 blocks, so its products are written out row by
row. A measurement of three numbers is three scalar updates: no matrix is ever inverted.

References
----------
.. [1] J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, ch. 5 and 7
   (global attitude error).
"""

import math
from typing import Final

from gateway.compiled import compiled
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
from gateway.estimation.filtering.bias_evidence import (
    note_bias_correction,
    unexpected_bias_density,
    watch_bias_corrections,
)
from gateway.estimation.filtering.covariance_scale import limit_variance, scale_state
from gateway.estimation.filtering.roughness import note_force_noise
from gateway.estimation.kernel_record import FloatArray, as_quat, fill, write_quat
from gateway.geometry.quaternion import from_rotation_vector, multiply, normalise
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

MOVED: Final = POS + 3
"""The transition changes the first states alone: attitude, velocity, place."""
SCALE_S: Final = 1.0
"""An acceleration keeps its axis in the body for about this time, and its error its sign."""
GYRO_BY_FORCE: Final = 0.1 * RAD_PER_DEG / STANDARD_GRAVITY_MPS2
"""Force beside gravity turns what an MPU6050's gyroscope tells by 0.1 deg/s for each g."""
NO_HEADING_VAR: Final = 3.0
"""A heading of which nothing is known; more would only break the linearisation."""


@compiled
def propagate(s: EskfState, p: EskfGains) -> None:
    """Carry the covariance over the pending time: `F P F^T + Q`.

    With `R` the integral of `R_nb`, `f` that of the specific force in NED and `dt` the time:
    `tilt' = tilt - R gyro_bias - R diag(gyro) gyro_scale`,
    `vel' = vel + tilt x f - R accel_bias`, `pos' = pos + vel dt`.
    """
    dt = s.pending_s
    if dt <= 0.0:
        return
    apply_transition(s, s.P, STATES)
    mirror(s.P)
    apply_transition(s, s.P, MOVED)
    symmetrise(s.P)
    turned = p.gyro_roughness_sq * s.rough_gyro + p.gyro_turn_var * s.pending_rad + s.unseen_rad2
    s.force_turn_var += GYRO_BY_FORCE**2 * SCALE_S * s.pending_accel_sq
    pulled = p.accel_scale_sq * SCALE_S * s.pending_accel_sq + p.accel_roughness_sq * s.rough_accel
    pulled += s.unseen_m2ps2
    note_force_noise(s, dt)
    s.unseen_rad2 = s.unseen_m2ps2 = 0.0
    s.pending_accel_sq = s.rough_gyro = s.rough_accel = s.pending_rad = 0.0
    kept = math.exp(-dt / p.gps_wander_s)
    for k in range(3):
        s.P[TILT + k, TILT + k] += turned + p.gyro_density * dt
        s.P[VEL + k, VEL + k] += pulled + p.accel_density * dt
        s.P[POS + k, POS + k] += s.place_density[k] * dt
        s.P[GYRO_BIAS + k, GYRO_BIAS + k] += p.gyro_bias_density * dt
        raise_bias(s, p, k, unexpected_bias_density(s, k) * dt)
        s.P[ACCEL_BIAS + k, ACCEL_BIAS + k] += p.accel_bias_density * dt
        s.P[MAG_BIAS + k, MAG_BIAS + k] += p.mag_bias_density * dt
        decay(s.P, WANDER + k, kept, s.wander_var[k])
        s.wander_n[k] *= kept
    s.P[BARO_BIAS, BARO_BIAS] += p.baro_density * dt
    limit_variance(s.P, TILT + 2, NO_HEADING_VAR)
    watch_bias_corrections(s, s.heading_known == 1 and s.aided == 1, dt)
    s.pending_s = 0.0
    fill(s.pending_force_n, 0.0)
    for k in range(3):
        for j in range(3):
            s.pending_turn[k, j] = s.pending_scaled[k, j] = 0.0


@compiled
def raise_bias(s: EskfState, p: EskfGains, k: int, more: float) -> None:
    """Add to the variance of an axis of the bias, up to what it began with."""
    more = min(more, max(p.gyro_bias_var - s.P[GYRO_BIAS + k, GYRO_BIAS + k], 0.0))
    s.P[GYRO_BIAS + k, GYRO_BIAS + k] += more
    s.bias_raised[k] += more


@compiled
def apply_transition(s: EskfState, P: FloatArray, columns: int) -> None:
    """Multiply the first columns of `P` by the transition matrix from the left.

    Unaided, the velocity counts in the frame of the heading that is told: it is assumed to be about
    zero, which is so for any heading. Else the assumption would seem to tell the heading, the more
    the harder it accelerates.
    """
    R, W, dt, f = s.pending_turn, s.pending_scaled, s.pending_s, s.pending_force_n
    for j in range(columns):
        for k in range(3):
            P[POS + k, j] += dt * P[VEL + k, j]
        turn = P[TILT + 2, j] if s.aided == 1 else 0.0
        P[VEL, j] += P[TILT + 1, j] * f[2] - turn * f[1]
        P[VEL + 1, j] += turn * f[0] - P[TILT, j] * f[2]
        P[VEL + 2, j] += P[TILT, j] * f[1] - P[TILT + 1, j] * f[0]
    for i in range(3):
        for k in range(3):
            for j in range(columns):
                P[VEL + i, j] -= R[i, k] * P[ACCEL_BIAS + k, j]
                P[TILT + i, j] -= R[i, k] * P[GYRO_BIAS + k, j] + W[i, k] * P[GYRO_SCALE + k, j]


@compiled
def mirror(P: FloatArray) -> None:
    """Turn the product from the left about the diagonal, for one from the right.

    That changes the columns of the states that move. The rows of these keep what is final: their
    covariances with the others.
    """
    for j in range(MOVED):
        for i in range(j + 1, STATES):
            upper = P[j, i]
            if i < MOVED:
                P[j, i] = P[i, j]
            P[i, j] = upper


@compiled
def symmetrise(P: FloatArray) -> None:
    """Take the rounding off that makes `P` lopsided, which grows without bound in long flights."""
    for i in range(STATES):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@compiled
def decay(P: FloatArray, k: int, kept: float, steady: float) -> None:
    """Let one state fade towards zero while noise keeps its variance at `steady`."""
    scale_state(P, k, kept)
    P[k, k] += steady * (1.0 - kept * kept)


@compiled
def renew(s: EskfState, k: int, variance: float) -> None:
    """Begin one state anew: with a variance that has nothing to do with the others."""
    s.renewals[k] += 1.0
    for j in range(STATES):
        s.P[k, j] = 0.0
        s.P[j, k] = 0.0
    s.P[k, k] = variance


@compiled
def clear(s: EskfState) -> None:
    """Begin a measurement: an empty row, no state held."""
    fill(s.h, 0.0)
    fill(s.considered, 0.0)
    if s.scale_known == 1:
        consider(s, GYRO_SCALE, 3)


@compiled
def residual(s: EskfState, innovation: float) -> float:
    """Take from an innovation what the measurements before it in the group have explained."""
    for j in range(STATES):
        innovation -= s.h[j] * s.dx[j]
    return innovation


@compiled
def innovation_variance(s: EskfState, variance: float) -> float:
    """Compute `P h` and the variance of the innovation, `h^T P h` and the noise."""
    fill(s.Ph, 0.0)
    for j in range(STATES):
        if s.h[j] != 0.0:
            for i in range(STATES):
                s.Ph[i] += s.P[i, j] * s.h[j]
    total = variance
    for i in range(STATES):
        total += s.h[i] * s.Ph[i]
    return total


@compiled
def lasting_excess(off: float, explained: float, gate_sq: float, shared: float) -> float:
    """Return the noise that errs as much as an error which lasts.

    Parameters
    ----------
    off, explained : float
        What of the innovation counts, and the variance that it may have.
    gate_sq : float
        Beyond so many times that, it is no noise of a single measurement.
    shared : float
        How many measurements share the error.

    Returns
    -------
    float
        Variance; not positive within the gate.
    """
    return (off * off / gate_sq - explained) * shared


@compiled
def normalised_innovation_sq(s: EskfState, innovation: float, variance: float) -> float:
    """Return the normalised innovation squared of the row in `h`."""
    rest = residual(s, innovation)
    return rest * rest / innovation_variance(s, variance)


@compiled
def update_scalar(s: EskfState, innovation: float, variance: float, gate_sq: float) -> None:
    """Update by one number whose row stands in `h`; the states in `considered` are only considered.

    Their gain is zero, their uncertainty still counts: the Schmidt-Kalman update. It is for
    measurements whose errors are not white, which other states would take the blame for.

    Parameters
    ----------
    s : EskfState
        `P` and `dx` are changed.
    innovation : float
        Measured less expected.
    variance : float
        Of the measurement.
    gate_sq : float
        An innovation further off counts as one so many squared standard deviations away: its
        variance is raised until it is, so an outlier does little and a lasting one wins.
    """
    rest = residual(s, innovation)
    total = max(innovation_variance(s, variance), rest * rest / gate_sq)
    std = math.sqrt(total)
    for k in range(3):
        if s.considered[GYRO_BIAS + k] == 0.0:
            note_bias_correction(s, k, rest / std, s.Ph[GYRO_BIAS + k] / std)
    for i in range(STATES):
        gain = s.Ph[i] / total
        s.dx[i] += (1.0 - s.considered[i]) * gain * rest
        for j in range(STATES):
            s.P[i, j] -= (1.0 - s.considered[i] * s.considered[j]) * gain * s.Ph[j]


@compiled
def level_variance(s: EskfState) -> float:
    """Return the variance of the tilt, rad2."""
    return float(s.P[TILT, TILT] + s.P[TILT + 1, TILT + 1])


@compiled
def fade_force_turn(s: EskfState, level_before: float) -> None:
    """Take what force has turned to be found out as far as the rest of the tilt is."""
    s.force_turn_var *= level_variance(s) / level_before


@compiled
def consider(s: EskfState, first: int, count: int) -> None:
    """Mark states as only considered."""
    fill(s.considered[first : first + count], 1.0)


@compiled
def inject(s: EskfState) -> None:
    """Move the errors found into the nominal state."""
    d = s.dx
    turn = from_rotation_vector((d[TILT], d[TILT + 1], d[TILT + 2]))
    write_quat(s.q_nb, normalise(multiply(turn, as_quat(s.q_nb))))
    for k in range(3):
        s.vel_n[k] += d[VEL + k]
        s.pos_n[k] += d[POS + k]
        s.gyro_bias_b[k] += d[GYRO_BIAS + k]
        s.accel_bias_b[k] += d[ACCEL_BIAS + k]
        s.gyro_scale_b[k] += d[GYRO_SCALE + k]
        s.wander_n[k] += d[WANDER + k]
        s.mag_bias_b[k] += d[MAG_BIAS + k]
    s.baro_bias_m += d[BARO_BIAS]
    fill(d, 0.0)
