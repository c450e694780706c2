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
ZERO_S: Final = 3.0
ZERO_MPS: Final = 2.0
"""Fixes that go on for so long, so fast, belong to no aircraft that stands."""
TOLD_NOISE_MPS: Final = 0.2
WAY_NOISE_MPS: Final = 0.6
"""Noise of a velocity that is told, and of one made of two places."""


class WayState:
    """Where the way from fix to fix is measured from."""

    way_s: float
    """When the aircraft was there; `NEVER_S` before the first fix."""
    way_from: Annotated[FloatArray, (3,)]
    zero_s: float
    """When a velocity of exactly zero was first told, or last compared; `NEVER_S` else."""
    zero_from: Annotated[FloatArray, (3,)]
    zero_moves: int
    """1 while the fixes that tell it move on."""


@compiled
def forget_way(s: WayState) -> None:
    """Measure no way from a fix that was never there, or on another clock."""
    s.way_s = s.zero_s = NEVER_S
    s.zero_moves = 0


@compiled
def is_velocity_told(vel: Vec3) -> bool:
    """Return whether a fix has a level velocity of its own."""
    return is_sound((vel[0], vel[1], 0.0), FASTEST_MPS)


@compiled
def is_zero_refuted(s: WayState, time_s: float, pos: Vec3, vel: Vec3) -> bool:
    """Return whether a velocity of exactly zero is none; to be asked of each fix.

    A receiver that measures no velocity, or a log without any, may tell zeros. What stands tells
    them as well, but its fixes do not move on.

    Parameters
    ----------
    s : WayState
        Changed in place.
    time_s : float
        Of the fix.
    pos : tuple of 3 floats
        Its place, m.
    vel : tuple of 3 floats
        What it tells, m/s.
    """
    if vel[0] != 0.0 or vel[1] != 0.0 or vel[2] != 0.0:
        s.zero_s, s.zero_moves = NEVER_S, 0
        return False
    dt, begin = time_s - s.zero_s, s.zero_from
    if 0.0 <= dt < ZERO_S:
        return s.zero_moves == 1
    if s.zero_s != NEVER_S:
        way_m = math.hypot(pos[0] - begin[0], pos[1] - begin[1])
        s.zero_moves = 1 if way_m > ZERO_MPS * dt else 0
    s.zero_s = time_s
    write_vec(s.zero_from, pos)
    return s.zero_moves == 1


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
