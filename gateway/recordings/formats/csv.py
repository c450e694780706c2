"""CSV files of other programs as rows, by a map of their columns."""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import Annotated, Final

from msgspec.structs import replace

from gateway.geometry.atmosphere import pressure_at_height
from gateway.recordings.columns import COLUMNS, TableRow, check_times
from gateway.recordings.tlog import is_damaged
from gateway.records import (
    NAN,
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    NodeId,
    Vec3,
)
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
    """Which columns of another program's file correspond to which of ours."""

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

    def __init__(
        self, column_map: ColumnMap, vehicle_id: int = 1, *, lenient: bool = False
    ) -> None:
        self._columns = {
            name: Column(column=column.strip())
            if isinstance(column, str)
            else replace(column, column=column.column.strip())
            for name, column in column_map.columns.items()
        }
        self._vehicle_id = vehicle_id
        self._lenient = lenient
        self._is_decimal_comma = False
        self.skipped = 0
        """Lines of text before that with the names of the columns."""
        self.faults = 0
        """Lines that could not be read, or whose time is not between its neighbours."""

    def rows(self, lines: Iterable[str]) -> Iterator[TableRow]:
        """Read a whole file."""
        kept = (line for line in lines if not line.startswith("#"))
        head = [*islice(kept, MAX_HEAD_LINES)]
        delimiter, names, begin = self._find_names(head)
        self.skipped = begin - 1
        self._is_decimal_comma = delimiter != ","
        table = csv.DictReader(chain(head[begin:], kept), names, delimiter=delimiter)
        before: TableRow | None = None
        held: TableRow | None = None
        for row in self._readable(table):
            if (
                held is not None
                and before is not None
                and is_damaged(before.time_us, held.time_us, row.time_us)
            ):
                self.faults += 1
            elif held is not None:
                yield held
                before = held
            held = row
        if held is not None:
            yield held

    def _readable(self, table: Iterator[dict[str, str]]) -> Iterator[TableRow]:
        while True:
            try:
                yield self._row(next(table))
            except StopIteration:
                return
            except (ValueError, TypeError, OverflowError, csv.Error):
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

    def _number(self, text: str) -> float:
        return float(text.replace(",", ".") if self._is_decimal_comma else text)

    def _row(self, cells: Mapping[str, str]) -> TableRow:
        value = {
            name: self._number(cells[c.column]) * c.scale + c.offset
            for name, c in self._columns.items()
            if (cells[c.column] or "").strip()
        }
        time_us = round(value["time_us"]) if "time_us" in value else None
        if time_us is None:
            raise ValueError("no time")
        row = TableRow(
            time_us=time_us,
            baro=self._baro(value, time_us),
            gps=self._gps(value, time_us),
            imu=self._imu(value, time_us),
        )
        check_times(row)
        return row

    def _imu(self, value: Mapping[str, float], time_us: int) -> ImuCalibrated | None:
        if "accel_x_b_mps2" not in value or "gyro_x_b_radps" not in value:
            return None
        has_mag = "mag_x_b_ut" in value
        return ImuCalibrated(
            time_us=time_us,
            node=NodeId(self._vehicle_id, 0),
            accel_b_mps2=_vector(value, "accel_{}_b_mps2", "xyz"),
            gyro_b_radps=_vector(value, "gyro_{}_b_radps", "xyz"),
            mag_b_ut=_vector(value, "mag_{}_b_ut", "xyz") if has_mag else None,
            temperature_degc=value.get("temperature_degc", NAN),
            flags=ImuFlags(int(value.get("imu_flags", ImuFlags.MAG_NEW if has_mag else 0))),
        )

    def _baro(self, value: Mapping[str, float], time_us: int) -> BaroRaw | None:
        if "baro_pressure_pa" in value:
            pressure_pa = value["baro_pressure_pa"]
        else:
            pressure_pa = pressure_at_height(value.get("baro_alt_m", NAN))
            if math.isnan(pressure_pa):
                return None
        return BaroRaw(
            time_us=_measured_us(value.get("baro_time_us", time_us), time_us),
            node=NodeId(self._vehicle_id, 0),
            node_time_us=time_us,
            pressure_pa=pressure_pa,
            temperature_degc=value.get("baro_temperature_degc", NAN),
        )

    def _gps(self, value: Mapping[str, float], time_us: int) -> GpsFix | None:
        if "gps_lat_dege7" not in value or "gps_lon_dege7" not in value:
            return None
        utc_us = value.get("gps_utc_us", NAN)
        return GpsFix(
            time_us=_measured_us(value.get("gps_time_us", time_us), time_us),
            node=NodeId(self._vehicle_id, 1),
            node_time_us=time_us,
            itow_ms=round(value.get("gps_itow_ms", 0)),
            fix_type=GpsFixType(int(value.get("gps_fix_type", GpsFixType.FIX_3D))),
            fix_ok=bool(value.get("gps_fix_ok", 1)),
            satellites=int(value.get("gps_satellites", 0)),
            lat_dege7=round(value["gps_lat_dege7"]),
            lon_dege7=round(value["gps_lon_dege7"]),
            alt_amsl_m=value.get("gps_alt_amsl_m", NAN),
            vel_n_mps=_velocity(value),
            alt_ellipsoid_m=value.get("gps_alt_ellipsoid_m", NAN),
            h_acc_m=value.get("gps_h_acc_m", NAN),
            v_acc_m=value.get("gps_v_acc_m", NAN),
            speed_acc_mps=value.get("gps_speed_acc_mps", NAN),
            course_acc_deg=value.get("gps_course_acc_deg", NAN),
            pdop=value.get("gps_pdop", NAN),
            utc_us=None if math.isnan(utc_us) else round(utc_us),
        )


def _cells_of(line: str, delimiter: str) -> list[str]:
    """Split a line; one that is no CSV has no cells."""
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _begun(names: Iterable[str]) -> frozenset[str]:
    """Return all axes of the vectors of which at least one is among the names."""
    return frozenset[str]().union(*(axes for axes in VECTORS if not axes.isdisjoint(names)))


def _measured_us(own_us: float, row_us: int) -> int:
    """Return when a value was measured; its line's time if that cannot be, or on another clock."""
    return round(own_us) if abs(own_us - row_us) <= LATE_US else row_us


def _velocity(value: Mapping[str, float]) -> Vec3:
    """Read a fix's velocity, or compute its horizontal part from speed and course."""
    north, east, down = _vector(value, "gps_vel_{}_mps", ("north", "east", "down"))
    if not (math.isfinite(north) and math.isfinite(east)):
        speed = value.get("gps_speed_mps", NAN)
        course_rad = math.radians(value.get("gps_course_deg", NAN))
        north, east = speed * math.cos(course_rad), speed * math.sin(course_rad)
    return (north, east, down)


def _vector(value: Mapping[str, float], name: str, axes: Iterable[str]) -> Vec3:
    x, y, z = (value.get(name.format(axis), NAN) for axis in axes)
    return (x, y, z)
