"""The level before GPS: it rests on the accelerometer, whose bias tilts it.

A level found by gravity has the error `bias / g`. Before there are velocities to compare with,
nothing tells that bias from tilt: it cannot be estimated, but the tilt is told with it.
"""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.covariance import propagate, renew
from gateway.estimation.eskf.eskf_settings import EskfGains
from gateway.estimation.eskf.eskf_state import ACCEL_BIAS, TILT, EskfState
from gateway.estimation.filtering.uncalibrated import accel_bias_std
from gateway.estimation.kernel_record import as_quat, fill
from gateway.geometry.quaternion import body_axes
from gateway.units import STANDARD_GRAVITY_MPS2

LEFT_BIAS_MPS2: Final = 0.04
"""What a calibration leaves along each axis, and the axes of the chip on its board add."""


@compiled
def left_bias_mps2(s: EskfState) -> float:
    """Return the standard deviation of the bias along an axis, before anything has told it."""
    return accel_bias_std(s, LEFT_BIAS_MPS2)


@compiled
def left_bias_var(s: EskfState, p: EskfGains) -> float:
    """Return the variance of the bias along an axis once GPS may tell it, (m/s2)2."""
    return max(left_bias_mps2(s) ** 2, p.accel_bias_var)


@compiled
def forget_accel_bias(s: EskfState, p: EskfGains) -> None:
    """Know nothing of the bias."""
    propagate(s, p)
    fill(s.accel_bias_b, 0.0)
    for k in range(ACCEL_BIAS, ACCEL_BIAS + 3):
        renew(s, k, left_bias_var(s, p))


@compiled
def standing_level_var(s: EskfState) -> float:
    """Return the variance of the tilt about a level axis by a bias that nothing tells yet, rad2."""
    if s.aided_before == 1:
        return 0.0
    return (left_bias_mps2(s) / STANDARD_GRAVITY_MPS2) ** 2


@compiled
def doubt_level(s: EskfState, p: EskfGains) -> None:
    """Look for the bias from here on, and for what it has tilted."""
    variance = left_bias_var(s, p)
    axes = body_axes(as_quat(s.q_nb))
    for k in range(3):
        renew(s, ACCEL_BIAS + k, variance)
        share = variance / STANDARD_GRAVITY_MPS2
        north, east = share * axes[k][0], share * axes[k][1]
        s.P[TILT, ACCEL_BIAS + k] = s.P[ACCEL_BIAS + k, TILT] = east
        s.P[TILT + 1, ACCEL_BIAS + k] = s.P[ACCEL_BIAS + k, TILT + 1] = -north
    for k in range(2):
        s.P[TILT + k, TILT + k] += variance / STANDARD_GRAVITY_MPS2**2
