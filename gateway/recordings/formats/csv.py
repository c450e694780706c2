"""CSV files of other programs as rows, by a map of their columns."""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice, pairwise
from typing import Annotated, Final

import numpy as np
from msgspec.structs import replace

from gateway.geometry.atmosphere import pressure_at_height
from gateway.recordings.columns import BARO, COLUMNS, GPS, NAV, RAW, SI, FloatArray, normalise
from gateway.recordings.table import BLOCK_ROWS, NO_ROWS, TableBlock
from gateway.recordings.tlog import is_damaged
from gateway.records import NAN, GpsFixType, ImuFlags
from gateway.settings import Settings, setting
from gateway.units import US_PER_S

EXTRA_FIELDS: Final = ("baro_alt_m", "gps_speed_mps", "gps_course_deg")
"""May be mapped though the table has no such columns: heights become pressures, speed and course
the velocity where it is not given."""
VECTORS: Final = tuple(
    frozenset(f"{quantity}_{axis}_b_{unit}" for axis in "xyz")
    for quantity, unit in (("accel", "mps2"), ("gyro", "radps"), ("mag", "ut"))
)
"""Of each all axes are needed, or none."""
NEEDED: Final = frozenset({"time_us"}).union(*VECTORS[:2])
"""Without these there is nothing to fuse."""
DELIMITERS: Final = {",": "commas", ";": "semicolons", "\t": "tabs"}
MAX_HEAD_LINES: Final = 200
"""The names of the columns are looked for in so many lines."""
MAX_SHOWN: Final = 200
"""Characters of the found names in an error."""
LATE_US: Final = 60 * US_PER_S
"""A value measured this long before or after its line has a damaged time, or another clock's."""


class Column(Settings, frozen=True):
    """One column of a file: value = column * scale + offset."""

    column: Annotated[str, setting("Name of the column.")]
    scale: Annotated[float, setting("Factor to our unit.")] = 1.0
    offset: Annotated[float, setting("Added after that.")] = 0.0


class ColumnMap(Settings, frozen=True):
    """Columns of another program's file by the names of ours."""

    columns: Annotated[
        dict[str, Column | str],
        setting("The file's column, with scale and offset where they are needed, by our name."),
    ]

    def __post_init__(self) -> None:
        """Refuse a map to an unknown column."""
        unknown = sorted(set(self.columns) - set(COLUMNS) - set(EXTRA_FIELDS))
        if unknown:
            raise ValueError(f"no such column here: {', '.join(unknown)}")
        if "time_us" not in self.columns:
            raise ValueError("time_us must be mapped")
        if absent := _begun(self.columns) - self.columns.keys():
            raise ValueError(f"of the same vector must be mapped too: {', '.join(sorted(absent))}")


class CsvReader:
    """Turn the lines of another program's CSV into rows."""

    def __init__(self, column_map: ColumnMap, *, lenient: bool = False) -> None:
        self._columns = {
            name: Column(column=column.strip())
            if isinstance(column, str)
            else replace(column, column=column.column.strip())
            for name, column in column_map.columns.items()
        }
        self._lenient = lenient
        self.skipped = 0
        """Lines of text before that with the names of the columns."""
        self.faults = 0
        """Lines that could not be read, or whose time is not between its neighbours."""

    def blocks(self, lines: Iterable[str]) -> Iterator[TableBlock]:
        """Read a whole file; raises ValueError if it lacks needed columns."""
        kept = (line for line in lines if not line.startswith("#"))
        head = [*islice(kept, MAX_HEAD_LINES)]
        delimiter, names, begin = self._find_names(head)
        self.skipped = begin - 1
        table = csv.reader(chain(head[begin:], kept), delimiter=delimiter)
        values, held = self._values(table, names, has_decimal_comma=delimiter != ","), NO_ROWS
        before_us: float | None = None
        while lines_of_block := [*islice(values, BLOCK_ROWS)]:
            cells = _cells(dict(zip(self._columns, np.array(lines_of_block).T, strict=True)))
            faults = normalise(cells)
            self.faults += len(faults)
            cells = np.concatenate([held, np.delete(cells, [*faults], axis=0)])
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
        self, table: Iterator[list[str]], names: Sequence[str], *, has_decimal_comma: bool
    ) -> Iterator[list[float]]:
        """Yield the mapped values of each line; NaN is an empty cell."""
        at = {name: number for number, name in enumerate(names)}
        wanted = [(at[c.column], c.scale, c.offset) for c in self._columns.values()]
        while True:
            try:
                line = next(table)
                texts = [line[k].strip() if k < len(line) else "" for k, _, _ in wanted]
                if has_decimal_comma:
                    texts = [text.replace(",", ".") for text in texts]
                if line:
                    yield [
                        float(text) * scale + offset if text else NAN
                        for text, (_, scale, offset) in zip(texts, wanted, strict=True)
                    ]
            except StopIteration:
                return
            except (ValueError, csv.Error):
                self.faults += 1

    def _find_names(self, head: Sequence[str]) -> tuple[str, list[str], int]:
        """Find the line with the names of the columns."""
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
    """Lay mapped values of some lines out as rows of the table."""
    time_us = np.rint(values["time_us"])
    cells = np.full((len(time_us), len(COLUMNS)), NAN)

    def get(name: str, default: float | FloatArray = NAN) -> FloatArray:
        found = values.get(name, cells[:, -1])
        return np.where(np.isnan(found), default, found)

    new_flags = np.where(np.isnan(get("mag_x_b_ut")), 0.0, float(ImuFlags.MAG_NEW))
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


_GROUPS_NEED: Final = [
    (group, [COLUMNS.index(name) for name in names])
    for group, names in (
        (SI, ("accel_x_b_mps2", "gyro_x_b_radps")),
        (BARO, ("baro_pressure_pa",)),
        (GPS, ("gps_lat_dege7", "gps_lon_dege7")),
    )
]
"""Without these columns there is no such record."""


def _cells_of(line: str, delimiter: str) -> list[str]:
    """Split a line; one that is no CSV has no cells."""
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _begun(names: Iterable[str]) -> frozenset[str]:
    """Return all axes of the vectors of which at least one is among the names."""
    return frozenset[str]().union(*(axes for axes in VECTORS if not axes.isdisjoint(names)))


def _measured_us(own_us: FloatArray, row_us: FloatArray) -> FloatArray:
    """Return when values were measured; their lines' time if that is on another clock."""
    return np.where(np.abs(own_us - row_us) <= LATE_US, np.rint(own_us), row_us)


def level_velocity(speed_mps: FloatArray, course_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the velocities north and east of speeds and courses over ground."""
    # Not numpy's sine: its last digit is another one on some processors.
    course_rad = [*map(math.radians, np.where(np.isfinite(course_deg), course_deg, NAN).tolist())]
    north, east = [*map(math.cos, course_rad)], [*map(math.sin, course_rad)]
    return speed_mps * np.array(north), speed_mps * np.array(east)
