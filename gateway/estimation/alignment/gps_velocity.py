"""The velocity of a fix, also of one that tells none, or no climb: by the way from fix to fix."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, write_vec
from gateway.estimation.local_position import NEVER_S
from gateway.estimation.sensor_faults import is_sound
from gateway.records import NAN, Vec3

BASELINE_S: Final = 0.9
"""Places closer together differ by their noise rather than by the way between."""
MAX_BASELINE_S: Final = 2.5
FASTEST_MPS: Final = 1000.0
TOLD_NOISE_MPS: Final = 0.2
WAY_NOISE_MPS: Final = 0.6
"""Noise of a velocity that is told, and of one made of two places."""


class WayState:
    """Where the way from fix to fix is measured from."""

    way_s: float
    """When the aircraft was there; `NEVER_S` before the first fix."""
    way_from: Annotated[FloatArray, (3,)]


@compiled
def forget_way(s: WayState) -> None:
    """Measure no way from a fix that was never there, or on another clock."""
    s.way_s = NEVER_S


@compiled
def is_velocity_told(vel: Vec3) -> bool:
    """Return whether a fix has a level velocity of its own."""
    return is_sound((vel[0], vel[1], 0.0), FASTEST_MPS)


@compiled
def velocity_noise(vel: Vec3) -> float:
    """Return the noise of the velocity that `velocity_of_fix` makes of what a fix tells, m/s."""
    return TOLD_NOISE_MPS if is_velocity_told(vel) else WAY_NOISE_MPS


@compiled
def velocity_of_fix(s: WayState, valid_s: float, pos: Vec3, vel: Vec3) -> tuple[Vec3, float]:
    """Complete the velocity of a fix.

    Parameters
    ----------
    s : WayState
        Changed in place.
    valid_s : float
        When the fix was valid.
    pos : tuple of 3 floats
        Its place in m, NaN down where it tells no height.
    vel : tuple of 3 floats
        What it tells, NaN where it tells nothing.

    Returns
    -------
    vel : tuple of 3 floats
        NED in m/s; NaN where nothing can be told yet. Without heights, it does not climb.
    at_s : float
        When that was the velocity: half way where it is made of two places.
    """
    if is_sound(vel, FASTEST_MPS):
        s.way_s = valid_s
        write_vec(s.way_from, pos)
        return (vel, valid_s)
    dt = valid_s - s.way_s
    if 0.0 <= dt < BASELINE_S:
        told = (vel[0], vel[1], 0.0) if is_velocity_told(vel) else (NAN, NAN, NAN)
        return (told, valid_s)
    w = s.way_from
    way = ((pos[0] - w[0]) / dt, (pos[1] - w[1]) / dt, (pos[2] - w[2]) / dt)
    s.way_s = valid_s
    write_vec(s.way_from, pos)
    known = 0.0 <= dt <= MAX_BASELINE_S
    climb = way[2] if known and math.isfinite(way[2]) else 0.0
    if is_velocity_told(vel):
        return ((vel[0], vel[1], climb), valid_s)
    if known and is_velocity_told(way):
        return ((way[0], way[1], climb), valid_s - 0.5 * dt)
    return ((NAN, NAN, NAN), valid_s)
