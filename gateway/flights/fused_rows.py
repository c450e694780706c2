"""Fused states as the lines of a table without other columns."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from gateway.estimation.kernel_record import FloatArray, IntArray
from gateway.flightlog.table.cells import write_lines
from gateway.flightlog.table.row import NAV_COLUMNS, WHOLE_COLUMNS
from gateway.flightlog.table.table import FORMAT_LINE, TableHeader, encode_header

LINES: Final = 2000
"""Lines that are written at once."""
WRITTEN: Final = ("time_us", *NAV_COLUMNS)
IS_WHOLE: Final = np.array([name in WHOLE_COLUMNS for name in WRITTEN])


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
    yield f"{FORMAT_LINE}\n{encode_header(header)}{','.join(WRITTEN)}\n".encode()
    table = np.column_stack([time_us, time_us, states])
    for begin in range(0, len(table), LINES):
        yield write_lines(table[begin : begin + LINES], IS_WHOLE)
