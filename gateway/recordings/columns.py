"""Columns of a flight: the definition of a recording's content.

A block of a table is one array of floats, one row per row and one column for each of `COLUMNS`;
NaN is an empty cell. Integers up to `LARGEST_WHOLE` are exact. See `rows` for the order of records,
and `table_lines` for the text.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from gateway.records import (
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuRaw,
    NavFlags,
    NavState,
    NodeId,
)

Cell = int | float | None

# Cached: most rows have the same node.
_node: Final = lru_cache(64)(NodeId)
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
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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
        scope = {"record": record, "isnan": math.isnan, "GpsFixType": GpsFixType, "_node": _node}
        scope |= {"_nav_flags": _nav_flags, "NO_VECTOR": NO_VECTOR}
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
IS_WHOLE: Final = np.array([name in WHOLE_COLUMNS for name in COLUMNS])
AT: Final = {name: index for index, name in enumerate(COLUMNS)}
NEEDED: Final = [
    (0, [0]),
    (RAW.start, [AT["node_id"], AT["node_time_us"]]),
    *(
        (AT[group.columns[0]], [AT[name] for name in group.needed])
        for group in (RAW_CODEC, BARO_CODEC, GPS_CODEC, NAV_CODEC)
    ),
]
"""First column of a group, and the columns that it requires; every row requires its time."""
TIMES: Final = [
    k for k, name in enumerate(COLUMNS) if name.endswith("time_us") and "node" not in name
]
"""Columns with times on the gateway's clock, by index."""
NODE_ID, NODE_TIME, FLAGS = (AT[n] for n in ("node_id", "node_time_us", "imu_flags"))
FIX_TYPE, FIX_OK = AT["gps_fix_type"], AT["gps_fix_ok"]
FIX_LAT, FIX_LON, FIX_ALT = (AT[f"gps_{n}"] for n in ("lat_dege7", "lon_dege7", "alt_amsl_m"))
NAV_LAT, NAV_LON, NAV_FLAGS = (AT[f"nav_{n}"] for n in ("lat_deg", "lon_deg", "flags"))


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
