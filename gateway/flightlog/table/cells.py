"""Rows of the table as columns: lines into numbers and back, many at once.

A stretch of a table is one array of floats, a row a row and a column for each of `COLUMNS`; NaN is
an empty cell. Whole numbers up to `LARGEST_WHOLE` are exact in it. The digits are those of Python's
own `float` and `repr`.
"""

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.flightlog.table.row import (
    BARO,
    COLUMNS,
    GPS,
    HEAD_COLUMNS,
    LARGEST_WHOLE,
    MAG,
    NAV,
    RAW,
    SI,
    WHOLE_COLUMNS,
)
from gateway.records import GpsFixType, NavFlags
from gateway.units import counted

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

IS_WHOLE: Final = np.array([name in WHOLE_COLUMNS for name in COLUMNS])
_WHOLE: Final = np.flatnonzero(IS_WHOLE)
_AT: Final = {name: place for place, name in enumerate(COLUMNS)}
_MAY_BE_EMPTY: Final = {"gps_utc_us"}
"""Of the whole numbers of a group that is there."""
_NEEDED: Final = {
    group.start: [k for k in _WHOLE.tolist() if group.start <= k < group.stop
                  and COLUMNS[k] not in _MAY_BE_EMPTY]
    for group in (RAW, BARO, GPS, NAV)
}  # fmt: skip
"""By a group's first column, without which it is not there."""
TIMES: Final = [
    k for k, name in enumerate(COLUMNS) if name.endswith("time_us") and "node" not in name
]
"""Times on the gateway's clock."""
_HEAD: Final = slice(1, len(HEAD_COLUMNS))
NODE_ID, NODE_TIME, FLAGS = (_AT[n] for n in ("node_id", "node_time_us", "imu_flags"))
_FIX_TYPE, FIX_OK = _AT["gps_fix_type"], _AT["gps_fix_ok"]
FIX_LAT, FIX_LON = _AT["gps_lat_dege7"], _AT["gps_lon_dege7"]
NAV_LAT, NAV_LON, NAV_FLAGS = _AT["nav_lat_deg"], _AT["nav_lon_deg"], _AT["nav_flags"]

_OF_NUMBERS: Final = b"0123456789.,-+eE\n"
_COMMA, _NEWLINE = b",\n"
_LEAST_FIXED: Final = 1e-4
"""Smaller ones, and those from the next on, Python writes with an exponent, which JSON's writer
does from other sizes on and in another form."""
_LEAST_LARGE: Final = 1e16


def has_group(cells: FloatArray, group: slice) -> BoolArray:
    """Tell which rows hold a group of columns, such as `RAW`."""
    return ~np.isnan(cells[:, group.start])


def has_position(cells: FloatArray) -> BoolArray:
    """Return which rows hold a state with a valid position."""
    flags = np.nan_to_num(cells[:, NAV_FLAGS]).astype(np.int64)
    return np.asarray((flags & int(NavFlags.POSITION_VALID)) != 0)


def read_lines(text: bytes, width: int) -> FloatArray | None:
    """Read lines of numbers at once.

    Parameters
    ----------
    text : bytes
        Lines, each with its end.
    width : int
        Cells of each line.

    Returns
    -------
    ndarray, shape (n, width), or None
        None if one of the lines is not so many numbers; `read_cells` tells which.
    """
    # JSON's whole zero has no sign, a float's has one.
    if text.translate(None, _OF_NUMBERS) or b"-0," in text or b"-0\n" in text:
        return None
    data = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero((data == _COMMA) | (data == _NEWLINE))
    if len(ends) % width:
        return None
    is_line_end = data[ends].reshape(-1, width) == _NEWLINE
    if not is_line_end[:, -1].all() or is_line_end[:, :-1].any():
        return None
    filled = np.diff(ends, prepend=-1) > 1
    kept = np.ones(len(data), bool)
    kept[ends[~filled]] = False
    packed = data[kept]
    packed[packed == _NEWLINE] = _COMMA
    cells = np.full(len(ends), np.nan)
    try:
        cells[filled] = msgspec.json.decode(b"[%b]" % packed[:-1].tobytes())
    except (ValueError, OverflowError):
        return None
    return cells.reshape(-1, width)


def read_cells(line: bytes, width: int, places: Sequence[int] | None) -> list[float]:
    """Read one line as Python reads numbers.

    Parameters
    ----------
    line : bytes
        Without its end.
    width : int
        Cells that it should have.
    places : sequence of int, optional
        Which of them are wanted; -1 for one that is not there. By default all.

    Raises
    ------
    ValueError
        If it has other cells, or a wanted one is no number.
    """
    texts = line.decode().split(",")
    if len(texts) != width:
        raise ValueError(f"{counted(len(texts), 'cell')} where there should be {width}")
    if places is not None:
        texts = [texts[place] if place >= 0 else "" for place in places]
    return [float(text) if text else np.nan for text in texts]


def settle(cells: FloatArray) -> dict[int, str]:
    """Leave of each row what its groups hold, and tell which rows cannot be.

    Parameters
    ----------
    cells : ndarray, shape (n, len(COLUMNS))
        As read; changed in place: a group without its first cell is empty, what a group may leave
        out has its default.

    Returns
    -------
    dict
        What is wrong, by the number of the row.
    """
    for group in (RAW, SI, MAG, BARO, GPS, NAV):
        cells[np.isnan(cells[:, group.start]), group] = np.nan
    has_raw, has_si = has_group(cells, RAW), has_group(cells, SI)
    cells[~(has_raw | has_si), _HEAD] = np.nan
    cells[~has_raw, NODE_TIME] = np.nan
    for column, rows in ((NODE_ID, has_si & ~has_raw), (FLAGS, has_raw | has_si)):
        cells[rows & np.isnan(cells[:, column]), column] = 0.0
    has_gps = has_group(cells, GPS)
    cells[has_gps, FIX_OK] = cells[has_gps, FIX_OK] == 1.0
    return {row: _fault(cells[row]) for row in np.flatnonzero(_is_bad(cells)).tolist()}


def _is_bad(cells: FloatArray) -> BoolArray:
    whole = cells[:, _WHOLE]
    empty = np.isnan(whole)
    exact = (np.abs(whole) <= LARGEST_WHOLE) & (whole == np.trunc(whole))
    bad = ~(empty | exact).all(axis=1) | np.isnan(cells[:, 0])
    for first, needed in _NEEDED.items():
        there = np.flatnonzero(~np.isnan(cells[:, first]))
        bad[there] |= np.isnan(cells[there][:, needed]).any(axis=1)
    bad |= has_group(cells, RAW) & np.isnan(cells[:, [NODE_ID, NODE_TIME]]).any(axis=1)
    fix_types = cells[:, _FIX_TYPE]
    return np.asarray(bad | (fix_types < 0) | (fix_types > max(GpsFixType)))


def _fault(row: FloatArray) -> str:
    """Say what is wrong with a row that cannot be."""
    for k in _WHOLE.tolist():
        if not np.isnan(row[k]) and not (abs(row[k]) <= LARGEST_WHOLE and row[k] == int(row[k])):
            return f"{COLUMNS[k]}: {row[k]:.17g} is no whole number that can be"
    for first, needed in [(0, [0]), (RAW.start, [NODE_ID, NODE_TIME]), *_NEEDED.items()]:
        for k in needed:
            if np.isnan(row[k]) and (first == 0 or not np.isnan(row[first])):
                return f"{COLUMNS[k]} is empty"
    return f"{COLUMNS[_FIX_TYPE]}: {row[_FIX_TYPE]:.0f} is no type of a fix"


def write_lines(cells: FloatArray, is_whole: BoolArray = IS_WHOLE) -> bytes:
    """Write rows as lines: floats with all their digits, NaN as an empty cell.

    Parameters
    ----------
    cells : ndarray, shape (n, m)
        The numbers.
    is_whole : ndarray of bool, shape (m,)
        Which columns hold whole numbers.

    Returns
    -------
    bytes
        What `row_to_line` gives for each.
    """
    if not len(cells):
        return b""
    columns = map(_texts, cells.T, is_whole.tolist())
    text = msgspec.json.encode([*zip(*columns, strict=True)])
    return text.replace(b"null", b"").replace(b"],[", b"\n")[2:-2] + b"\n"


def _texts(column: FloatArray, is_whole: bool) -> list[object]:
    """Return what JSON's writer gives the digits of a column for."""
    empty = np.isnan(column)
    if empty.all():
        return [None] * len(column)
    if not is_whole:
        # NaN becomes null as None does.
        values: list[object] = column.tolist()
        size = np.abs(column)
        odd = ((size < _LEAST_FIXED) & (size > 0.0)) | (size >= _LEAST_LARGE)
        for k in np.flatnonzero(odd).tolist():
            values[k] = msgspec.Raw(repr(values[k]).encode())
        return values
    whole: NDArray[np.object_] = np.where(empty, 0.0, column).astype(np.int64).astype(object)
    whole[empty] = None
    found: list[object] = whole.tolist()
    return found
