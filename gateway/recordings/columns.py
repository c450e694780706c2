"""Rows of a flight as columns: the definition of a recording's content and of its text form.

A row is an IMU sample, the barometer and GPS records that arrived before it, and the resulting
state. Records of a row were processed in the order barometer, GPS, IMU. Where they arrived in
another order, or two of a kind arrived between two IMU samples, rows without an IMU sample are
inserted, so that the file keeps the order of all records.

A block of a table is one array of floats, one row per row and one column for each of `COLUMNS`;
NaN is an empty cell. Integers up to `LARGEST_WHOLE` are exact. The digits are those of Python's
own `float` and `repr`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Generic, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.records import (
    BaroRaw,
    FusedSample,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    ImuRaw,
    NavFlags,
    NavState,
    NodeId,
)
from gateway.units import counted

Cell = int | float | None

# Cached: most rows have the same node.
_node: Final = lru_cache(64)(NodeId)
_imu_flags: Final = lru_cache(256)(ImuFlags)
_nav_flags: Final = lru_cache(256)(NavFlags)

XYZ, NED = ("x", "y", "z"), ("north", "east", "down")
NO_VECTOR: Final = (None, None, None)

# By kind: whether its cells are integers, whether it may be empty, the expression that writes a
# record `r`, and the expression that reads it from the cells `c`.
_KINDS: Final = {
    "whole": (True, False, "r.{a}", "int({c})"),
    "maybe": (True, True, "r.{a}", "None if isnan({c}) else int({c})"),
    "real": (False, False, "r.{a}", "{c}"),
    "flag": (True, False, "int(r.{a})", "{c} == 1.0"),
    "node": (True, False, "r.{a}.node_id", "_node(vehicle_id, int({c}))"),
    "fix type": (True, False, "int(r.{a})", "GpsFixType(int({c}))"),
    "flags": (True, False, "int(r.{a})", "_nav_flags(int({c}))"),
    "counts": (True, False, "*r.{a}", "({all_int})"),
    "vector": (False, False, "*r.{a}", "({all})"),
    "maybe vector": (False, True, "*(r.{a} or NO_VECTOR)", "None if isnan({c}) else ({all})"),
}

Read = TypeVar("Read")
HEAD_COLUMNS: Final = ("time_us", "node_id", "node_time_us", "imu_flags")
"""Columns that the raw counts and the calibrated values of a sample share."""
UNITS: Final = {
    "_mps2": "m/s^2", "_mps": "m/s", "_radps": "rad/s", "_rad": "rad", "_ut": "uT",
    "_degc": "degC", "_deg": "deg", "_dege7": "1e-7 deg", "_us": "us", "_ms": "ms", "_pa": "Pa",
    "_m": "m", "_raw": "counts", "_range_g": "g", "_dps": "deg/s", "_per_gauss": "counts/gauss",
}  # fmt: skip
"""Unit of a column, by the suffix of its name."""
LARGEST_WHOLE: Final = 1 << 53
"""Largest integer up to which all are exact as floats: three centuries in µs. Greater values are
invalid, and other programs would round them."""
Imported = ImuCalibrated | BaroRaw | GpsFix | NavState
"""Records that can be read from another program's log."""
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
_HEAD: Final = slice(1, len(HEAD_COLUMNS))
_OF_NUMBERS: Final = b"0123456789.,-+eE\n"
_COMMA, _NEWLINE = b",\n"
_LEAST_FIXED: Final = 1e-4
"""Python writes smaller numbers, and those from the next constant on, with an exponent; JSON's
writer uses other limits and another form."""
_LEAST_LARGE: Final = 1e16


class Codec(Generic[Read]):
    """The columns of one type of record, and the functions that write and read them.

    Each field is given as a kind of `_KINDS`, the attribute, and the columns (a pattern and
    its parts) if their names differ from the attribute's.
    """

    def __init__(self, record: type[Read], prefix: str, *fields: tuple[Any, ...]) -> None:
        self.columns: tuple[str, ...] = ()
        self.whole: tuple[str, ...] = ()
        self.truths: tuple[str, ...] = ()
        self.needed: tuple[str, ...] = ()
        self.patterns: list[str] = []
        """The columns of each field as one pattern, such as `accel_{x,y,z}_raw`."""
        written, read = [], []
        for kind, attribute, *named in fields:
            is_whole, may_be_empty, write, get = _KINDS[kind]
            pattern, parts = (*named, ("",))[:2] if named else (attribute, ("",))
            names = tuple(prefix + pattern.format(part) for part in parts)
            cells = [f"c[{len(self.columns) + k}]" for k in range(len(names))]
            every, as_int = ", ".join(cells), ", ".join(f"int({cell})" for cell in cells)
            written.append(write.format(a=attribute))
            got = get.format(c=cells[0], all=every, all_int=as_int)
            read.append(f"{attribute}={got}")
            self.columns += names
            self.whole += names if is_whole else ()
            self.truths += names if kind == "flag" else ()
            self.needed += names if is_whole and not may_be_empty else ()
            self.patterns.append(prefix + pattern.replace("{}", f"{{{','.join(parts)}}}"))
        self.empty = (None,) * len(self.columns)
        scope = globals() | {"isnan": math.isnan, "record": record}
        # Generated code, as in dataclasses: a loop over the fields would take three times as long.
        self.write: Callable[[Read], tuple[Cell, ...]] = eval(
            f"lambda r: ({', '.join(written)},)", scope
        )
        """Return a record's cells."""
        self.read: Callable[..., Read] = eval(
            f"lambda c, vehicle_id=0, **known: record({', '.join(read)}, **known)", scope
        )
        """Make a record from its cells; the first must not be NaN."""


RAW_CODEC: Final = Codec(
    ImuRaw,
    "",
    ("counts", "accel_raw", "accel_{}_raw", XYZ),
    ("counts", "gyro_raw", "gyro_{}_raw", XYZ),
    ("counts", "mag_raw", "mag_{}_raw", XYZ),
    ("whole", "temperature_raw"),
    ("whole", "accel_range_g"),
    ("whole", "gyro_range_dps"),
    ("whole", "mag_lsb_per_gauss"),
)
SI_CODEC: Final = Codec(
    ImuCalibrated,
    "",
    ("vector", "accel_b_mps2", "accel_{}_b_mps2", XYZ),
    ("vector", "gyro_b_radps", "gyro_{}_b_radps", XYZ),
    ("maybe vector", "mag_b_ut", "mag_{}_b_ut", XYZ),
    ("real", "temperature_degc"),
)
BARO_CODEC: Final = Codec(
    BaroRaw,
    "baro_",
    ("whole", "time_us"),
    ("node", "node", "node_id"),
    ("whole", "node_time_us"),
    ("real", "pressure_pa"),
    ("real", "temperature_degc"),
)
GPS_CODEC: Final = Codec(
    GpsFix,
    "gps_",
    ("whole", "time_us"),
    ("node", "node", "node_id"),
    ("whole", "node_time_us"),
    ("whole", "itow_ms"),
    ("fix type", "fix_type"),
    ("flag", "fix_ok"),
    ("whole", "satellites"),
    ("whole", "lat_dege7"),
    ("whole", "lon_dege7"),
    ("real", "alt_amsl_m"),
    ("vector", "vel_n_mps", "vel_{}_mps", NED),
    ("real", "alt_ellipsoid_m"),
    ("real", "h_acc_m"),
    ("real", "v_acc_m"),
    ("real", "speed_acc_mps"),
    ("real", "course_acc_deg"),
    ("real", "pdop"),
    ("maybe", "utc_us"),
)
NAV_CODEC: Final = Codec(
    NavState,
    "nav_",
    ("whole", "time_us"),
    ("vector", "q_nb", "q_{}", ("w", "x", "y", "z")),
    ("vector", "rate_b_radps", "rate_{}_b_radps", XYZ),
    ("real", "lat_deg"),
    ("real", "lon_deg"),
    ("real", "alt_amsl_m"),
    ("vector", "vel_n_mps", "vel_{}_mps", NED),
    ("vector", "attitude_std_rad", "attitude_std_{}_rad", NED),
    ("vector", "vel_std_mps", "vel_std_{}_mps", NED),
    ("vector", "pos_std_m", "pos_std_{}_m", NED),
    ("flags", "flags"),
)

_GROUPS: Final = (RAW_CODEC, SI_CODEC, BARO_CODEC, GPS_CODEC, NAV_CODEC)
COLUMNS: Final[tuple[str, ...]] = (
    *HEAD_COLUMNS,
    *(name for group in _GROUPS for name in group.columns),
)
NAV_COLUMNS: Final = NAV_CODEC.columns
WHOLE_COLUMNS: Final = frozenset((*HEAD_COLUMNS, *(n for group in _GROUPS for n in group.whole)))
"""Columns of integers."""
TRUTHS: Final = frozenset(name for group in _GROUPS for name in group.truths)
"""Integer columns that are 1 or 0: true or false."""


def unit_of(name: str) -> str:
    """Return the unit of a column; empty for a dimensionless number."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def span_of(*names: str) -> slice:
    """Return the slice of adjacent columns in a row."""
    first = COLUMNS.index(names[0])
    return slice(first, first + len(names))


RAW, SI, BARO, GPS, NAV = (span_of(*group.columns) for group in _GROUPS)
MAG: Final = span_of("mag_x_b_ut", "mag_y_b_ut", "mag_z_b_ut")


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row; absent values are None."""

    time_us: int
    """Time of the IMU sample, or of the newest record if there is no sample."""
    baro: BaroRaw | None = None
    gps: GpsFix | None = None
    raw: ImuRaw | None = None
    imu: ImuCalibrated | None = None
    state: NavState | None = None


def row_to_line(row: TableRow) -> str:
    """Write a row as a line: floats with all their digits, NaN and absent values as empty cells."""
    # Only NaN differs from itself.
    return ",".join(["" if c is None or c != c else repr(c) for c in cells_of(row)]) + "\n"


def cells_of(row: TableRow) -> tuple[Cell, ...]:
    """Return a row's values in the order of `COLUMNS`; None for absent ones."""
    imu = row.raw or row.imu
    node_time_us = row.raw.node_time_us if row.raw else None
    return (
        row.time_us,
        *((imu.node.node_id, node_time_us, int(imu.flags)) if imu else NO_VECTOR),
        *(RAW_CODEC.write(row.raw) if row.raw else RAW_CODEC.empty),
        *(SI_CODEC.write(row.imu) if row.imu else SI_CODEC.empty),
        *(BARO_CODEC.write(row.baro) if row.baro else BARO_CODEC.empty),
        *(GPS_CODEC.write(row.gps) if row.gps else GPS_CODEC.empty),
        *(NAV_CODEC.write(row.state) if row.state else NAV_CODEC.empty),
    )


def row_of_cells(cells: Sequence[float], vehicle_id: int) -> TableRow:
    """Make a row from the numbers of its cells, in the order of `COLUMNS`."""
    time_us = int(cells[0])
    has_raw, has_si, has_baro, has_gps, has_nav = (
        not math.isnan(cells[group.start]) for group in (RAW, SI, BARO, GPS, NAV)
    )
    head: dict[str, Any] = {}
    if has_raw or has_si:
        node, flags = _node(vehicle_id, int(cells[1])), _imu_flags(int(cells[3]))
        head = {"time_us": time_us, "node": node, "flags": flags}
    return TableRow(
        time_us=time_us,
        baro=BARO_CODEC.read(cells[BARO], vehicle_id) if has_baro else None,
        gps=GPS_CODEC.read(cells[GPS], vehicle_id) if has_gps else None,
        raw=RAW_CODEC.read(cells[RAW], node_time_us=int(cells[2]), **head) if has_raw else None,
        imu=SI_CODEC.read(cells[SI], **head) if has_si else None,
        state=NAV_CODEC.read(cells[NAV]) if has_nav else None,
    )


class RowBuilder:
    """Collect the records of one aircraft into rows."""

    def __init__(self) -> None:
        self._baro: BaroRaw | None = None
        self._gps: GpsFix | None = None
        self._state: NavState | None = None

    def add(
        self, record: BaroRaw | GpsFix | FusedSample | ImuRaw | ImuCalibrated | NavState
    ) -> list[TableRow]:
        """Process the next record and return the rows that it completes.

        A state without a sample, such as an autopilot's, is stored with the next sample.
        """
        match record:
            case BaroRaw():
                rows = self.flush() if self._baro or self._gps else []
                self._baro = record
            case GpsFix():
                rows = self.flush() if self._gps else []
                self._gps = record
            case FusedSample():
                rows = [self._row(record.imu, _calibrated(record), record.state)]
            case ImuRaw():
                rows = [self._row(record, None, None)]
            case ImuCalibrated():
                rows = [self._row(None, record, self._state)]
                self._state = None
            case NavState():
                rows, self._state = [], record
        return rows

    def _row(
        self, raw: ImuRaw | None, imu: ImuCalibrated | None, state: NavState | None
    ) -> TableRow:
        newest = raw or imu
        assert newest is not None
        row = TableRow(newest.time_us, self._baro, self._gps, raw, imu, state)
        self._baro = self._gps = None
        return row

    def flush(self) -> list[TableRow]:
        """Return the waiting records as a row without an IMU sample."""
        newest = self._gps or self._baro
        if newest is None:
            return []
        row = TableRow(newest.time_us, self._baro, self._gps)
        self._baro = self._gps = None
        return [row]


def _calibrated(fused: FusedSample) -> ImuCalibrated:
    sample = fused.sample
    return ImuCalibrated(
        sample.time_us,
        fused.imu.node if fused.imu else NodeId(fused.vehicle_id, 0),
        sample.accel_b_mps2,
        sample.gyro_b_radps,
        sample.mag_b_ut,
        sample.temperature_degc,
        fused.imu.flags if fused.imu else sample.flags,
    )


IS_WHOLE: Final = np.array([name in WHOLE_COLUMNS for name in COLUMNS])
_WHOLE: Final = np.flatnonzero(IS_WHOLE)
_AT: Final = {name: index for index, name in enumerate(COLUMNS)}
_NEEDED: Final = [
    (0, [0]),
    (RAW.start, [_AT["node_id"], _AT["node_time_us"]]),
    *(
        (_AT[group.columns[0]], [_AT[name] for name in group.needed])
        for group in (RAW_CODEC, BARO_CODEC, GPS_CODEC, NAV_CODEC)
    ),
]
"""First column of a group, and the columns that it requires; every row requires its time."""
TIMES: Final = [
    k for k, name in enumerate(COLUMNS) if name.endswith("time_us") and "node" not in name
]
"""Columns with times on the gateway's clock, by index."""
NODE_ID, NODE_TIME, FLAGS = (_AT[n] for n in ("node_id", "node_time_us", "imu_flags"))
FIX_TYPE, FIX_OK = _AT["gps_fix_type"], _AT["gps_fix_ok"]
FIX_LAT, FIX_LON, FIX_ALT = (_AT[f"gps_{n}"] for n in ("lat_dege7", "lon_dege7", "alt_amsl_m"))
NAV_LAT, NAV_LON, NAV_FLAGS = _AT["nav_lat_deg"], _AT["nav_lon_deg"], _AT["nav_flags"]


def has_group(cells: FloatArray, group: slice) -> BoolArray:
    """Return which rows contain a group of columns, such as `RAW`."""
    return ~np.isnan(cells[:, group.start])


def has_position(cells: FloatArray) -> BoolArray:
    """Return which rows contain a state with a valid position."""
    flags = np.nan_to_num(cells[:, NAV_FLAGS]).astype(np.int64)
    return np.asarray((flags & int(NavFlags.POSITION_VALID)) != 0)


def has_fix(cells: FloatArray) -> BoolArray:
    """Return which rows contain a GPS fix; receivers send 0, 0 before the first one."""
    is_somewhere = (cells[:, FIX_LAT] != 0.0) | (cells[:, FIX_LON] != 0.0)
    return np.asarray((cells[:, FIX_OK] == 1.0) & is_somewhere)


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
    for first, needed in _NEEDED:
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
