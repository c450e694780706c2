"""GPS latency from motion: GPS velocity against the accelerometer, for several latencies at once.

The specific force is integrated in the gyroscope frame. Within a window of some seconds, one
rotation transforms its changes into those of the GPS velocity, after gravity is subtracted. The
misfit of Wahba's problem is known without the rotation itself [1]_. The misfits of all windows with
a manoeuvre are added, and the latency is at the minimum of a parabola through the smallest ones;
its curvature gives the variance.

References
----------
.. [1] F. L. Markley and J. L. Crassidis, "Fundamentals of Spacecraft Attitude Determination and
   Control", 2014, section 5.3.
"""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.columns import FRESH_GPS_S
from gateway.estimation.eskf.alignment import MISMATCH_SIGMA
from gateway.estimation.eskf.predict import look_back
from gateway.estimation.eskf.state import LATENCIES, NEVER_S, State
from gateway.estimation.record import FloatArray
from gateway.geometry.quaternion import norm_sq
from gateway.records import Vec3
from gateway.units import STANDARD_GRAVITY_MPS2

STEP_S: Final = 0.05
"""Step of the compared latencies, from 0 to 0.6 s, which no receiver exceeds."""
LEAST_PAIR_S: Final = 0.15
"""Shortest interval of two compared velocities."""
WINDOW_S: Final = 8.0
"""Length of a window, in which the drift of the gyroscope frame is negligible."""
WINDOW_PAIRS: Final = 6.0
"""Least number of pairs of a window."""
MANOEUVRE_MPS2: Final = 0.7
"""Least RMS variation of the acceleration of a window that counts."""
SHARED: Final = 2.0
"""Divisor for the weight of differences, since successive ones share the noise of a velocity."""
WINDOW_STD_S: Final = 0.02
"""Least standard deviation of a window, since latency and the receiver's filter vary."""
WINDOW_KEPT: Final = 0.98
"""Forgetting factor from window to window."""
KNOWN_STD_S: Final = 0.012
"""Maximum standard deviation of a usable latency estimate."""
CONFLICT_S: Final = 0.07
"""Maximum difference at which the set latency is used: position may lag velocity by this."""
MOST_HALF_SPAN: Final = 3
"""Maximum number of misfits on either side of the smallest to which a parabola is fitted."""
SLEW: Final = 0.01
"""Maximum change of the latency in use per second, so that fixes do not seem to jump."""
NEWTON_STEPS: Final = 12
"""Number of steps, which converge quadratically from above to double precision."""
CERTAIN: Final = 1e30
"""Inverse variance of a fixed latency, which no window outweighs, 1/s2."""


@compiled
def begin_certain(s: State, latency_s: float) -> None:
    """Start with a fixed latency, which manoeuvres do not change."""
    s.gps_latency_s = latency_s
    clear_velocities(s)
    for k in range(LATENCIES):
        s.latency_misfit[k] = CERTAIN * (STEP_S * k - latency_s) ** 2


@compiled
def clear_velocities(s: State) -> None:
    """Discard the open window; the closed ones stay."""
    s.window_from[0] = s.window_from[4] = NEVER_S


@compiled
def compare_latencies(s: State, set_s: float, arrival_s: float, vel: Vec3) -> None:
    """Compare the change of velocity since the last fix with the force, and choose a latency."""
    dt = arrival_s - s.window_from[0]
    if 0.0 <= dt < LEAST_PAIR_S:
        return
    if not 0.0 <= arrival_s - s.window_from[4] <= WINDOW_S:
        close_window(s)
        s.window_from[4] = arrival_s
    whole = 0.0 < dt < FRESH_GPS_S
    f = s.window_from
    change = (vel[0] - f[1], vel[1] - f[2], vel[2] - f[3] - STANDARD_GRAVITY_MPS2 * dt)
    for k in range(LATENCIES):
        look_back(s, arrival_s - STEP_S * k)
        for j in range(3):
            measured = s.then[j] - s.window_force[k, j]
            s.window_force[k, j] = s.then[j]
            if whole:
                s.window_products[k, 9] += measured * measured
                for i in range(3):
                    s.window_products[k, 3 * i + j] += change[i] * measured
        if whole:
            s.window_products[k, 9] += norm_sq(change)
    if whole:
        s.window_sums[0] += 1.0
        for i in range(3):
            s.window_sums[1 + i] += change[i] / dt
        s.window_sums[4] += norm_sq(change) / (dt * dt)
        slew_latency(s, set_s, dt)
    f[0], f[1], f[2], f[3] = arrival_s, vel[0], vel[1], vel[2]


@compiled
def close_window(s: State) -> None:
    """Add the misfits of a window with a manoeuvre to the others, and clear it."""
    n, sums, products = s.window_sums[0], s.window_sums, s.window_products
    if n >= WINDOW_PAIRS:
        mean_sq = (sums[1] ** 2 + sums[2] ** 2 + sums[3] ** 2) / (n * n)
        if sums[4] / n - mean_sq > MANOEUVRE_MPS2 * MANOEUVRE_MPS2:
            add_window(s, n)
    sums[:] = 0.0
    products[:] = 0.0


@compiled
def add_window(s: State, n: float) -> None:
    """Add the misfits, each minus the smallest, and find the best latency."""
    m = s.window_misfit
    least = 0
    for k in range(LATENCIES):
        m[k] = max(s.window_products[k, 9] - 2.0 * best_fit(s, k), 1e-9)
        if m[k] < m[least]:
            least = k
    weight = 3.0 * n / (SHARED * m[least])
    curve = fit_parabola(m, least, MOST_HALF_SPAN)[1]
    share = weight / (1.0 + max(weight * curve, 0.0) * (WINDOW_STD_S / STEP_S) ** 2)
    best = 0
    for k in range(LATENCIES):
        s.latency_misfit[k] = WINDOW_KEPT * s.latency_misfit[k] + share * (m[k] - m[least])
        if s.latency_misfit[k] < s.latency_misfit[best]:
            best = k
    lowest, curve = sharpest_parabola(s, best)
    known = curve > 0.0 and 0.0 <= lowest <= LATENCIES - 1.0
    s.latency_found[1] = curve / (STEP_S * STEP_S) if known else 0.0
    if known:
        s.latency_found[0] = STEP_S * lowest


@compiled
def best_fit(s: State, k: int) -> float:
    """Return the sum of products for the best rotation of a window's pairs.

    This is the largest eigenvalue of Davenport's matrix, a root of its characteristic polynomial
    `(x^2 - |B|^2)^2 - 8 x det B - 4 |adj B|^2` [1]_. Newton's steps descend from an upper bound.
    """
    B = s.window_products
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = (
        B[k, 0], B[k, 1], B[k, 2], B[k, 3], B[k, 4], B[k, 5], B[k, 6], B[k, 7], B[k, 8],
    )  # fmt: skip
    norm_sq = b00 * b00 + b01 * b01 + b02 * b02 + b10 * b10 + b11 * b11 + b12 * b12
    norm_sq += b20 * b20 + b21 * b21 + b22 * b22
    c00, c01, c02 = b11 * b22 - b12 * b21, b12 * b20 - b10 * b22, b10 * b21 - b11 * b20
    c10, c11, c12 = b02 * b21 - b01 * b22, b00 * b22 - b02 * b20, b01 * b20 - b00 * b21
    c20, c21, c22 = b01 * b12 - b02 * b11, b02 * b10 - b00 * b12, b00 * b11 - b01 * b10
    determinant = b00 * c00 + b01 * c01 + b02 * c02
    adjugate_sq = c00 * c00 + c01 * c01 + c02 * c02 + c10 * c10 + c11 * c11 + c12 * c12
    adjugate_sq += c20 * c20 + c21 * c21 + c22 * c22
    x: float = 0.5 * B[k, 9]
    for _ in range(NEWTON_STEPS):
        off = x * x - norm_sq
        slope = 4.0 * x * off - 8.0 * determinant
        if slope <= 0.0:
            break
        x -= (off * off - 8.0 * x * determinant - 4.0 * adjugate_sq) / slope
    return x


@compiled
def sharpest_parabola(s: State, least: int) -> tuple[float, float]:
    """Fit a parabola over the shortest span in which the misfit rises beyond noise.

    Returns the position of its minimum in steps, and its curvature, 0 if the misfit does not rise.
    """
    for half in range(1, MOST_HALF_SPAN + 1):
        lowest, curve = fit_parabola(s.latency_misfit, least, half)
        # The noise is the same over any span, so it changes the curvature of a short one more.
        if curve * half * half > MISMATCH_SIGMA**2 * (MOST_HALF_SPAN + 1 - half):
            return lowest, curve
    return 0.0, 0.0


@compiled
def fit_parabola(misfit: FloatArray, least: int, half: int) -> tuple[float, float]:
    """Fit a parabola to the misfits around the smallest, `half` of them on either side."""
    middle = min(max(least, half), LATENCIES - 1 - half)
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
def latency_std(s: State) -> float:
    """Return the standard deviation of the estimated latency, s."""
    return 1.0 / math.sqrt(s.latency_found[1]) if s.latency_found[1] > 0.0 else math.inf


@compiled
def latency_to_use(found_s: float, set_s: float) -> float:
    """Return the set latency, or the estimated one if they conflict, s."""
    return max(found_s, 0.0) if abs(found_s - set_s) > CONFLICT_S else set_s


@compiled
def slew_latency(s: State, set_s: float, dt: float) -> None:
    """Move the latency in use towards the set or estimated one."""
    known = latency_std(s) < KNOWN_STD_S
    wanted = latency_to_use(s.latency_found[0], set_s) if known else set_s
    most = SLEW * dt
    s.gps_latency_s += min(max(wanted - s.gps_latency_s, -most), most)
