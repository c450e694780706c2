"""How samples reach a filter, live and over a log: written once, compiled for each.

Numba keeps the machine code of a function by its file and name, and binds what it calls when it is
compiled. So the loop is a template: a copy is compiled for each filter, in which the filter's own
functions stand for those that are empty here.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from gateway.compiled import compiled_with, record_at
from gateway.estimation.kernel import Kernels
from gateway.estimation.kernel_record import FloatArray, IntArray, layout

S = TypeVar("S")
P = TypeVar("P")

STATE_LAYOUT = GAINS_LAYOUT = np.dtype(np.void)


def take_imu(s: Any, p: Any, time_us: int, row: FloatArray) -> None:
    """Stand for the filter's own."""


def take_baro(s: Any, p: Any, alt_m: float) -> None:
    """Stand for the filter's own."""


def take_gps(s: Any, p: Any, arrival_us: int, row: FloatArray) -> None:
    """Stand for the filter's own."""


def write_output(s: Any, row: FloatArray) -> None:
    """Stand for the filter's own."""


def imu_step(state: int, gains: int, time_us: int, row: FloatArray, output: FloatArray) -> None:
    """Take one IMU sample live, and write the output row; records by their addresses."""
    s = record_at(state, STATE_LAYOUT)
    take_imu(s, record_at(gains, GAINS_LAYOUT), time_us, row)
    write_output(s, output)


def baro_step(state: int, gains: int, alt_m: float) -> None:
    """Take one barometer sample live."""
    take_baro(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT), alt_m)


def gps_step(state: int, gains: int, arrival_us: int, row: FloatArray) -> None:
    """Take one fix live."""
    take_gps(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT), arrival_us, row)


def take_earlier(
    s: object,
    p: object,
    now_us: int,
    taken: IntArray,
    baro_time_us: IntArray,
    baro_alt_m: FloatArray,
    gps_time_us: IntArray,
    gps: FloatArray,
) -> None:
    """Take what came before an IMU sample: heights, then fixes; `taken` counts both."""
    while taken[0] < baro_time_us.shape[0] and baro_time_us[taken[0]] <= now_us:
        take_baro(s, p, baro_alt_m[taken[0]])
        taken[0] += 1
    while taken[1] < gps_time_us.shape[0] and gps_time_us[taken[1]] <= now_us:
        take_gps(s, p, gps_time_us[taken[1]], gps[taken[1]])
        taken[1] += 1


def run(
    s: object,
    p: object,
    imu_time_us: IntArray,
    imu: FloatArray,
    baro_time_us: IntArray,
    baro_alt_m: FloatArray,
    gps_time_us: IntArray,
    gps: FloatArray,
    out: FloatArray,
) -> None:
    """Advance over a log: at each IMU sample, what came before it first."""
    taken = np.zeros(2, np.int64)
    for i in range(imu_time_us.shape[0]):
        now_us = imu_time_us[i]
        take_earlier(s, p, now_us, taken, baro_time_us, baro_alt_m, gps_time_us, gps)
        take_imu(s, p, now_us, imu[i])
        write_output(s, out[i])


def kernels_of(
    declaration: type[S],
    gains: type[P],
    start: Callable[[S, P], None],
    take_imu: Callable[[S, P, int, FloatArray], None],
    take_baro: Callable[[S, P, float], None],
    take_gps: Callable[[S, P, int, FloatArray], None],
    write_output: Callable[[S, FloatArray], None],
) -> Kernels[S, P]:
    """Compile the loop around a filter.

    Parameters
    ----------
    declaration, gains : type
        Of its records; see `layout`.
    start, take_imu, take_baro, take_gps, write_output : callable
        Its compiled functions.

    Returns
    -------
    Kernels
        What a `KernelEstimator` is made of.
    """
    names: dict[str, object] = {
        "STATE_LAYOUT": layout(declaration),
        "GAINS_LAYOUT": layout(gains),
        "take_imu": take_imu,
        "take_baro": take_baro,
        "take_gps": take_gps,
        "write_output": write_output,
    }
    mark = declaration.__name__
    earlier = compiled_with(take_earlier, names, mark)
    return Kernels(
        declaration=declaration,
        start=start,
        imu=compiled_with(imu_step, names, mark),
        baro=compiled_with(baro_step, names, mark),
        gps=compiled_with(gps_step, names, mark),
        earlier=earlier,
        run=compiled_with(run, names | {"take_earlier": earlier}, mark),
    )
