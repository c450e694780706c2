"""Fused states as the lines of a table without other columns."""

import math
from collections.abc import Iterator
from typing import Final

from gateway.estimation.kernel_record import FloatArray, IntArray
from gateway.flightlog.table.row import NAV_COLUMNS
from gateway.flightlog.table.table import FORMAT_LINE, TableHeader, encode_header

LINES: Final = 2000
"""Lines that are written at once."""


def fused_lines(header: TableHeader, time_us: IntArray, states: FloatArray) -> Iterator[bytes]:
    """Write a table of states only; unknown values are left blank.

    Parameters
    ----------
    header : TableHeader
        Head of the table: how they were fused.
    time_us : ndarray, shape (N,)
        Of the IMU samples.
    states : ndarray, shape (N, NAV_COLUMNS)
        See `gateway.estimation.columns`.
    """
    yield f"{FORMAT_LINE}\n{encode_header(header)}time_us,{','.join(NAV_COLUMNS)}\n".encode()
    for begin in range(0, len(time_us), LINES):
        chunk = slice(begin, begin + LINES)
        yield "".join(map(_line, time_us[chunk].tolist(), states[chunk].tolist())).encode()


def _line(time_us: int, values: list[float]) -> str:
    *figures, flags = values
    cells = ["" if math.isnan(value) else repr(value) for value in figures]
    return f"{time_us},{time_us},{','.join(cells)},{int(flags)}\n"
