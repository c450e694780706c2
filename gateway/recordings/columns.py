"""Rows of a flight as columns: the one definition of what a recording holds, and its text form.

A row is an IMU sample, the barometer and GPS records that came before it, and the state it led to.
Its records were processed in the order barometer, GPS, IMU. Where they arrived in another order, or
two of a kind between two IMU samples, there are rows without an IMU sample in between, so that the
file keeps every record in order.

A stretch of a table is one array of floats, one row per row and one column for each of `COLUMNS`;
NaN is an empty cell. Whole numbers up to `LARGEST_WHOLE` are exact in it. The digits are those of
Python's own `float` and `repr`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

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
    Vec3,
)
from gateway.units import counted

Cell = int | float | None

# They are the same for many rows.
_node: Final = lru_cache(64)(NodeId)
_imu_flags: Final = lru_cache(256)(ImuFlags)
_nav_flags: Final = lru_cache(256)(NavFlags)

HEAD_COLUMNS: Final = ("time_us", "node_id", "node_time_us", "imu_flags")
RAW_COLUMNS: Final = (
    *("accel_x_raw", "accel_y_raw", "accel_z_raw", "gyro_x_raw", "gyro_y_raw", "gyro_z_raw"),
    *("mag_x_raw", "mag_y_raw", "mag_z_raw", "temperature_raw"),
    *("accel_range_g", "gyro_range_dps", "mag_lsb_per_gauss"),
)
SI_COLUMNS: Final = (
    *("accel_x_b_mps2", "accel_y_b_mps2", "accel_z_b_mps2"),
    *("gyro_x_b_radps", "gyro_y_b_radps", "gyro_z_b_radps"),
    *("mag_x_b_ut", "mag_y_b_ut", "mag_z_b_ut", "temperature_degc"),
)
BARO_COLUMNS: Final = (
    *("baro_time_us", "baro_node_id", "baro_node_time_us"),
    *("baro_pressure_pa", "baro_temperature_degc"),
)
GPS_COLUMNS: Final = (
    *("gps_time_us", "gps_node_id", "gps_node_time_us", "gps_itow_ms"),
    *("gps_fix_type", "gps_fix_ok", "gps_satellites"),
    *("gps_lat_dege7", "gps_lon_dege7", "gps_alt_amsl_m"),
    *("gps_vel_north_mps", "gps_vel_east_mps", "gps_vel_down_mps", "gps_alt_ellipsoid_m"),
    *("gps_h_acc_m", "gps_v_acc_m", "gps_speed_acc_mps", "gps_course_acc_deg", "gps_pdop"),
    "gps_utc_us",
)
NAV_COLUMNS: Final = (
    *("nav_time_us", "nav_q_w", "nav_q_x", "nav_q_y", "nav_q_z"),
    *("nav_rate_x_b_radps", "nav_rate_y_b_radps", "nav_rate_z_b_radps"),
    *("nav_lat_deg", "nav_lon_deg", "nav_alt_amsl_m"),
    *("nav_vel_north_mps", "nav_vel_east_mps", "nav_vel_down_mps"),
    *("nav_attitude_std_north_rad", "nav_attitude_std_east_rad", "nav_attitude_std_down_rad"),
    *("nav_vel_std_north_mps", "nav_vel_std_east_mps", "nav_vel_std_down_mps"),
    *("nav_pos_std_north_m", "nav_pos_std_east_m", "nav_pos_std_down_m", "nav_flags"),
)
COLUMNS: Final = HEAD_COLUMNS + RAW_COLUMNS + SI_COLUMNS + BARO_COLUMNS + GPS_COLUMNS + NAV_COLUMNS


def _columns_of(names: tuple[str, ...]) -> slice:
    first = COLUMNS.index(names[0])
    return slice(first, first + len(names))


RAW: Final = _columns_of(RAW_COLUMNS)
SI: Final = _columns_of(SI_COLUMNS)
MAG: Final = _columns_of(("mag_x_b_ut", "mag_y_b_ut", "mag_z_b_ut"))
BARO: Final = _columns_of(BARO_COLUMNS)
GPS: Final = _columns_of(GPS_COLUMNS)
NAV: Final = _columns_of(NAV_COLUMNS)

WHOLE_COLUMNS: Final = frozenset(
    name
    for name in COLUMNS
    if name in {*HEAD_COLUMNS, *RAW_COLUMNS, "gps_fix_type", "gps_fix_ok", "gps_satellites"}
    or name.endswith(("_us", "_node_id", "_dege7", "_itow_ms", "_flags"))
)
"""Those that hold whole numbers."""

_NO_RAW: Final = (None,) * len(RAW_COLUMNS)
_NO_SI: Final = (None,) * len(SI_COLUMNS)
_NO_BARO: Final = (None,) * len(BARO_COLUMNS)
_NO_GPS: Final = (None,) * len(GPS_COLUMNS)
_NO_NAV: Final = (None,) * len(NAV_COLUMNS)
_NO_VECTOR: Final = (None, None, None)


LARGEST_WHOLE: Final = 1 << 53
"""Up to here every whole number is a float. As a time it is three centuries; a clock that says more
is broken, and other programs round such a number."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row; absent values are None."""

    time_us: int
    """Of the IMU sample, or of the newest record where there is none."""
    baro: BaroRaw | None = None
    gps: GpsFix | None = None
    raw: ImuRaw | None = None
    imu: ImuCalibrated | None = None
    state: NavState | None = None


def row_to_line(row: TableRow) -> str:
    """Write a row as a line: floats with all their digits, NaN and absent as an empty cell."""
    # A cell that differs from itself is NaN.
    return ",".join(["" if c is None or c != c else repr(c) for c in cells_of(row)]) + "\n"


def cells_of(row: TableRow) -> tuple[Cell, ...]:
    """Return a row's values in the order of `COLUMNS`; absent ones are None."""
    return (
        row.time_us,
        *_head_cells(row),
        *(_raw_cells(row.raw) if row.raw else _NO_RAW),
        *(_si_cells(row.imu) if row.imu else _NO_SI),
        *(_baro_cells(row.baro) if row.baro else _NO_BARO),
        *(_gps_cells(row.gps) if row.gps else _NO_GPS),
        *(_nav_cells(row.state) if row.state else _NO_NAV),
    )


def row_of_cells(cells: Sequence[float], vehicle_id: int) -> TableRow:
    """Make a row of the numbers of its cells, in the order of `COLUMNS`."""
    time_us = int(cells[0])
    has_raw, has_si = (not math.isnan(cells[group.start]) for group in (RAW, SI))
    flags = _imu_flags(int(cells[3])) if has_raw or has_si else ImuFlags(0)
    return TableRow(
        time_us=time_us,
        baro=baro_of_cells(cells[BARO], vehicle_id),
        gps=fix_of_cells(cells[GPS], vehicle_id),
        raw=_read_raw(cells, time_us, vehicle_id, flags) if has_raw else None,
        imu=_read_si(cells, time_us, vehicle_id, flags) if has_si else None,
        state=state_of_cells(cells[NAV]),
    )


def check_times(row: TableRow) -> None:
    """Check that all times of a row are possible; raises ValueError if not."""
    for record in (row, row.baro, row.gps, row.state):
        if record is not None and abs(record.time_us) > LARGEST_WHOLE:
            raise ValueError(f"{record.time_us} us is no time of a flight")


Imported = ImuCalibrated | BaroRaw | GpsFix | NavState
"""What the log of another program holds."""


class RowBuilder:
    """Collect the records of one aircraft into rows."""

    def __init__(self) -> None:
        self._baro: BaroRaw | None = None
        self._gps: GpsFix | None = None
        self._state: NavState | None = None

    def add(
        self, record: BaroRaw | GpsFix | FusedSample | ImuCalibrated | NavState
    ) -> list[TableRow]:
        """Take the next record and return the rows that it completes.

        A state without a sample, such as an autopilot's, goes with the next sample.
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
            case ImuCalibrated():
                rows = [self._row(None, record, self._state)]
                self._state = None
            case NavState():
                rows, self._state = [], record
        return rows

    def _row(self, raw: ImuRaw | None, imu: ImuCalibrated, state: NavState | None) -> TableRow:
        row = TableRow(imu.time_us, self._baro, self._gps, raw, imu, state)
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
    """Take from a sample what the table keeps; filtered values can be computed again."""
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


def _head_cells(row: TableRow) -> tuple[Cell, ...]:
    if row.raw:
        return (row.raw.node.node_id, row.raw.node_time_us, int(row.raw.flags))
    if row.imu:
        return (row.imu.node.node_id, None, int(row.imu.flags))
    return (None, None, None)


def _raw_cells(raw: ImuRaw) -> tuple[Cell, ...]:
    return (
        *(*raw.accel_raw, *raw.gyro_raw, *raw.mag_raw, raw.temperature_raw),
        *(raw.accel_range_g, raw.gyro_range_dps, raw.mag_lsb_per_gauss),
    )


def _si_cells(imu: ImuCalibrated) -> tuple[Cell, ...]:
    mag = imu.mag_b_ut or _NO_VECTOR
    return (*imu.accel_b_mps2, *imu.gyro_b_radps, *mag, imu.temperature_degc)


def _baro_cells(baro: BaroRaw) -> tuple[Cell, ...]:
    return (
        *(baro.time_us, baro.node.node_id, baro.node_time_us),
        *(baro.pressure_pa, baro.temperature_degc),
    )


def _gps_cells(fix: GpsFix) -> tuple[Cell, ...]:
    return (
        *(fix.time_us, fix.node.node_id, fix.node_time_us, fix.itow_ms),
        *(int(fix.fix_type), int(fix.fix_ok), fix.satellites),
        *(fix.lat_dege7, fix.lon_dege7, fix.alt_amsl_m, *fix.vel_n_mps, fix.alt_ellipsoid_m),
        *(fix.h_acc_m, fix.v_acc_m, fix.speed_acc_mps, fix.course_acc_deg, fix.pdop),
        fix.utc_us,
    )


def _nav_cells(state: NavState) -> tuple[Cell, ...]:
    return (
        *(state.time_us, *state.q_nb, *state.rate_b_radps),
        *(state.lat_deg, state.lon_deg, state.alt_amsl_m, *state.vel_n_mps),
        *(*state.attitude_std_rad, *state.vel_std_mps, *state.pos_std_m, int(state.flags)),
    )


def _vector(cells: Sequence[float]) -> Vec3:
    x, y, z = cells
    return (x, y, z)


def _read_raw(cells: Sequence[float], time_us: int, vehicle_id: int, flags: ImuFlags) -> ImuRaw:
    ax, ay, az, gx, gy, gz, mx, my, mz, temperature, *ranges = map(int, cells[RAW])
    accel_range_g, gyro_range_dps, mag_lsb_per_gauss = ranges
    return ImuRaw(
        time_us=time_us,
        node=_node(vehicle_id, int(cells[1])),
        node_time_us=int(cells[2]),
        accel_raw=(ax, ay, az),
        gyro_raw=(gx, gy, gz),
        mag_raw=(mx, my, mz),
        temperature_raw=temperature,
        accel_range_g=accel_range_g,
        gyro_range_dps=gyro_range_dps,
        mag_lsb_per_gauss=mag_lsb_per_gauss,
        flags=flags,
    )


def _read_si(
    cells: Sequence[float], time_us: int, vehicle_id: int, flags: ImuFlags
) -> ImuCalibrated:
    si = cells[SI]
    return ImuCalibrated(
        time_us=time_us,
        node=_node(vehicle_id, int(cells[1])),
        accel_b_mps2=_vector(si[0:3]),
        gyro_b_radps=_vector(si[3:6]),
        mag_b_ut=None if math.isnan(si[6]) else _vector(si[6:9]),
        temperature_degc=si[9],
        flags=flags,
    )


def baro_of_cells(cells: Sequence[float], vehicle_id: int) -> BaroRaw | None:
    """Make a payload of the cells of `BARO_COLUMNS`; None where they are empty."""
    if math.isnan(cells[0]):
        return None
    return BaroRaw(
        time_us=int(cells[0]),
        node=_node(vehicle_id, int(cells[1])),
        node_time_us=int(cells[2]),
        pressure_pa=cells[3],
        temperature_degc=cells[4],
    )


def fix_of_cells(cells: Sequence[float], vehicle_id: int) -> GpsFix | None:
    """Make a fix of the cells of `GPS_COLUMNS`; None where they are empty."""
    if math.isnan(cells[0]):
        return None
    return GpsFix(
        time_us=int(cells[0]),
        node=_node(vehicle_id, int(cells[1])),
        node_time_us=int(cells[2]),
        itow_ms=int(cells[3]),
        fix_type=GpsFixType(int(cells[4])),
        fix_ok=cells[5] == 1.0,
        satellites=int(cells[6]),
        lat_dege7=int(cells[7]),
        lon_dege7=int(cells[8]),
        alt_amsl_m=cells[9],
        vel_n_mps=_vector(cells[10:13]),
        alt_ellipsoid_m=cells[13],
        h_acc_m=cells[14],
        v_acc_m=cells[15],
        speed_acc_mps=cells[16],
        course_acc_deg=cells[17],
        pdop=cells[18],
        utc_us=None if math.isnan(cells[19]) else int(cells[19]),
    )


def state_of_cells(cells: Sequence[float]) -> NavState | None:
    """Make a state of the cells of `NAV_COLUMNS`; None where they are empty."""
    if math.isnan(cells[0]):
        return None
    w, x, y, z = cells[1:5]
    return NavState(
        time_us=int(cells[0]),
        q_nb=(w, x, y, z),
        rate_b_radps=_vector(cells[5:8]),
        lat_deg=cells[8],
        lon_deg=cells[9],
        alt_amsl_m=cells[10],
        vel_n_mps=_vector(cells[11:14]),
        attitude_std_rad=_vector(cells[14:17]),
        vel_std_mps=_vector(cells[17:20]),
        pos_std_m=_vector(cells[20:23]),
        flags=_nav_flags(int(cells[23])),
    )


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
    """Read one line as Python reads numbers."""
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
