"""How samples reach a filter, live and over a log: written once, compiled for each.

Machine code holds all that it calls. So the loop is a template: a copy is compiled for each filter,
in which the filter's own functions stand for those that are empty here.
"""

from collections.abc import Callable
from typing import Any, Final, ParamSpec, TypeVar

import numpy as np

from gateway.compiled import array_at, compiled, compiled_with, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.columns import GPS_COLUMNS, IMU_COLUMNS, NAV_COLUMNS
from gateway.estimation.kernel import Kernels
from gateway.estimation.kernel_record import FloatArray, IntArray, layout

S = TypeVar("S")
P = TypeVar("P")
Arguments = ParamSpec("Arguments")

STATE_LAYOUT = GAINS_LAYOUT = np.dtype(np.void)
FLOAT: Final = np.dtype(np.float64)
INT: Final = np.dtype(np.int64)
FLOAT_SIZE: Final = FLOAT.itemsize


def start(s: Any, p: Any) -> None:
    """Stand for the filter's own."""


def take_imu(s: Any, p: Any, time_us: int, row: FloatArray) -> None:
    """Stand for the filter's own."""


def take_baro(s: Any, p: Any, alt_m: float) -> None:
    """Stand for the filter's own."""


def take_gps(s: Any, p: Any, arrival_us: int, row: FloatArray) -> None:
    """Stand for the filter's own."""


def write_output(s: Any, row: FloatArray) -> None:
    """Stand for the filter's own."""


@compiled
def row_at(matrix: int, row: int, columns: int) -> FloatArray:
    """View a row of a matrix at an address."""
    return array_at(matrix + row * columns * FLOAT_SIZE, (columns,), FLOAT)  # type: ignore[no-any-return]


def begin(state: int, gains: int) -> None:
    """Make a state of zeros one that nothing has been seen in."""
    start(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT))


def imu_steps(
    state: int, gains: int, count: int, times_us: int, samples: int, outputs: int
) -> None:
    """Take IMU samples, and write a row after each."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    time_us = array_at(times_us, (count,), INT)
    for i in range(count):
        take_imu(s, p, time_us[i], row_at(samples, i, IMU_COLUMNS))
        write_output(s, row_at(outputs, i, NAV_COLUMNS))


def baro_step(state: int, gains: int, alt_m: float) -> None:
    """Take one barometer sample."""
    take_baro(record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT), alt_m)


def gps_step(state: int, gains: int, arrival_us: int, fix: int) -> None:
    """Take one fix."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    take_gps(s, p, arrival_us, row_at(fix, 0, GPS_COLUMNS))


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
    state: int,
    gains: int,
    imu_count: int,
    imu_times_us: int,
    imu_rows: int,
    baro_count: int,
    baro_places: int,
    baro_alts_m: int,
    gps_count: int,
    gps_places: int,
    gps_times_us: int,
    gps_rows: int,
    outputs: int,
) -> None:
    """Advance over a log: at each IMU sample first the heights, then the fixes before it."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    imu_time_us = array_at(imu_times_us, (imu_count,), INT)
    baro_before = array_at(baro_places, (baro_count,), INT)
    baro_alt_m = array_at(baro_alts_m, (baro_count,), FLOAT)
    gps_before = array_at(gps_places, (gps_count,), INT)
    gps_time_us = array_at(gps_times_us, (gps_count,), INT)
    baros = fixes = 0
    for i in range(imu_count):
        while baros < baro_count and baro_before[baros] <= i:
            take_baro(s, p, baro_alt_m[baros])
            baros += 1
        while fixes < gps_count and gps_before[fixes] <= i:
            take_gps(s, p, gps_time_us[fixes], row_at(gps_rows, fixes, GPS_COLUMNS))
            fixes += 1
        take_imu(s, p, imu_time_us[i], row_at(imu_rows, i, IMU_COLUMNS))
        write_output(s, row_at(outputs, i, NAV_COLUMNS))


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
        "start": start,
        "take_imu": take_imu,
        "take_baro": take_baro,
        "take_gps": take_gps,
        "write_output": write_output,
    }
    mark = declaration.__name__

    def entry(template: Callable[Arguments, None]) -> EntryPoint[Arguments]:
        return EntryPoint(compiled_with(template, names, mark))

    return Kernels(
        declaration=declaration,
        begin=entry(begin),
        imus=entry(imu_steps),
        baro=entry(baro_step),
        gps=entry(gps_step),
        run=entry(run),
        earlier=compiled_with(take_earlier, names, mark),
    )
