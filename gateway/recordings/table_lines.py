"""Lines of a table: numbers that are read, checked and written, many at a time.

The digits are those of Python's own `float` and `repr`.
"""

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.recordings.columns import (
    BARO,
    COLUMNS,
    FIX_OK,
    FIX_TYPE,
    FLAGS,
    GPS,
    HEAD_COLUMNS,
    IS_WHOLE,
    LARGEST_WHOLE,
    MAG,
    NAV,
    NEEDED,
    NODE_ID,
    NODE_TIME,
    RAW,
    SI,
    BoolArray,
    FloatArray,
    has_group,
)
from gateway.records import GpsFixType
from gateway.units import counted

_HEAD: Final = slice(1, len(HEAD_COLUMNS))
_OF_NUMBERS: Final = b"0123456789.,-+eE\n"
_COMMA, _NEWLINE = b",\n"
_LEAST_FIXED: Final = 1e-4
"""Python writes smaller numbers, and those from the next constant on, with an exponent; JSON's
writer uses other limits and another form."""
_LEAST_LARGE: Final = 1e16
_WHOLE: Final = np.flatnonzero(IS_WHOLE)


def read_lines(text: bytes, width: int) -> FloatArray | None:
    """Read lines of `width` numbers each; None if any is malformed: `read_cells` finds it."""
    # JSON's integer zero has no sign, a float's has one.
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


def read_cells(line: bytes, width: int, indices: Sequence[int] | None) -> list[float]:
    """Read one line, with Python's own parser of numbers."""
    texts = line.decode().split(",")
    if len(texts) != width:
        raise ValueError(f"{counted(len(texts), 'cell')} where there should be {width}")
    if indices is not None:
        texts = [texts[index] if index >= 0 else "" for index in indices]
    return [float(text) if text else np.nan for text in texts]


def normalise(cells: FloatArray) -> dict[int, str]:
    """Clear cells of absent groups in place; return the invalid rows by number, with the reason."""
    for group in (RAW, SI, MAG, BARO, GPS, NAV):
        cells[np.isnan(cells[:, group.start]), group] = np.nan
    has_raw, has_si = has_group(cells, RAW), has_group(cells, SI)
    cells[~(has_raw | has_si), _HEAD] = np.nan
    cells[~has_raw, NODE_TIME] = np.nan
    for column, rows in ((NODE_ID, has_si & ~has_raw), (FLAGS, has_raw | has_si)):
        cells[rows & np.isnan(cells[:, column]), column] = 0.0
    has_gps = has_group(cells, GPS)
    cells[has_gps, FIX_OK] = cells[has_gps, FIX_OK] == 1.0
    return _faults(cells)


def _faults(cells: FloatArray) -> dict[int, str]:
    """Return the invalid rows by number, with the reason."""
    found: dict[int, str] = {}
    whole, is_empty = cells[:, _WHOLE], np.isnan(cells)
    is_sound = is_empty[:, _WHOLE] | ((np.abs(whole) <= LARGEST_WHOLE) & (whole == np.trunc(whole)))
    for row, k in np.argwhere(~is_sound).tolist():
        text = f"{COLUMNS[_WHOLE[k]]}: {whole[row, k]:.17g} is not a valid integer"
        found.setdefault(row, text)
    for first, needed in NEEDED:
        is_there = ~is_empty[:, [first]] if first else True
        for row, k in np.argwhere(is_empty[:, needed] & is_there).tolist():
            found.setdefault(row, f"{COLUMNS[needed[k]]} is empty")
    fix_types = cells[:, FIX_TYPE]
    for row in np.flatnonzero((fix_types < 0) | (fix_types > max(GpsFixType))).tolist():
        found.setdefault(row, f"{COLUMNS[FIX_TYPE]}: {fix_types[row]:.0f} is not a type of fix")
    return found


def write_lines(cells: FloatArray, is_whole: BoolArray = IS_WHOLE) -> bytes:
    """Write rows as lines: floats with all their digits, NaN as an empty cell."""
    if not len(cells):
        return b""
    columns = map(_texts, cells.T, is_whole.tolist())
    text = msgspec.json.encode([*zip(*columns, strict=True)])
    return text.replace(b"null", b"").replace(b"],[", b"\n")[2:-2] + b"\n"


def _texts(column: FloatArray, is_whole: bool) -> list[object]:
    """Return the values of a column in a type that JSON's writer gives the right digits."""
    empty = np.isnan(column)
    if empty.all():
        return [None] * len(column)
    if not is_whole:
        # The writer makes null of NaN as of None.
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
