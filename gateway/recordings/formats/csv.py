"""Read CSV files of other programs as rows, with a map of their columns."""

import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from itertools import chain, islice, pairwise
from typing import Annotated, Any, Final

import numpy as np
from msgspec.structs import replace

from gateway.geometry.atmosphere import pressure_at_height
from gateway.recordings.columns import BARO, COLUMNS, GPS, MAG, NAV, RAW, SI, FloatArray
from gateway.recordings.recorded_clock import BACK_US, HOUR_S, DayClock, is_damaged
from gateway.recordings.table import BLOCK_ROWS, NO_ROWS, TableBlock
from gateway.recordings.table_lines import normalise
from gateway.records import NAN, GpsFixType, ImuFlags
from gateway.settings import Settings, setting
from gateway.units import US_PER_S

EXTRA_FIELDS: Final = ("baro_alt_m", "gps_speed_mps", "gps_course_deg")
"""Names that may be mapped in addition to the columns of the table: heights are converted to
pressures, speed and course to a velocity if none is given."""
VECTORS: Final = tuple(
    frozenset(f"{quantity}_{axis}_b_{unit}" for axis in "xyz")
    for quantity, unit in (("accel", "mps2"), ("gyro", "radps"), ("mag", "ut"))
)
"""Groups of axes of which all or none must be present."""
NEEDED: Final = frozenset({"time_us"}).union(*VECTORS[:2])
"""Columns without which fusion is not possible."""
DELIMITERS: Final = {",": "commas", ";": "semicolons", "\t": "tabs"}
MAX_HEAD_LINES: Final = 1000
"""Lines that are searched for the names of the columns."""
MAX_SHOWN: Final = 200
"""Characters of found names that are quoted in an error."""
EMPTY: Final = frozenset({"-", "--", "?", "null", "nil", "none", "n/a", "#n/a", "na"})
"""Cells without a value, lower case, in addition to empty ones and NaN."""
CLOCK: Final = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d*)?)")
"""Pattern of a time of day."""
MINUTE_S: Final = 60
EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
MAX_CELL: Final = 40
"""Characters of an unreadable cell that are quoted in a message."""
MAX_LISTED: Final = 20
"""Maximum number of unknown columns that are listed."""
_GROUPS_NEED: Final = [
    (group, [COLUMNS.index(name) for name in names])
    for group, names in (
        (SI, NEEDED - {"time_us"}),
        (MAG, VECTORS[2]),
        (BARO, ("baro_pressure_pa",)),
        (GPS, ("gps_lat_dege7", "gps_lon_dege7")),
    )
]
"""Columns that a record requires, by the group of its columns."""


class Column(Settings, frozen=True):
    """One column of a file: value = column * scale + offset."""

    column: Annotated[str, setting("Name of the column.")]
    scale: Annotated[float, setting("Factor to our unit.")] = 1.0
    offset: Annotated[float, setting("Added after that.")] = 0.0


class ColumnMap(Settings, frozen=True):
    """Maps columns of another program's file to our names."""

    columns: Annotated[
        dict[str, Column | str],
        setting("The file's column, with scale and offset where they are needed, by our name."),
    ]

    def __post_init__(self) -> None:
        """Reject a map to an unknown column."""
        unknown = sorted(set(self.columns) - set(COLUMNS) - set(EXTRA_FIELDS))
        if unknown:
            raise ValueError(f"unknown column names: {', '.join(unknown[:MAX_LISTED])}")
        if "time_us" not in self.columns:
            raise ValueError("time_us must be mapped")
        if absent := _begun(self.columns) - self.columns.keys():
            raise ValueError(
                f"the other axes of a vector must be mapped too: {', '.join(sorted(absent))}"
            )


class CsvReader:
    """Convert the lines of another program's CSV to rows."""

    def __init__(self, column_map: ColumnMap, *, lenient: bool = False) -> None:
        self._columns = {
            name: Column(column=column.strip())
            if isinstance(column, str)
            else replace(column, column=column.column.strip())
            for name, column in column_map.columns.items()
        }
        self._lenient = lenient
        self.unix_us_at_zero: int | None = None
        """Civil time of the rows' time zero, if their times have dates."""
        self.skipped = 0
        """Number of lines of text before the column names."""
        self.faults = 0
        """Number of lines that could not be read, or whose time is not between its neighbours."""
        self.odd_cells = 0
        """Number of unreadable cells in other lines."""
        self.first_fault = ""
        """The first of these faults: line, column and text."""
        self._has_decimal_comma = False
        self._clock = DayClock()

    def blocks(self, lines: Iterable[str]) -> Iterator[TableBlock]:
        """Read a whole file; raises ValueError if it lacks needed columns."""
        # Skipped lines become empty, so that line numbers stay those of the file.
        kept = ("" if line.startswith("#") else line for line in lines)
        head = [*islice(kept, MAX_HEAD_LINES)]
        delimiter, names, begin = self._find_names(head)
        self.skipped = sum(map(bool, head[: begin - 1]))
        self._has_decimal_comma = delimiter != ","
        table = csv.reader(chain(head[begin:], kept), delimiter=delimiter)
        values, held = self._values(table, names, begin), NO_ROWS
        before_us: float | None = None
        while lines_of_block := [*islice(values, BLOCK_ROWS)]:
            numbers, rows = zip(*lines_of_block, strict=True)
            cells = _cells(dict(zip(self._columns, np.array(rows).T, strict=True)))
            invalid = self._invalid(cells, numbers)
            cells = np.concatenate([held, np.delete(cells, invalid, axis=0)])
            sound = []
            for row, (time_us, after_us) in enumerate(pairwise(cells[:, 0].tolist())):
                if before_us is not None and is_damaged(before_us, time_us, after_us):
                    self.faults += 1
                    continue
                sound.append(row)
                before_us = time_us
            held = cells[-1:]
            yield TableBlock(cells[sound])
        yield TableBlock(held)

    def _values(
        self, table: Any, names: Sequence[str], begin: int
    ) -> Iterator[tuple[int, list[float]]]:
        """Yield the line number and the mapped values of each line; NaN is an empty cell."""
        at = {name: number for number, name in enumerate(names)}
        wanted = [(at[c.column], c.scale, c.offset) for c in self._columns.values()]
        while True:
            try:
                line = next(table)
            except StopIteration:
                return
            except csv.Error as error:
                self._add_fault(begin + table.line_num, str(error))
                continue
            if not line:
                continue
            texts = [line[k].strip() if k < len(line) else "" for k, _, _ in wanted]
            if self._has_decimal_comma:
                texts = [text.replace(",", ".") for text in texts]
            try:
                values = [
                    float(text) * scale + offset if text else NAN
                    for text, (_, scale, offset) in zip(texts, wanted, strict=True)
                ]
            except ValueError:
                found = self._odd_values(texts, begin + table.line_num)
                if found is None:
                    continue
                values = found
            yield begin + table.line_num, values

    def _odd_values(self, texts: Sequence[str], number: int) -> list[float] | None:
        """Read a line with cells that are not plain numbers; None if it has no time."""
        values = []
        for (ours, column), text in zip(self._columns.items(), texts, strict=True):
            value = self._value(ours, column, text)
            if value is None:
                why = f"{column.column} is {text[:MAX_CELL]!r}, which is not a number"
                if ours == "time_us":
                    self._add_fault(number, why)
                    return None
                self.first_fault = self.first_fault or f"line {number}: {why}"
                self.odd_cells += 1
                value = NAN
            values.append(value)
        return values

    def _value(self, ours: str, column: Column, text: str) -> float | None:
        """Read one cell; NaN if it is empty, None if it cannot be read."""
        if not text or text.casefold() in EMPTY:
            return NAN
        if ours.endswith("time_us") or ours == "gps_utc_us":
            time_us = self._time_us(ours, text)
            if time_us is not None:
                return time_us
        with suppress(ValueError):
            return float(text) * column.scale + column.offset
        # A quoted cell with a decimal comma.
        if "," not in text or "." in text:
            return None
        with suppress(ValueError):
            value = float(text.replace(",", ".")) * column.scale + column.offset
            self._has_decimal_comma = True
            return value
        return None

    def _time_us(self, ours: str, text: str) -> float | None:
        """Read a time of day, or a date and time in ISO 8601; UTC if it has no zone."""
        if clock := CLOCK.fullmatch(text):
            hours, minutes, seconds = (float(part.replace(",", ".")) for part in clock.groups())
            of_day_s = hours * HOUR_S + minutes * MINUTE_S + seconds
            if ours == "time_us":
                self._clock.update(of_day_s)
            return (self._clock.day_s + of_day_s) * US_PER_S
        try:
            date = datetime.fromisoformat(text.replace("/", "-").replace(",", "."))
        except ValueError:
            return None
        civil = date if date.tzinfo else date.replace(tzinfo=UTC)
        unix_us = (civil - EPOCH) // timedelta(microseconds=1)
        if ours == "gps_utc_us":
            return unix_us
        if ours == "time_us" and self.unix_us_at_zero is None:
            self.unix_us_at_zero = unix_us
        return NAN if self.unix_us_at_zero is None else unix_us - self.unix_us_at_zero

    def _invalid(self, cells: FloatArray, numbers: Sequence[int]) -> list[int]:
        """Return the invalid rows; an invalid fix or pressure is cleared, and its row kept."""
        for row, why in normalise(cells).items():
            group = {"gps": GPS, "baro": BARO}.get(why.partition("_")[0])
            if group is not None:
                self.first_fault = self.first_fault or f"line {numbers[row]}: {why}"
                self.odd_cells += 1
                cells[row, group] = NAN
        faults = normalise(cells)
        for row, why in faults.items():
            self._add_fault(numbers[row], why)
        return [*faults]

    def _add_fault(self, number: int, why: str) -> None:
        self.faults += 1
        self.first_fault = self.first_fault or f"line {number}: {why}"

    def _find_names(self, head: Sequence[str]) -> tuple[str, list[str], int]:
        best: tuple[int, int, str, list[str]] | None = None
        for number, line in enumerate(head):
            for delimiter in DELIMITERS if line.strip() else ():
                names = _cells_of(line, delimiter)
                found = self._found(names)
                if not self._absent(found):
                    self._columns = found
                    return delimiter, names, number + 1
                if best is None or (len(found), len(names)) > best[:2]:
                    best = (len(found), len(names), delimiter, names)
        if best is None:
            raise ValueError("the file has no line of column names")
        _, _, delimiter, names = best
        missing = sorted(self._columns[ours].column for ours in self._absent(self._found(names)))
        raise ValueError(
            f"the file has no column {', '.join(missing)}; found, separated by "
            f"{DELIMITERS[delimiter]}: {', '.join(names)[:MAX_SHOWN]}"
        )

    def _found(self, names: Sequence[str]) -> dict[str, Column]:
        there = set(names)
        return {ours: c for ours, c in self._columns.items() if c.column in there}

    def _absent(self, found: Mapping[str, Column]) -> set[str]:
        absent = self._columns.keys() - found.keys()
        return absent & (NEEDED | _begun(found)) if self._lenient else absent


def _cells(values: dict[str, FloatArray]) -> FloatArray:
    """Arrange mapped values of some lines as rows of the table."""
    time_us = np.rint(values["time_us"])
    cells = np.full((len(time_us), len(COLUMNS)), NAN)

    def get(name: str, default: float | FloatArray = NAN) -> FloatArray:
        found = values.get(name, cells[:, -1])
        return np.where(np.isnan(found), default, found)

    has_field = np.isfinite(sum(get(f"mag_{axis}_b_ut") for axis in "xyz"))
    new_flags = np.where(has_field, float(ImuFlags.MAG_NEW), 0.0)
    by_height_pa = np.array([*map(pressure_at_height, get("baro_alt_m").tolist())])
    north_mps, east_mps = get("gps_vel_north_mps"), get("gps_vel_east_mps")
    level = level_velocity(get("gps_speed_mps"), get("gps_course_deg"))
    is_known = np.isfinite(north_mps) & np.isfinite(east_mps)
    filled = {
        "time_us": time_us, "node_id": 0.0, "imu_flags": np.trunc(get("imu_flags", new_flags)),
        "baro_time_us": _measured_us(get("baro_time_us"), time_us),
        "baro_node_id": 0.0, "baro_node_time_us": time_us,
        "baro_pressure_pa": get("baro_pressure_pa", by_height_pa),
        "gps_time_us": _measured_us(get("gps_time_us"), time_us),
        "gps_node_id": 1.0, "gps_node_time_us": time_us,
        "gps_itow_ms": np.rint(get("gps_itow_ms", 0.0)),
        "gps_fix_type": np.trunc(get("gps_fix_type", float(GpsFixType.FIX_3D))),
        "gps_fix_ok": get("gps_fix_ok", 1.0) != 0.0,
        "gps_satellites": np.trunc(get("gps_satellites", 0.0)),
        "gps_lat_dege7": np.rint(get("gps_lat_dege7")),
        "gps_lon_dege7": np.rint(get("gps_lon_dege7")),
        "gps_vel_north_mps": np.where(is_known, north_mps, level[0]),
        "gps_vel_east_mps": np.where(is_known, east_mps, level[1]),
        "gps_utc_us": np.rint(get("gps_utc_us")),
    }  # fmt: skip
    for name, value in (values | filled).items():
        if name not in EXTRA_FIELDS:
            cells[:, COLUMNS.index(name)] = value
    cells[:, RAW] = cells[:, NAV] = NAN
    for group, needed in _GROUPS_NEED:
        cells[np.isnan(cells[:, needed]).any(axis=1), group] = NAN
    return cells


def _cells_of(line: str, delimiter: str) -> list[str]:
    """Split a line into cells; empty if it is not CSV."""
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _begun(names: Iterable[str]) -> frozenset[str]:
    """Return all axes of each vector that has at least one axis among the names."""
    return frozenset[str]().union(*(axes for axes in VECTORS if not axes.isdisjoint(names)))


def _measured_us(own_us: FloatArray, row_us: FloatArray) -> FloatArray:
    """Return the times of measurement; the time of the row if that is on another clock."""
    return np.where(np.abs(own_us - row_us) <= BACK_US, np.rint(own_us), row_us)


def level_velocity(speed_mps: FloatArray, course_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return north and east velocity from speed and course over ground."""
    # Not NumPy's sine: its last digit differs between processors.
    course_rad = [*map(math.radians, np.where(np.isfinite(course_deg), course_deg, NAN).tolist())]
    north, east = [*map(math.cos, course_rad)], [*map(math.sin, course_rad)]
    return speed_mps * np.array(north), speed_mps * np.array(east)
