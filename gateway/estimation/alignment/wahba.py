"""The attitude out of nothing but motion: what the accelerometer saw against what GPS tells.

The gyroscope carries a frame of its own in which the specific force is summed between two fixes;
the GPS velocity tells the same change in NED, gravity added. The turn between the two frames that
fits all pairs of the last seconds best is Wahba's problem, solved by Davenport's q-method [1]_. It
needs no first guess, so it finds a start that was wrong, an attitude that was lost in a silence,
and the first heading without a compass. Without GPS each pair holds gravity alone and tells the
level, as far as nothing accelerates for long.

References
----------
.. [1] F. L. Markley and J. L. Crassidis, "Fundamentals of Spacecraft Attitude Determination and
   Control", 2014, section 5.3.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.alignment.pair_sums import PairSums, clear_pairs, take_pair
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec, write_quat, write_vec
from gateway.geometry.quaternion import from_rotation_vector, multiply, normalise, rotate_inverse
from gateway.records import Quat, Vec3
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

PAIR_S: Final = 0.45
"""Fixes closer together are joined: the difference of their velocities is mostly noise."""
PAIR_WINDOW_S: Final = 1.0
"""Differences of successive velocities share their noise; over this time it averages out."""
MAX_PAIR_S: Final = 2.5
HARDEST_MPS2: Final = 100.0
"""What GPS tells beyond this is no manoeuvre: one such pair would outweigh all others."""
JITTER_S: Final = 0.065
"""How much the latency of a fix varies: in manoeuvres the larger part of the error."""
GRAVITY_NOISE_MPS2: Final = 1.0
"""Acceleration that goes unseen where gravity alone is the reference."""
DRIFT_RADPS: Final = 0.3 * RAD_PER_DEG
"""What the gyroscope's bias may be off."""
PULL_TAU_S: Final = 3.0
SWING_TAU_S: Final = 1.8
"""Of either of two low-passes, where a hand's swings are to average out."""
TURNING_TAU_S: Final = 20.0
SPEED_MEMORY_S: Final = 30.0
"""The speed that a flight has shown is to be expected for about this time."""
TURN_S: Final = 4.0
"""What flies pulls one way for about this time."""
HAND_MPS: Final = 1.8
"""By how much the speed of what moves in a hand differs from one moment to another."""
PULL_KEPT: Final = 0.7
"""Of an acceleration that is over, from one pair to the next."""
USUAL_PULL: Final = 1.03
"""A mean specific force beyond gravity by more than an accelerometer's error of scale."""
SQUARINGS: Final = 14
"""The matrix to the power of 2**14 is its leading eigenvector but for what cannot be told apart."""
UNKNOWN_RAD: Final = 3.0
"""Standard deviation of an angle of which nothing is known."""
ANY_HEADING_VAR: Final = 2.0
"""Mean square of the chord by which a heading that may be any turns what lies level, rad2."""


class AlignmentState(PairSums):
    """The gyroscope's own frame, and the pairs taken in it."""

    q_ib: Annotated[FloatArray, (4,)]
    """Body to the frame of the gyroscope alone."""
    pair_s: float
    """Time of the last velocity, or of the last look at gravity."""
    pair_vel: Annotated[FloatArray, (3,)]
    pair_force: Annotated[FloatArray, (3,)]
    by_gps: int
    """1 while the pairs are of GPS velocities, 0 of gravity alone."""
    force_first_i: Annotated[FloatArray, (3,)]
    force_mean_i: Annotated[FloatArray, (3,)]
    """Low-pass of the specific force in the gyroscope's frame, and a second one of that."""
    turning_mps2: float
    """Mean of what gives itself away: of a hand little, of a flight in turns much."""
    at_rest: int
    """1 while it stands: a force beyond gravity is an accelerometer's error then, and no pull."""
    flown_mps: float
    """Fastest speed that GPS has shown; it fades while GPS shows less."""
    pull_mps2: float
    """Level acceleration recently: as GPS tells it, or what gives itself away without."""
    square: Annotated[FloatArray, (2, 4, 4)]
    """Scratch."""


@compiled
def carry_frame(s: AlignmentState, rate: Vec3, dt: float) -> None:
    """Turn the gyroscope's frame by one sample, rad/s without bias."""
    turn = from_rotation_vector((rate[0] * dt, rate[1] * dt, rate[2] * dt))
    write_quat(s.q_ib, normalise(multiply(as_quat(s.q_ib), turn)))


@compiled
def begin_pair(s: AlignmentState, time_s: float, vel: Vec3, force_i: Vec3) -> None:
    """Note where the next pair begins."""
    s.pair_s = time_s
    write_vec(s.pair_vel, vel)
    write_vec(s.pair_force, force_i)


@compiled
def mean_force(s: AlignmentState, force_i: Vec3, dt: float) -> Vec3:
    """Return the mean force since the last pair."""
    f = s.pair_force
    return ((force_i[0] - f[0]) / dt, (force_i[1] - f[1]) / dt, (force_i[2] - f[2]) / dt)


@compiled
def align_by_velocity(
    s: AlignmentState, valid_s: float, vel: Vec3, force_i: Vec3, noise_mps: float
) -> float:
    """Take one GPS velocity in.

    Parameters
    ----------
    s : AlignmentState
        Changed in place.
    valid_s : float
        When the velocity was valid.
    vel : tuple of 3 floats
        NED, m/s.
    force_i : tuple of 3 floats
        Integral of the specific force in the gyroscope's frame up to then, m/s.
    noise_mps : float
        Of the velocity.

    Returns
    -------
    float
        Length in s of the pair that was added; 0 if none was.
    """
    dt = valid_s - s.pair_s
    if s.by_gps == 0 or dt > MAX_PAIR_S or dt < 0.0:
        clear_pairs(s)
        s.by_gps = 1
        begin_pair(s, valid_s, vel, force_i)
        return 0.0
    if dt < PAIR_S:
        return 0.0
    v = s.pair_vel
    reference = (
        (vel[0] - v[0]) / dt,
        (vel[1] - v[1]) / dt,
        (vel[2] - v[2]) / dt - STANDARD_GRAVITY_MPS2,
    )
    climb = reference[2] + STANDARD_GRAVITY_MPS2
    if math.hypot(climb, math.hypot(reference[0], reference[1])) > HARDEST_MPS2:
        begin_pair(s, valid_s, vel, force_i)
        return 0.0
    late_sq = JITTER_S * JITTER_S * (reference[0] ** 2 + reference[1] ** 2)
    weight = dt * PAIR_WINDOW_S / (2.0 * (noise_mps * noise_mps + late_sq))
    s.pull_mps2 = max(math.hypot(reference[0], reference[1]), PULL_KEPT * s.pull_mps2)
    speed = math.hypot(vel[2], math.hypot(vel[0], vel[1]))
    s.flown_mps = max(speed, math.exp(-dt / SPEED_MEMORY_S) * s.flown_mps)
    take_pair(s, mean_force(s, force_i, dt), reference, weight, dt)
    begin_pair(s, valid_s, vel, force_i)
    return dt


@compiled
def align_by_gravity(
    s: AlignmentState, now_s: float, force_i: Vec3, period_s: float, swings: bool = False
) -> float:
    """Take gravity for the reference where GPS tells no velocity.

    Parameters
    ----------
    s : AlignmentState
        Changed in place.
    now_s : float
        Time of the integral.
    force_i : tuple of 3 floats
        Integral of the specific force in the gyroscope's frame, m/s.
    period_s : float
        Length of a pair.
    swings : bool
        Whether what swings to and fro, as in a hand, is no pull: it is smoothed twice then.

    Returns
    -------
    float
        Length in s of the pair that was added; 0 if none was.
    """
    dt = now_s - s.pair_s
    if (s.by_gps == 1 and dt > MAX_PAIR_S) or dt < 0.0 or dt > 10.0:
        clear_pairs(s)
        s.by_gps = 0
        begin_pair(s, now_s, (0.0, 0.0, 0.0), force_i)
        return 0.0
    if s.by_gps == 1 or dt < period_s:
        return 0.0
    force = mean_force(s, force_i, dt)
    # A plain mean at first: one pair would count for as long as the low-pass remembers.
    tau = SWING_TAU_S if swings else PULL_TAU_S
    share = min(1.0, dt / min(tau, s.lasted_s + dt))
    for k in range(3):
        s.force_first_i[k] += share * (force[k] - s.force_first_i[k])
        newest = s.force_first_i[k] if swings else force[k]
        s.force_mean_i[k] += share * (newest - s.force_mean_i[k])
    s.pull_mps2 = 0.0 if s.at_rest == 1 else unseen_acceleration(s)
    s.turning_mps2 += min(1.0, dt / TURNING_TAU_S) * (s.pull_mps2 - s.turning_mps2)
    weight = 1.0 / (GRAVITY_NOISE_MPS2 * GRAVITY_NOISE_MPS2)
    take_pair(s, force, (0.0, 0.0, -STANDARD_GRAVITY_MPS2), weight, dt)
    begin_pair(s, now_s, (0.0, 0.0, 0.0), force_i)
    return dt


@compiled
def unseen_acceleration(s: AlignmentState) -> float:
    """Return the level acceleration that a mean force beyond gravity gives away, m/s2.

    Gravity stands still in the gyroscope's frame, what pulls in a turn adds to it squarely; the
    norm of the sum knows of no attitude.
    """
    x, y, z = as_vec(s.force_mean_i)
    usual = USUAL_PULL * STANDARD_GRAVITY_MPS2
    return math.sqrt(max(x * x + y * y + z * z - usual * usual, 0.0))


@compiled
def set_davenport(s: AlignmentState) -> None:
    """Write Davenport's matrix, shifted so that no eigenvalue is negative."""
    B, K = s.outer, s.square[0]
    trace = B[0, 0] + B[1, 1] + B[2, 2]
    K[0, 0] = trace + s.squares
    K[0, 1] = K[1, 0] = B[2, 1] - B[1, 2]
    K[0, 2] = K[2, 0] = B[0, 2] - B[2, 0]
    K[0, 3] = K[3, 0] = B[1, 0] - B[0, 1]
    for i in range(3):
        for j in range(3):
            K[1 + i, 1 + j] = B[i, j] + B[j, i] - (trace - s.squares if i == j else 0.0)


@compiled
def solve_alignment(s: AlignmentState) -> Quat:
    """Find the turn from the gyroscope's frame to NED that fits the pairs best.

    Returns
    -------
    tuple of 4 floats
        Scalar first; the heading is arbitrary where the pairs do not tell it.
    """
    set_davenport(s)
    for n in range(SQUARINGS):
        M, out = s.square[n % 2], s.square[1 - n % 2]
        trace = max(M[0, 0] + M[1, 1] + M[2, 2] + M[3, 3], 1e-300)
        for i in range(4):
            for j in range(4):
                total = 0.0
                for k in range(4):
                    total += (M[i, k] / trace) * (M[k, j] / trace)
                out[i, j] = total
    M = s.square[SQUARINGS % 2]
    best = 0
    for i in range(1, 4):
        if M[i, i] > M[best, best]:
            best = i
    return normalise((M[best, 0], M[best, 1], M[best, 2], M[best, 3]))


@compiled
def misfit(s: AlignmentState, q_ni: Quat) -> float:
    """Return the mean squared misfit of a solution against what the noise explains, 1 or more."""
    set_davenport(s)
    K, fit = s.square[0], 0.0
    for i in range(4):
        for j in range(4):
            fit += q_ni[i] * K[i, j] * q_ni[j]
    # Three numbers a pair, half a square each; `fit` holds the shift once over.
    return max(1.0, (2.0 * s.squares - fit) / (1.5 * max(s.pairs, 1.0)))


@compiled
def alignment_level_std(s: AlignmentState, excess: float) -> float:
    """Return how well the pairs say the level, rad; `excess` is the `misfit`."""
    J = s.information
    a, b, c = J[0, 0], J[1, 1], J[2, 2]
    d, e, f = J[0, 1], J[0, 2], J[1, 2]
    level = a * b - d * d
    if level < 1.0:
        return UNKNOWN_RAD
    determinant = c * level - a * f * f - b * e * e + 2.0 * d * e * f
    # What pulls one way, with no heading to say which, may be tilt: the level is as unsure as that.
    known = determinant + level / ANY_HEADING_VAR
    told = c + 1.0 / ANY_HEADING_VAR
    variance = ((a + b) * told - e * e - f * f) / known * excess
    if s.by_gps == 0:
        # However it is shaken: over the time, the mean force is gravity but for the speed gained.
        variance = min(variance, (HAND_MPS / (STANDARD_GRAVITY_MPS2 * s.gathered_s)) ** 2)
        # What flies a turn pulls one way for a part of the time, harder than any hand.
        lean = s.pull_mps2 / STANDARD_GRAVITY_MPS2 * min(1.0, TURN_S / s.gathered_s)
        variance = max(variance, lean * lean)
    return math.sqrt(min(variance + drift_variance(s), UNKNOWN_RAD * UNKNOWN_RAD))


@compiled
def drift_variance(s: AlignmentState) -> float:
    """Return the variance by which the gyroscope's frame turns between the pairs and now, rad2."""
    return (DRIFT_RADPS * 0.5 * s.gathered_s) ** 2


@compiled
def level_difference(q_a: Quat, q_b: Quat) -> float:
    """Return the angle between the verticals of two attitudes, rad."""
    x, y = rotate_inverse(q_a, (0.0, 0.0, 1.0)), rotate_inverse(q_b, (0.0, 0.0, 1.0))
    return math.acos(max(-1.0, min(1.0, x[0] * y[0] + x[1] * y[1] + x[2] * y[2])))


@compiled
def heading_difference(q_a: Quat, q_b: Quat) -> float:
    """Return the turn about down from the second attitude to the first, rad."""
    conjugate = (q_b[0], -q_b[1], -q_b[2], -q_b[3])
    turn = multiply(q_a, conjugate)
    angle = 2.0 * math.atan2(turn[3], turn[0])
    return math.atan2(math.sin(angle), math.cos(angle))
