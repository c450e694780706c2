"""What is remembered of the pairs of the alignment: weighted sums of products, which fade.

A pair is the mean acceleration of an interval, gravity in, as a reference tells it in NED and as
the accelerometer felt it in the gyroscope's own frame.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, fill
from gateway.records import Vec3

MEMORY_S: Final = 20.0
"""Older pairs fade: the gyroscope's frame drifts."""


class PairSums:
    """Sums over the pairs, weighted by the inverse of their noise; times are counted from now."""

    outer: Annotated[FloatArray, (3, 3)]
    """Of the products of reference in NED and force in the gyroscope's frame."""
    information: Annotated[FloatArray, (3, 3)]
    """Of the turn about north, east and down, 1/rad2."""
    squares: float
    """Half the sum of the weighted squares of both."""
    pairs: float
    """How many pairs the sums are made of."""
    gathered_s: float
    """Over which time, what has faded left out."""
    lasted_s: float
    """The same, what has faded counted in."""
    weight_sums: Annotated[FloatArray, (3,)]
    """Of the weight alone, by the time, and by its square."""
    reference_sums: Annotated[FloatArray, (4,)]
    """Of the level reference in NED, alone and by the time."""
    force_sums: Annotated[FloatArray, (6,)]
    """Of the force in the gyroscope's frame, alone and by the time."""
    force_squares: Annotated[FloatArray, (3, 3)]
    """Of the products of the force with itself."""
    pair_turned_var: float
    """Of the turn in the present pair that was not seen, rad2."""
    noise_excess: float
    """Variance of the level noise of GPS velocities over that of the weights, 1 or more; 0 while
    nothing is known of it. Not forgotten with the pairs: it is the receiver's."""


@compiled
def clear_pairs(s: PairSums) -> None:
    """Forget the pairs."""
    for i in range(3):
        for j in range(3):
            s.outer[i, j] = s.information[i, j] = s.force_squares[i, j] = 0.0
    s.squares = s.pairs = s.gathered_s = s.lasted_s = s.pair_turned_var = 0.0
    fill(s.weight_sums, 0.0)
    fill(s.reference_sums, 0.0)
    fill(s.force_sums, 0.0)


@compiled
def fade_pairs(s: PairSums, kept: float) -> None:
    """Keep a share of the weight of all pairs."""
    for i in range(3):
        for j in range(3):
            s.outer[i, j] *= kept
            s.information[i, j] *= kept
            s.force_squares[i, j] *= kept
    s.squares *= kept
    s.pairs *= kept
    s.gathered_s *= kept
    for i in range(3):
        s.weight_sums[i] *= kept
    for i in range(4):
        s.reference_sums[i] *= kept
    for i in range(6):
        s.force_sums[i] *= kept


@compiled
def doubt_pairs(s: PairSums, turned_var: float) -> None:
    """Be less sure of all pairs after a turn that was not seen, of a variance in rad2 an axis."""
    told = 0.5 * (s.information[0, 0] + s.information[1, 1])
    fade_pairs(s, 1.0 / (1.0 + told * turned_var))
    s.pair_turned_var += turned_var


@compiled
def take_pair(s: PairSums, force: Vec3, reference: Vec3, weight: float, dt: float) -> None:
    """Add the mean force of an interval in the gyroscope's frame and in NED, m/s2."""
    r_sq = reference[0] ** 2 + reference[1] ** 2 + reference[2] ** 2
    f_sq = force[0] ** 2 + force[1] ** 2 + force[2] ** 2
    weight /= 1.0 + weight * f_sq * s.pair_turned_var
    s.pair_turned_var = 0.0
    W, R, F = s.weight_sums, s.reference_sums, s.force_sums
    W[2] += dt * dt * W[0] - 2.0 * dt * W[1]
    W[1] -= dt * W[0]
    for i in range(2):
        R[2 + i] -= dt * R[i]
    for i in range(3):
        F[3 + i] -= dt * F[i]
    fade_pairs(s, math.exp(-dt / MEMORY_S))
    for i in range(3):
        for j in range(3):
            s.outer[i, j] += weight * reference[i] * force[j]
            told = (r_sq if i == j else 0.0) - reference[i] * reference[j]
            s.information[i, j] += weight * told
            s.force_squares[i, j] += weight * force[i] * force[j]
    s.squares += 0.5 * weight * (r_sq + f_sq)
    s.pairs += 1.0
    s.gathered_s += dt
    s.lasted_s += dt
    W[0] += weight
    for i in range(2):
        R[i] += weight * reference[i]
    for i in range(3):
        F[i] += weight * force[i]
