"""A short memory of integrals, so that a late fix meets the state at the time it was valid.

The ring holds running integrals of the specific force, not states: a difference of two entries is
what the inertial sensors saw between two times, whatever corrections came in between.
"""

from typing import Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray

SLOTS: Final = 512
"""At `SPACING_S` they span 2.5 s: the greatest latency that can be set, and some."""
SPACING_S: Final = 0.005
"""Samples that come faster share a slot; between slots the integrals are interpolated."""


@compiled
def remember(ring: FloatArray, count: int, time_s: float, values: FloatArray) -> int:
    """Store the newest integrals.

    Parameters
    ----------
    ring : ndarray, shape (SLOTS, 1 + k)
        Time and values of each slot; changed in place.
    count : int
        Slots written so far.
    time_s : float
        Time of the values, later than all before.
    values : ndarray, shape (k,)
        The integrals.

    Returns
    -------
    int
        Slots written so far; unchanged where the newest slot is too young for another.
    """
    if count > 0 and time_s - ring[(count - 1) % SLOTS, 0] < SPACING_S:
        return count
    slot = count % SLOTS
    ring[slot, 0] = time_s
    for k in range(values.shape[0]):
        ring[slot, 1 + k] = values[k]
    return count + 1


@compiled
def recall(
    ring: FloatArray, count: int, time_s: float, now_s: float, now: FloatArray, out: FloatArray
) -> float:
    """Interpolate the integrals at a past time.

    Parameters
    ----------
    ring : ndarray, shape (SLOTS, 1 + k)
        See `remember`.
    count : int
        Slots written so far.
    time_s : float
        The time asked for.
    now_s : float
        Present time.
    now : ndarray, shape (k,)
        Present integrals, the end of the interpolation where no slot is as young.
    out : ndarray, shape (k,)
        Filled with the integrals.

    Returns
    -------
    float
        The time that `out` holds for: `time_s`, held within what is remembered.
    """
    # Number by number: to assign one array to another, numba compiles the texts of numpy's errors.
    if time_s >= now_s or count == 0:
        for k in range(out.shape[0]):
            out[k] = now[k]
        return now_s
    oldest = max(0, count - SLOTS)
    low, high = oldest, count
    while low < high:
        middle = (low + high) // 2
        if ring[middle % SLOTS, 0] <= time_s:
            low = middle + 1
        else:
            high = middle
    if low == oldest:
        for k in range(out.shape[0]):
            out[k] = ring[oldest % SLOTS, 1 + k]
        return float(ring[oldest % SLOTS, 0])
    before = (low - 1) % SLOTS
    t0 = ring[before, 0]
    after = low % SLOTS
    t1 = now_s if low == count else ring[after, 0]
    share = (time_s - t0) / (t1 - t0) if t1 > t0 else 0.0
    for k in range(out.shape[0]):
        end = now[k] if low == count else ring[after, 1 + k]
        out[k] = ring[before, 1 + k] + share * (end - ring[before, 1 + k])
    return time_s
