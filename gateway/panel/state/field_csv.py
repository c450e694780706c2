"""Fields of the last minutes as one CSV table, for a spreadsheet."""

import math
from collections.abc import Mapping

import numpy as np

from gateway.panel.state.field_history import FloatArray, IntArray
from gateway.units import US_PER_S


def fields_csv(
    series: Mapping[str, tuple[IntArray, FloatArray]], units: Mapping[str, str], zero_unix_us: int
) -> str:
    """Write fields side by side.

    Parameters
    ----------
    series : mapping of str to (ndarray, ndarray)
        By name: times in µs on the panel's clock, growing, and values.
    units : mapping of str to str
        By name; appended to the name in the header.
    zero_unix_us : int
        Civil time of the clock's zero.

    Returns
    -------
    str
        A row for each time with any value, its first column seconds since 1970; empty where a
        field has no value, or NaN.
    """
    heads = [f"{name} ({units[name]})" if units.get(name) else name for name in series]
    lines = [",".join(["time_unix_s", *heads])]
    columns = [dict(zip(t.tolist(), v.tolist(), strict=True)) for t, v in series.values()]
    times = [t for t, _ in series.values()]
    for time_us in np.unique(np.concatenate(times)).tolist() if times else []:
        seconds = f"{(zero_unix_us + time_us) / US_PER_S:.6f}"
        lines.append(",".join([seconds, *(_cell(column.get(time_us)) for column in columns)]))
    return "\n".join(lines) + "\n"


def _cell(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.9g}"
