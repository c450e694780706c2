"""The first heading without a compass: GPS accelerations matched with inertial ones."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray
from gateway.records import Vec3

MATCH_MEMORY_S: Final = 30.0
MATCH_INFORMATION: Final = 25.0
"""Information in 1/rad2 at which the match is believed."""
MATCH_WINDOW_S: Final = 1.0
"""Differences of successive velocities share their noise; over this time it averages out."""


class MatchState:
    """The sums of the match."""

    match: Annotated[FloatArray, (3,)]
    """Real and imaginary part of GPS against inertial acceleration, and the information."""


@compiled
def information_of(accel_n: Vec3, dt: float, noise_mps: float) -> float:
    """Tell how much one interval says of the heading.

    Parameters
    ----------
    accel_n : tuple of 3 floats
        Mean acceleration in NED, m/s2.
    dt : float
        Length of the interval, s.
    noise_mps : float
        Noise of the GPS velocity.

    Returns
    -------
    float
        Inverse variance in 1/rad2.
    """
    power = accel_n[0] * accel_n[0] + accel_n[1] * accel_n[1]
    return power * dt * MATCH_WINDOW_S / (2.0 * noise_mps * noise_mps)


@compiled
def collect_match(s: MatchState, force: Vec3, accel_n: Vec3, dt: float, noise_mps: float) -> bool:
    """Add one interval to the match.

    Parameters
    ----------
    s : MatchState
        Changed in place.
    force : tuple of 3 floats
        Mean specific force in a level frame of unknown heading, m/s2.
    accel_n : tuple of 3 floats
        Mean acceleration in NED, m/s2.
    dt : float
        Length of the interval, s.
    noise_mps : float
        Noise of the GPS velocity.

    Returns
    -------
    bool
        Whether `match` tells the heading: the turn is the angle of its first two numbers, the
        variance the inverse of the third.
    """
    kept = math.exp(-dt / MATCH_MEMORY_S)
    real = force[0] * accel_n[0] + force[1] * accel_n[1]
    imag = force[0] * accel_n[1] - force[1] * accel_n[0]
    s.match[0] = kept * s.match[0] + dt * real
    s.match[1] = kept * s.match[1] + dt * imag
    s.match[2] = kept * s.match[2] + information_of(accel_n, dt, noise_mps)
    return bool(s.match[2] > MATCH_INFORMATION)
