"""Attitude from motion: the accelerometer against GPS velocities.

The integrated gyroscope defines a frame, in which the specific force is integrated from fix to fix;
the GPS velocity gives the same change in NED after gravity is subtracted. The rotation between the
two frames that fits all pairs of the last seconds is Wahba's problem, solved by Davenport's
q-method [1]_. It needs no initial attitude, so it determines the first one in flight, a heading
without a compass, and an attitude that was lost.

All sums are one weighted matrix of second moments of `(r, f, 1, t)`: the reference acceleration in
NED, the measured one in the gyroscope frame, and the time before the newest pair.

References
----------
.. [1] F. L. Markley and J. L. Crassidis, "Fundamentals of Spacecraft Attitude Determination and
   Control", 2014, section 5.3.
.. [2] K. V. Mardia and P. E. Jupp, "Directional Statistics", 2000, section 3.5.4.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import MOMENTS, NEVER_S, State
from gateway.estimation.record import as_quat, as_vec, write_quat, write_vec
from gateway.geometry import quaternion as quat
from gateway.geometry.angle import wrap_pi
from gateway.records import Quat, Vec3
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

PAIR_S: Final = 0.45
"""Least interval of a pair: the difference of closer velocities is mostly noise."""
MAX_PAIR_S: Final = 2.5
"""Maximum interval of a pair."""
MEMORY_S: Final = 20.0
"""Time constant by which pairs fade, because the gyroscope frame drifts."""
NOISE_MPS: Final = 0.2
"""Noise of a GPS velocity in a pair."""
TRACK_NOISE_MPS: Final = 0.6
"""The same for a velocity derived from two positions."""
MISMATCH_SIGMA: Final = 4.0
"""Standard deviations beyond which a difference is significant."""
MISMATCH_MPS2: Final = 4.0
"""Least difference of a pair that contradicts the other pairs: that of a turn by 25 deg."""
DRIFT_RADPS: Final = 0.3 * RAD_PER_DEG
"""Drift of the gyroscope frame due to an unknown bias."""
SQUARINGS: Final = 14
"""Number of squarings: the matrix to the power 2**14 gives its leading eigenvector in double
precision."""
UNKNOWN_RAD: Final = 3.0
"""Standard deviation of an unknown angle."""
ANY_HEADING_VAR: Final = 2.0
"""Mean squared chord of a uniformly distributed heading, rad2."""
ENOUGH_PAIRS: Final = MEMORY_S / PAIR_S
"""Number of pairs in the whole memory."""
FITTED_PARAMETERS: Final = 3.0
"""Degrees of freedom of the constant, the ramp and the noise of the heading fit."""

R: Final = 0
F: Final = 3
ONE: Final = 6
TIME: Final = 7
"""Rows of the moments."""


@compiled
def clear_pairs(s: State) -> None:
    """Discard the pairs."""
    s.moments[:] = 0.0
    s.pairs = s.pairs_s = 0.0
    s.pair_s = NEVER_S


@compiled
def add_velocity(
    s: State, p: Gains, valid_s: float, vel: Vec3, force_i: Vec3, noise_mps: float
) -> float:
    """Add a GPS velocity and the integrated force at its time of validity.

    Returns the length in s of the pair that it completes, or 0.
    """
    v, f, dt = as_vec(s.pair_vel), as_vec(s.pair_force), valid_s - s.pair_s
    if 0.0 <= dt < PAIR_S:
        return 0.0
    completes = 0.0 <= dt <= MAX_PAIR_S
    if not completes:
        clear_pairs(s)
    s.pair_s = valid_s
    write_vec(s.pair_vel, vel)
    write_vec(s.pair_force, force_i)
    if not completes:
        return 0.0
    north, east = (vel[0] - v[0]) / dt, (vel[1] - v[1]) / dt
    force = ((force_i[0] - f[0]) / dt, (force_i[1] - f[1]) / dt, (force_i[2] - f[2]) / dt)
    late_sq = p.gps_jitter_sq * (north * north + east * east)
    # Over one second, the noise that successive differences share averages out.
    weight = dt / (2.0 * (noise_mps * noise_mps + late_sq))
    reference = (north, east, (vel[2] - v[2]) / dt - STANDARD_GRAVITY_MPS2)
    excess = contradiction(s, reference, force, weight)
    if excess > 0.0:
        s.fix_excess = max(s.fix_excess, excess)
        clear_pairs(s)
        s.pair_s = valid_s
        return 0.0
    add_pair(s, reference, force, weight, dt)
    return dt


@compiled
def contradiction(s: State, reference: Vec3, force: Vec3, weight: float) -> float:
    """Return the noise that a pair would add if it contradicts the level of the earlier ones, or 0.

    Then either GPS is wrong or the gyroscope has missed a turn, as in a shock.
    """
    if s.pairs < FITTED_PARAMETERS + 1.0:
        return 0.0
    q_ni, misfit = solve_rotation(s)
    north, east, down = quat.rotate(q_ni, force)
    level_off = math.hypot(north, east) - math.hypot(reference[0], reference[1])
    off_sq = level_off * level_off + (down - reference[2]) ** 2
    if off_sq < MISMATCH_MPS2**2 + MISMATCH_SIGMA**2 * misfit / weight:
        return 0.0
    return off_sq * weight / (2.0 * ENOUGH_PAIRS)


@compiled
def add_pair(s: State, reference: Vec3, force: Vec3, weight: float, dt: float) -> None:
    """Add a pair of mean accelerations, in m/s2."""
    M = s.moments
    for j in range(MOMENTS):
        M[TIME, j] -= dt * M[ONE, j]
    for j in range(MOMENTS):
        M[j, TIME] -= dt * M[j, ONE]
    kept = math.exp(-dt / MEMORY_S)
    z = (*reference, *force, 1.0, 0.0)
    for i in range(MOMENTS):
        for j in range(MOMENTS):
            M[i, j] = kept * M[i, j] + weight * z[i] * z[j]
    s.pairs = kept * s.pairs + 1.0
    s.pairs_s = kept * s.pairs_s + dt


@compiled
def set_davenport(s: State) -> float:
    """Write Davenport's matrix, shifted by the returned number to be positive semidefinite."""
    M, K = s.moments, s.work[0]
    shift = 0.0
    for i in range(6):
        shift += 0.5 * M[i, i]
    trace = M[0, 3] + M[1, 4] + M[2, 5]
    K[0, 0] = trace + shift
    K[0, 1] = K[1, 0] = M[2, 4] - M[1, 5]
    K[0, 2] = K[2, 0] = M[0, 5] - M[2, 3]
    K[0, 3] = K[3, 0] = M[1, 3] - M[0, 4]
    for i in range(3):
        for j in range(3):
            K[1 + i, 1 + j] = M[i, F + j] + M[j, F + i] - (trace - shift if i == j else 0.0)
    return shift


@compiled
def solve_rotation(s: State) -> tuple[Quat, float]:
    """Return the rotation from the gyroscope frame to NED, and its misfit.

    The misfit is the mean squared residual in units of the assumed noise, 1 or more. Without
    acceleration the heading is arbitrary.
    """
    set_davenport(s)
    for n in range(SQUARINGS):
        A, out = s.work[n % 2], s.work[1 - n % 2]
        trace = max(A[0, 0] + A[1, 1] + A[2, 2] + A[3, 3], 1e-300)
        for i in range(4):
            for j in range(4):
                total = 0.0
                for k in range(4):
                    total += (A[i, k] / trace) * (A[k, j] / trace)
                out[i, j] = total
    A = s.work[SQUARINGS % 2]
    best = 0
    for i in range(1, 4):
        if A[i, i] > A[best, best]:
            best = i
    q = quat.normalise((A[best, 0], A[best, 1], A[best, 2], A[best, 3]))
    shift = set_davenport(s)
    K, fit = s.work[0], 0.0
    for i in range(4):
        for j in range(4):
            fit += q[i] * K[i, j] * q[j]
    # A pair has three numbers, each with half a square; `fit` contains the shift once.
    return q, max(1.0, (2.0 * shift - fit) / (1.5 * max(s.pairs, 1.0)))


@compiled
def level_std(s: State, misfit: float) -> float:
    """Return the standard deviation of the level from the pairs, rad."""
    M = s.moments
    total = M[0, 0] + M[1, 1] + M[2, 2]
    a, b, c = total - M[0, 0], total - M[1, 1], total - M[2, 2]
    d, e, f = -M[0, 1], -M[0, 2], -M[1, 2]
    level = a * b - d * d
    if level < 1.0:
        return UNKNOWN_RAD
    # A constant acceleration of unknown heading may be tilt, so the heading has a prior.
    known = c + 1.0 / ANY_HEADING_VAR
    determinant = known * level - a * f * f - b * e * e + 2.0 * d * e * f
    variance = ((a + b) * known - e * e - f * f) / determinant * misfit
    return math.sqrt(min(variance + drift_variance(s), UNKNOWN_RAD * UNKNOWN_RAD))


@compiled
def drift_variance(s: State) -> float:
    """Return the variance of the gyroscope frame's drift over half the memory, rad2."""
    return (DRIFT_RADPS * 0.5 * s.pairs_s) ** 2


@compiled
def heading_of_pairs(s: State, q_ni: Quat, bias_radps: float) -> tuple[float, float, float]:
    """Return the heading of the pairs relative to a solution's, its standard deviation, and noise.

    If the level is known, GPS and accelerometer give the same horizontal accelerations, rotated by
    the heading: `r = turn(f - c - d t) + noise`. The constant `c` is due to the error of the level,
    the ramp `d t` due to the gyroscope bias, whose standard deviation is `bias_radps`. After both
    are removed, the sum of the products of `r` and `f` is a complex number: its angle is the
    heading, its magnitude over the noise the concentration of a von Mises distribution [2]_. The
    noise is the variance of the residual, in units of the assumed one, 1 or more; 0 with too few
    pairs.
    """
    if s.pairs < FITTED_PARAMETERS + 1.0:
        return 0.0, UNKNOWN_RAD, 0.0
    x, y = quat.rotate_inverse(q_ni, (1.0, 0.0, 0.0)), quat.rotate_inverse(q_ni, (0.0, 1.0, 0.0))
    ramp = STANDARD_GRAVITY_MPS2 * max(bias_radps, 1e-4)
    prior = 1.0 / (ramp * ramp)
    M = s.moments
    north = (M[0, ONE], M[0, TIME])
    east = (M[1, ONE], M[1, TIME])
    ahead = (moment_along(s, x, ONE), moment_along(s, x, TIME))
    right = (moment_along(s, y, ONE), moment_along(s, y, TIME))
    cosine = -explained_product(s, north, ahead, prior) - explained_product(s, east, right, prior)
    sine = -explained_product(s, east, ahead, prior) + explained_product(s, north, right, prior)
    squares = M[0, 0] + M[1, 1] - explained_product(s, north, north, prior)
    squares -= explained_product(s, east, east, prior) + explained_product(s, ahead, ahead, prior)
    squares -= explained_product(s, right, right, prior)
    for j in range(3):
        cosine += M[0, F + j] * x[j] + M[1, F + j] * y[j]
        sine += M[1, F + j] * x[j] - M[0, F + j] * y[j]
        for i in range(3):
            squares += M[F + i, F + j] * (x[i] * x[j] + y[i] * y[j])
    size = math.hypot(cosine, sine)
    noise = max(1.0, (squares - 2.0 * size) / (2.0 * (s.pairs - FITTED_PARAMETERS)))
    variance = noise / max(size, 1e-9) + drift_variance(s)
    std = math.sqrt(min(variance, UNKNOWN_RAD * UNKNOWN_RAD))
    return math.atan2(sine, cosine), std, noise


@compiled
def moment_along(s: State, axis: Vec3, row: int) -> float:
    """Return the moment of the force along an axis with 1 or the time."""
    M = s.moments
    return float(M[row, F] * axis[0] + M[row, F + 1] * axis[1] + M[row, F + 2] * axis[2])


@compiled
def explained_product(
    s: State, a: tuple[float, float], b: tuple[float, float], prior: float
) -> float:
    """Return the part of a sum of products that a constant and a ramp explain."""
    M = s.moments
    one, time, square = M[ONE, ONE], M[ONE, TIME], M[TIME, TIME] + prior
    constant = a[0] * (square * b[0] - time * b[1])
    ramp = a[1] * (one * b[1] - time * b[0])
    return float((constant + ramp) / (one * square - time * time))


@compiled
def align(s: State, bias_radps: float) -> float:
    """Solve the pairs into `aligned_q_nb` and `aligned_std`; return the noise of the velocities."""
    q_ni, misfit = solve_rotation(s)
    s.aligned_std[0] = level_std(s, misfit)
    turn_rad, s.aligned_std[1], noise = heading_of_pairs(s, q_ni, bias_radps)
    q_ni = quat.multiply(quat.from_rotation_vector((0.0, 0.0, turn_rad)), q_ni)
    write_quat(s.aligned_q_nb, quat.normalise(quat.multiply(q_ni, as_quat(s.q_ib))))
    return noise


@compiled
def level_difference(q_a: Quat, q_b: Quat) -> float:
    """Return the angle between the verticals of two attitudes, rad."""
    x, y = quat.rotate_inverse(q_a, (0.0, 0.0, 1.0)), quat.rotate_inverse(q_b, (0.0, 0.0, 1.0))
    return math.acos(max(-1.0, min(1.0, x[0] * y[0] + x[1] * y[1] + x[2] * y[2])))


@compiled
def heading_difference(q_a: Quat, q_b: Quat) -> float:
    """Return the rotation about down from the second attitude to the first, rad."""
    turn = quat.multiply(q_a, (q_b[0], -q_b[1], -q_b[2], -q_b[3]))
    return wrap_pi(2.0 * math.atan2(turn[3], turn[0]))
