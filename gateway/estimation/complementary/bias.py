"""The gyroscope's bias: learned at rest, and in motion from what the level correction undoes.

A Kalman filter of three states. In motion the rate at which gravity has to pull the level frame
back is the horizontal part of the bias error, seen through the same low-pass as gravity itself.
The gains follow from the accuracy to be reached and from a drift of 0.1 deg/s in 100 s.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.heading import carry_heading
from gateway.estimation.complementary.tilt import cutoff_radps, low_pass
from gateway.estimation.kernel_record import as_quat
from gateway.geometry.quaternion import rotate, wrap_pi
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG

DRIFT_RAD2PS: Final = (0.1 * RAD_PER_DEG) ** 2 / 100.0
CLIP_RADPS: Final = 2.0 * RAD_PER_DEG
"""No single observation moves the bias by more than its gain times this."""


@compiled
def update_bias(s: ComplementaryState, p: ComplementaryGains, tau_s: float, dt: float) -> None:
    """Update the bias at the end of an epoch.

    Parameters
    ----------
    s : ComplementaryState
        Changed in place; `tilt_sum` is used up.
    p : ComplementaryGains
        Constants.
    tau_s : float
        Time constant of gravity's low-pass in this epoch.
    dt : float
        Length of the epoch, s.
    """
    carry_heading(s)
    growth = DRIFT_RAD2PS * dt
    for k in range(3):
        s.bias_cov[k, k] = min(s.bias_cov[k, k] + growth, p.bias_initial_radps**2)
    watch_turn(s, tau_s, dt)
    settled = s.force_lp_s > tau_s
    if s.at_rest == 1:
        variance = noise_for(p.bias_rest_radps, growth)
        for k in range(3):
            row = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
            correct_bias(s, p, row, s.gyro_rest[k], variance)
    elif settled:
        variance = noise_for(p.bias_motion_radps, growth)
        for k in range(2):
            row = (s.turn_lp[3 * k], s.turn_lp[3 * k + 1], s.turn_lp[3 * k + 2])
            # The low-passed frame falls behind by the bias error, and gravity pulls it back.
            correct_bias(s, p, row, s.turn_lp[6 + k] - s.tilt_sum[k] / dt, variance)
    s.tilt_sum[0] = s.tilt_sum[1] = 0.0


@compiled
def raise_bias_variance(s: ComplementaryState, std: float) -> None:
    """Believe the bias no more firmly than to a standard deviation in rad/s."""
    for k in range(3):
        s.bias_cov[k, k] = max(s.bias_cov[k, k], std * std)


@compiled
def noise_for(accuracy: float, growth: float) -> float:
    """Find the measurement variance at which the filter settles at an accuracy."""
    steady = accuracy * accuracy
    return steady * steady / growth + steady


@compiled
def watch_turn(s: ComplementaryState, tau_s: float, dt: float) -> None:
    """Low-pass the level rows of `R_eb`, and the level rates that the bias makes up."""
    q = as_quat(s.q_eb)
    x, y, z = rotate(q, (1.0, 0.0, 0.0)), rotate(q, (0.0, 1.0, 0.0)), rotate(q, (0.0, 0.0, 1.0))
    cutoff = cutoff_radps(tau_s)
    for k in range(2):
        row = (x[k], y[k], z[k])
        product = row[0] * s.bias_b[0] + row[1] * s.bias_b[1] + row[2] * s.bias_b[2]
        for j in range(3):
            settle(s, 3 * k + j, row[j], cutoff, dt, tau_s)
        settle(s, 6 + k, product, cutoff, dt, tau_s)


@compiled
def settle(s: ComplementaryState, k: int, u: float, cutoff: float, dt: float, tau_s: float) -> None:
    """Low-pass one channel; while gravity's filter is still a mean, follow at once."""
    if s.force_lp_s < tau_s:
        s.turn_lp[k], s.turn_in[k], s.turn_lp_rate[k] = u, u, 0.0
    else:
        low_pass(s.turn_lp, s.turn_lp_rate, s.turn_in, k, u, cutoff, dt)


@compiled
def correct_bias(
    s: ComplementaryState, p: ComplementaryGains, row: Vec3, measured: float, variance: float
) -> None:
    """Scalar Kalman update of the three bias states by `row @ bias = measured`."""
    P, b = s.bias_cov, s.bias_b
    column = (
        P[0, 0] * row[0] + P[0, 1] * row[1] + P[0, 2] * row[2],
        P[1, 0] * row[0] + P[1, 1] * row[1] + P[1, 2] * row[2],
        P[2, 0] * row[0] + P[2, 1] * row[1] + P[2, 2] * row[2],
    )
    expected = row[0] * b[0] + row[1] * b[1] + row[2] * b[2]
    spread = row[0] * column[0] + row[1] * column[1] + row[2] * column[2] + variance
    innovation = max(-CLIP_RADPS, min(CLIP_RADPS, measured - expected))
    if not math.isfinite(innovation):
        return
    c = s.heading_cov
    shared = row[0] * c[0] + row[1] * c[1] + row[2] * c[2]
    s.heading_rad = wrap_pi(s.heading_rad + shared / spread * innovation)
    s.heading_var -= shared * shared / spread
    for k in range(3):
        c[k] -= column[k] * shared / spread
        b[k] += column[k] / spread * innovation
        b[k] = max(-p.bias_limit_radps, min(p.bias_limit_radps, b[k]))
        for j in range(3):
            P[k, j] -= column[k] * column[j] / spread
