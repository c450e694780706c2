"""The gyroscope's bias: learned at rest, and in motion from what the level correction undoes.

A Kalman filter of three states. In motion the rate at which gravity has to pull the level frame
back is the horizontal part of the bias error, seen through the same low-pass as gravity itself.
The gains follow from the accuracy to be reached and from a drift of 0.1 deg/s in 100 s.
"""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.complementary.complementary_state import (
    SCALE,
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift import BIAS_WALK_RAD2PS3, carry_drift
from gateway.estimation.complementary.errors.drift_update import (
    UNCLIPPED,
    cleared_row,
    correct_drift,
)
from gateway.estimation.complementary.tilt import cutoff_radps, low_pass
from gateway.estimation.kernel_record import as_quat, write_vec
from gateway.geometry.quaternion import body_axes
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG

SETTLED_S: Final = 5.0
"""What levels a new attitude in this time is its own error rather than the bias."""
CLIP_RADPS: Final = 2.0 * RAD_PER_DEG
"""No single observation moves the bias by more than its gain times this."""


@compiled
def update_bias(s: ComplementaryState, p: ComplementaryGains, tau_s: float, dt: float) -> None:
    """Update the bias at the end of an epoch in which gravity levelled the attitude.

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
    carry_drift(s, p)
    watch_turn(s, tau_s, dt)
    settled = s.force_lp_s > max(tau_s, SETTLED_S)
    if s.at_rest == 1:
        update_bias_at_rest(s, p, dt)
    elif settled:
        variance = noise_for(p.bias_motion_radps, BIAS_WALK_RAD2PS3 * dt)
        # A level that was off comes back at a rate of its own, which is none of the bias.
        variance += 2.0 * s.unaided_level_sq / (tau_s * dt)
        for k in range(2):
            row = (s.turn_lp[3 * k], s.turn_lp[3 * k + 1], s.turn_lp[3 * k + 2])
            # The low-passed frame falls behind by the bias error, and gravity pulls it back.
            correct_bias(s, p, row, s.turn_lp[6 + k] - s.tilt_sum[k] / dt, variance)
    s.tilt_sum[0] = s.tilt_sum[1] = 0.0


@compiled
def update_bias_at_rest(s: ComplementaryState, p: ComplementaryGains, dt: float) -> None:
    """Update the bias by what the gyroscope shows at rest, after `dt` seconds of it."""
    variance = noise_for(p.bias_rest_radps, BIAS_WALK_RAD2PS3 * dt)
    for k in range(3):
        row = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
        correct_bias(s, p, row, s.gyro_rest[k], variance)


@compiled
def noise_for(accuracy: float, growth: float) -> float:
    """Find the measurement variance at which the filter settles at an accuracy."""
    steady = accuracy * accuracy
    return steady * steady / growth + steady


@compiled
def watch_turn(s: ComplementaryState, tau_s: float, dt: float) -> None:
    """Low-pass the level rows of `R_eb`, and the level rates that the bias makes up."""
    x, y, z = body_axes(as_quat(s.q_eb))
    cutoff = cutoff_radps(tau_s)
    for k in range(2):
        row = (x[k], y[k], z[k])
        product = row[0] * s.bias_b[0] + row[1] * s.bias_b[1] + row[2] * s.bias_b[2]
        for j in range(3):
            settle(s, 3 * k + j, row[j], cutoff, dt, tau_s)
        settle(s, 6 + k, product, cutoff, dt, tau_s)
    s.turn_begins = 0


@compiled
def settle(s: ComplementaryState, k: int, u: float, cutoff: float, dt: float, tau_s: float) -> None:
    """Low-pass one channel; while gravity's filter is still a mean, follow at once."""
    if s.force_lp_s < tau_s or s.turn_begins == 1:
        s.turn_lp[k], s.turn_in[k], s.turn_lp_rate[k] = u, u, 0.0
    else:
        low_pass(s.turn_lp, s.turn_lp_rate, s.turn_in, k, u, cutoff, dt)


@compiled
def correct_bias(
    s: ComplementaryState, p: ComplementaryGains, row: Vec3, measured: float, variance: float
) -> None:
    """Correct the bias by `row @ bias = measured`."""
    expected = row[0] * s.bias_b[0] + row[1] * s.bias_b[1] + row[2] * s.bias_b[2]
    innovation = max(-CLIP_RADPS, min(CLIP_RADPS, measured - expected))
    write_vec(cleared_row(s), row)
    correct_drift(s, p, innovation, variance, UNCLIPPED, SCALE)
