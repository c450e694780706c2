"""How late GPS fixes come, out of nothing but motion: GPS velocity against the accelerometer.

The specific force is summed in the gyroscope's own frame. Over a few seconds, one turn takes all
its changes from fix to fix to those of the GPS velocity, gravity added: Wahba's problem, whose
misfit is known without the turn itself [1]_. It is known for several latencies at once. The misfits
of all manoeuvres add up, and the true latency is where a parabola through the least has its lowest
point; how sharp that is tells how well it is known. Straight flight has no least.

References
----------
.. [1] F. L. Markley and J. L. Crassidis, "Fundamentals of Spacecraft Attitude Determination and
   Control", 2014, section 5.3.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.history import recall
from gateway.estimation.kernel_record import FloatArray, as_vec, fill, write_vec
from gateway.estimation.local_position import NEVER_S, PlaceState
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

LAGS: Final = 15
EARLIEST_S: Final = -0.1
LAG_STEP_S: Final = 0.05
"""From 0.1 s early, for the clocks of a log may be off, to 0.6 s: no receiver is later."""
LEAST_PAIR_S: Final = 0.15
MOST_PAIR_S: Final = 1.5
"""Changes of velocity from fix to fix are compared within these intervals."""
WINDOW_S: Final = 8.0
"""For so long the gyroscope's frame holds still."""
WINDOW_PAIRS: Final = 6
"""A window of fewer says little."""
MANOEUVRE_MPS2: Final = 0.7
"""A window in which the acceleration changes by less is no manoeuvre; rms about its mean."""
SHARED: Final = 2.0
"""Changes that follow one another share the noise of a velocity: they tell half as much."""
WINDOW_STD_S: Final = 0.02
"""A window's own error, however sharp its least: the latency varies, and so does the filter in
the receiver."""
WINDOW_KEPT: Final = 0.98
"""Of what is known, from one manoeuvre to the next."""
KNOWN_STD_S: Final = 0.012
"""A latency that is told less well is not known."""
CONTRADICTED_S: Final = 0.07
"""What is set stands within this: a position may be a little later than the velocity."""
MOST_HALF_SPAN: Final = 3
"""A parabola is fitted to so many misfits at most on either side of the least."""
LEAST_RISE: Final = 16.0
"""By how much the logarithm of the likelihood, twice, has to fall from the best to these."""
CERTAIN: Final = 1e30
"""Information in 1/s2 that no manoeuvre outweighs."""
SLEW: Final = 0.01
"""Seconds by which the latency in use changes in a second, so that no fix seems to jump."""
NEWTON_STEPS: Final = 12


class LatencyState(PlaceState):
    """The sums of one window, and what all windows tell."""

    gps_latency_s: float
    """That is in use."""
    lag_next_s: float
    lag_next_vel: Annotated[FloatArray, (3,)]
    """A velocity that waits until the integrals reach to its earliest time, by its arrival."""
    lag_from_s: float
    lag_from_vel: Annotated[FloatArray, (3,)]
    lag_from_force: Annotated[FloatArray, (LAGS, 3)]
    """Where the next pair begins."""
    lag_window_s: float
    lag_pairs: float
    lag_accel: Annotated[FloatArray, (3,)]
    lag_accel_sq: float
    lag_outer: Annotated[FloatArray, (LAGS, 9)]
    lag_squares: Annotated[FloatArray, (LAGS,)]
    """Of this window."""
    lag_misfit: Annotated[FloatArray, (LAGS,)]
    """Of all windows: twice the logarithm by which a latency is less likely than the best."""
    found_latency_s: float
    """That fits all windows best."""
    found_information: float
    """Of that latency, 1/s2."""


@compiled
def begin_latency(s: LatencyState, latency_s: float) -> None:
    """Begin with the latency that is set."""
    s.gps_latency_s = latency_s
    forget_velocities(s)


@compiled
def begin_certain(s: LatencyState, latency_s: float) -> None:
    """Begin with a latency that is known: no manoeuvre contradicts it."""
    begin_latency(s, latency_s)
    for k in range(LAGS):
        s.lag_misfit[k] = CERTAIN * (lag_of(k) - latency_s) ** 2


@compiled
def forget_velocities(s: LatencyState) -> None:
    """Drop what is tied to the clock; what the windows told stays."""
    s.lag_next_s = s.lag_from_s = s.lag_window_s = NEVER_S


@compiled
def lag_of(k: int) -> float:
    """Return one of the latencies that are tried, s."""
    return EARLIEST_S + LAG_STEP_S * k


@compiled
def watch_latency(s: LatencyState, set_s: float, arrival_s: float, vel: Vec3) -> None:
    """Take the velocity of a fix, and settle on a latency.

    Parameters
    ----------
    s : LatencyState
        Changed in place.
    set_s : float
        The latency that is set.
    arrival_s : float
        On the filter's own time.
    vel : tuple of 3 floats
        NED, m/s.
    """
    dt = arrival_s - s.lag_next_s
    if 0.0 <= dt < LEAST_PAIR_S:
        return
    if 0.0 < dt < MOST_PAIR_S:
        add_velocity(s, s.lag_next_s, as_vec(s.lag_next_vel))
        settle_latency(s, set_s, dt)
    s.lag_next_s = arrival_s
    write_vec(s.lag_next_vel, vel)


@compiled
def add_velocity(s: LatencyState, arrival_s: float, vel: Vec3) -> None:
    """Compare the change of velocity since the last one with the force, for every latency."""
    if not 0.0 <= arrival_s - s.lag_window_s <= WINDOW_S:
        close_window(s)
        s.lag_window_s = arrival_s
    dt = arrival_s - s.lag_from_s
    whole = 0.0 < dt < MOST_PAIR_S
    v = s.lag_from_vel
    wanted = (vel[0] - v[0], vel[1] - v[1], vel[2] - v[2] - STANDARD_GRAVITY_MPS2 * dt)
    wanted_sq = wanted[0] ** 2 + wanted[1] ** 2 + wanted[2] ** 2
    for k in range(LAGS):
        recall(s.ring, s.ring_count, arrival_s - lag_of(k), s.time_s, s.integrals, s.then)
        for j in range(3):
            felt = s.then[j] - s.lag_from_force[k, j]
            s.lag_from_force[k, j] = s.then[j]
            if whole:
                s.lag_squares[k] += felt * felt
                for i in range(3):
                    s.lag_outer[k, 3 * i + j] += wanted[i] * felt
        if whole:
            s.lag_squares[k] += wanted_sq
    if whole:
        s.lag_pairs += 1.0
        s.lag_accel_sq += wanted_sq / (dt * dt)
        for i in range(3):
            s.lag_accel[i] += wanted[i] / dt
    s.lag_from_s = arrival_s
    write_vec(s.lag_from_vel, vel)


@compiled
def close_window(s: LatencyState) -> None:
    """Learn what a window tells, if there was a manoeuvre and a least misfit; begin a new one."""
    n = s.lag_pairs
    if n >= WINDOW_PAIRS and is_manoeuvre(s):
        least = 0
        for k in range(LAGS):
            # What is left of the squares is put in their place.
            s.lag_squares[k] = max(s.lag_squares[k] - 2.0 * best_fit(s, k), 1e-9)
            if s.lag_squares[k] < s.lag_squares[least]:
                least = k
        learn_latency(s, least, 3.0 * n / (SHARED * s.lag_squares[least]))
    s.lag_pairs = s.lag_accel_sq = 0.0
    fill(s.lag_accel, 0.0)
    fill(s.lag_squares, 0.0)
    for k in range(LAGS):
        for i in range(9):
            s.lag_outer[k, i] = 0.0


@compiled
def is_manoeuvre(s: LatencyState) -> bool:
    """Return whether the acceleration has changed enough in a window."""
    n, a = s.lag_pairs, s.lag_accel
    mean_sq = (a[0] ** 2 + a[1] ** 2 + a[2] ** 2) / (n * n)
    return bool(s.lag_accel_sq / n - mean_sq > MANOEUVRE_MPS2 * MANOEUVRE_MPS2)


@compiled
def best_fit(s: LatencyState, k: int) -> float:
    """Return the sum of products that the best turn makes of a window's pairs.

    That is the largest eigenvalue of Davenport's matrix, as a root of its characteristic
    polynomial [1]_; it cannot be more than half of the squares, from where Newton's steps descend.
    """
    # Number by number: run as Python, a record has no row of a matrix.
    B = s.lag_outer
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = (
        B[k, 0], B[k, 1], B[k, 2], B[k, 3], B[k, 4], B[k, 5], B[k, 6], B[k, 7], B[k, 8],
    )  # fmt: skip
    norm_sq = b00 * b00 + b01 * b01 + b02 * b02 + b10 * b10 + b11 * b11 + b12 * b12
    norm_sq += b20 * b20 + b21 * b21 + b22 * b22
    # The adjugate, transposed: its products are those of two singular values.
    c00, c01, c02 = b11 * b22 - b12 * b21, b12 * b20 - b10 * b22, b10 * b21 - b11 * b20
    c10, c11, c12 = b02 * b21 - b01 * b22, b00 * b22 - b02 * b20, b01 * b20 - b00 * b21
    c20, c21, c22 = b01 * b12 - b02 * b11, b02 * b10 - b00 * b12, b00 * b11 - b01 * b10
    determinant = b00 * c00 + b01 * c01 + b02 * c02
    cofactors_sq = c00 * c00 + c01 * c01 + c02 * c02 + c10 * c10 + c11 * c11 + c12 * c12
    cofactors_sq += c20 * c20 + c21 * c21 + c22 * c22
    x: float = 0.5 * s.lag_squares[k]
    for _ in range(NEWTON_STEPS):
        # (x^2 - |B|^2)^2 - 8 x det B - 4 |adj B|^2, of which the sum of singular values is a root.
        off = x * x - norm_sq
        slope = 4.0 * x * off - 8.0 * determinant
        if slope <= 0.0:
            break
        x -= (off * off - 8.0 * x * determinant - 4.0 * cofactors_sq) / slope
    return x


@compiled
def learn_latency(s: LatencyState, least: int, weight: float) -> None:
    """Add a window's misfits to those of the others, and find the latency that fits all best.

    Each counts by what it has beyond the least: of a window that says little, noise makes the
    lowest point, but it is hardly lower than the rest.
    """
    m = s.lag_squares
    _, curve = parabola(m, least, MOST_HALF_SPAN)
    share = weight / (1.0 + max(weight * curve, 0.0) * (WINDOW_STD_S / LAG_STEP_S) ** 2)
    best = 0
    for k in range(LAGS):
        s.lag_misfit[k] = WINDOW_KEPT * s.lag_misfit[k] + share * (m[k] - m[least])
        if s.lag_misfit[k] < s.lag_misfit[best]:
            best = k
    lowest, curve = sharpest_parabola(s.lag_misfit, best)
    known = curve > 0.0 and 0.0 <= lowest <= LAGS - 1.0
    s.found_information = curve / (LAG_STEP_S * LAG_STEP_S) if known else 0.0
    if known:
        s.found_latency_s = EARLIEST_S + LAG_STEP_S * lowest


@compiled
def sharpest_parabola(misfit: FloatArray, least: int) -> tuple[float, float]:
    """Fit a parabola over the shortest span in which the misfit rises beyond noise.

    Its neighbours alone would mostly tell the noise of the accelerometer, which differs from one
    latency to the next; far from it, the misfit is no parabola.

    Returns
    -------
    tuple of 2 floats
        Where it is lowest, in steps from the earliest latency, and its curvature by steps; 0 where
        it does not rise so far.
    """
    for half in range(1, MOST_HALF_SPAN + 1):
        lowest, curve = parabola(misfit, least, half)
        # Noise is the same over any span, so it bends a short one more.
        if curve * half * half > LEAST_RISE * (MOST_HALF_SPAN + 1 - half):
            return lowest, curve
    return 0.0, 0.0


@compiled
def parabola(misfit: FloatArray, least: int, half: int) -> tuple[float, float]:
    """Fit a parabola to the misfits around the least, `half` of them on either side."""
    middle = min(max(least, half), LAGS - 1 - half)
    mean_sq = half * (half + 1) / 3.0
    slope = curve = second = fourth = 0.0
    for x in range(-half, half + 1):
        second += x * x
        fourth += (x * x - mean_sq) * x * x
        slope += x * misfit[middle + x]
        curve += (x * x - mean_sq) * misfit[middle + x]
    slope, curve = slope / second, curve / fourth
    if curve <= 0.0:
        return 0.0, 0.0
    return middle - 0.5 * slope / curve, curve


@compiled
def found_latency_std(s: LatencyState) -> float:
    """Return how well the latency is found, s."""
    return 1.0 / math.sqrt(s.found_information) if s.found_information > 0.0 else math.inf


@compiled
def latency_to_use(found_s: float, set_s: float) -> float:
    """Return the latency that is set, or the one that is found where it contradicts that, s."""
    return max(found_s, 0.0) if abs(found_s - set_s) > CONTRADICTED_S else set_s


@compiled
def settle_latency(s: LatencyState, set_s: float, dt: float) -> None:
    """Move the latency in use to the one that is set, or that is found where they contradict.

    Parameters
    ----------
    s : LatencyState
        Changed in place.
    set_s : float
        The setting.
    dt : float
        Time since it was moved last, s.
    """
    wanted = set_s
    if found_latency_std(s) < KNOWN_STD_S:
        wanted = latency_to_use(s.found_latency_s, set_s)
    most = SLEW * dt
    s.gps_latency_s += min(max(wanted - s.gps_latency_s, -most), most)
