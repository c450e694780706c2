"""Other people's columns become our rows."""

import math
from typing import Any

import msgspec
import pytest

from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.recordings.formats.csv import Column, ColumnMap, CsvReader
from gateway.recordings.reading import TRACKER_LOG
from gateway.records import GpsFixType, ImuFlags

TRACKER = msgspec.toml.decode(TRACKER_LOG.read_bytes(), type=ColumnMap)
NAMES = "time_s,ax,ay,az,gx,gy,gz,mx,my,mz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m,"
NAMES += "gps_vn,gps_ve,gps_vd,note,gps_speed_ms,gps_course_deg"


def read(*lines: str) -> tuple[CsvReader, list[Any]]:
    reader = CsvReader(TRACKER)
    return reader, rows_of(reader, "# made by somebody", NAMES, *lines)


def rows_of(reader: CsvReader, *lines: str) -> list[Any]:
    return [row for block in reader.blocks(lines) for row in block.events(1)]


def test_line_with_all_columns_is_read() -> None:
    _, rows = read("1.5,0.1,0.2,-9.8,0.01,0.02,0.03,20,5,-40,512.5,1.45,47.1,8.5,430,1,2,3,hi")
    (row,) = rows
    assert row.time_us == 1_500_000
    assert row.imu.accel_b_mps2 == (0.1, 0.2, -9.8)
    assert row.imu.gyro_b_radps == (0.01, 0.02, 0.03)
    assert row.imu.mag_b_ut == (20.0, 5.0, -40.0)
    assert row.imu.flags is ImuFlags.MAG_NEW
    assert pressure_altitude_m(row.baro.pressure_pa) == pytest.approx(512.5, abs=1e-6)
    fix = (row.gps.time_us, row.gps.lat_dege7, row.gps.lon_dege7)
    assert fix == (1_450_000, 471_000_000, 85_000_000)
    assert row.gps.vel_n_mps == (1.0, 2.0, 3.0)
    assert row.gps.fix_type is GpsFixType.FIX_3D
    assert math.isnan(row.gps.h_acc_m)
    assert row.raw is row.state is None


def test_blank_cells_give_no_records_and_the_velocity_is_that_of_speed_and_course() -> None:
    _, rows = read(
        "1.5,0,0,-9.8,0,0,0,,,,,1.45,47.1,8.5,430,,,,,5,120",
        "1.5,0.1,0.2,-9.8,0.01,0.02,0.03,,,,,,,,,,,,",
    )
    north, east, down = rows[0].gps.vel_n_mps
    assert (north, east) == pytest.approx((-2.5, 4.330127), abs=1e-6)
    assert math.isnan(down)
    assert (rows[1].imu.mag_b_ut, rows[1].imu.flags) == (None, ImuFlags(0))
    assert rows[1].baro is rows[1].gps is None


PLAIN = "1.5,0,0,-9.8,0,0,0,20,5,-40,500,1.45,47.1,8.5,430,1,2,3,hi,5,120"


def with_cells(**texts: str) -> str:
    cells = dict(zip(NAMES.split(","), PLAIN.split(","), strict=True))
    return ",".join((cells | texts).values())


@pytest.mark.parametrize("word", ["null", "N/A", "NaN", "nan", "-", "--", "None", "#N/A", " "])
def test_words_for_no_value_are_empty_cells(word: str) -> None:
    reader, (row,) = read(with_cells(gps_lat=word, gps_lon=word, mx=word, baro_alt_m=word))
    assert (row.gps, row.baro, row.imu.mag_b_ut, row.imu.flags) == (None, None, None, ImuFlags(0))
    assert (reader.faults, reader.odd_cells, reader.first_fault) == (0, 0, "")


@pytest.mark.parametrize(
    ("cells", "lost"),
    [
        ({"gps_lat": "x"}, "gps"),
        ({"gps_lat": "1e300"}, "gps"),
        ({"baro_alt_m": "low"}, "baro"),
        ({"ay": "broken"}, "imu"),
    ],
)
def test_unreadable_cell_drops_only_its_record(cells: dict[str, str], lost: str) -> None:
    reader, rows = read(PLAIN.replace("1.5,", "1.4,", 1), with_cells(**cells))
    assert [kind for kind in ("imu", "gps", "baro") if getattr(rows[1], kind) is None] == [lost]
    assert (reader.faults, reader.odd_cells) == (0, 1)
    assert reader.first_fault.startswith("line 4: ")
    assert next(iter(cells)).removesuffix("_m") in reader.first_fault


@pytest.mark.parametrize(
    ("line", "fault"),
    [("soon,0,0,-9.8,0,0,0", "line 3: time_s is 'soon', which is not a number"), ("", "")],
)
def test_line_without_a_time_is_named(line: str, fault: str) -> None:
    reader, rows = read(line)
    assert (rows, reader.first_fault) == ([], fault)


def test_unreadable_lines_are_counted() -> None:
    reader, rows = read("x,1", ",,,", PLAIN)
    assert (len(rows), reader.faults) == (1, 2)


def test_quoted_decimal_commas_between_commas_are_read() -> None:
    cells = [cell.replace(".", ",") for cell in PLAIN.split(",")]
    _, (row,) = read(",".join(f'"{number}"' for number in cells))
    assert (row.time_us, row.imu.accel_b_mps2) == (1_500_000, (0.0, 0.0, -9.8))
    assert (row.gps.time_us, row.gps.lat_dege7) == (1_450_000, 471_000_000)


@pytest.mark.parametrize(
    ("times", "found_s", "unix_s"),
    [
        (["12:00:00.5", "12:00:01,5", "12:00:02"], [43200.5, 43201.5, 43202.0], None),
        (["23:59:59", "0:00:00.5", "00:00:01"], [86399.0, 86400.5, 86401.0], None),
        (["2026-06-11T14:25:30Z", "2026-06-11T14:25:31.5Z"], [0.0, 1.5], 1_781_187_930),
        (["2026-06-11 16:25:30+02:00", "2026-06-11 16:25:31+02:00"], [0.0, 1.0], 1_781_187_930),
        (["2026/06/11 14:25:30", "2026/06/11 14:25:30.25"], [0.0, 0.25], 1_781_187_930),
    ],
)
def test_times_of_the_day_and_dates_are_read(
    times: list[str], found_s: list[float], unix_s: int | None
) -> None:
    quoted = (time.join('""') if "," in time else time for time in times)
    reader, rows = read(*(with_cells(time_s=text, gps_time_s=text) for text in quoted))
    assert [row.time_us / 1e6 for row in rows] == found_s
    assert [row.gps.time_us for row in rows] == [row.time_us for row in rows]
    assert reader.unix_us_at_zero == (None if unix_s is None else unix_s * 1_000_000)


def test_scale_and_offset_are_applied() -> None:
    columns = {"time_us": Column(column="t", scale=1e3, offset=5.0), "baro_pressure_pa": "p"}
    (row,) = rows_of(CsvReader(ColumnMap(columns=columns)), "t,p", "2,95000")
    assert row.time_us == 2005
    assert row.baro is not None
    assert row.baro.pressure_pa == 95_000.0


@pytest.mark.parametrize(
    ("names", "lenient", "missing"),
    [
        ("time_s,az", False, "ax, ay, baro_alt_m, gps_alt_m"),
        ("time_s,az", True, "ax, ay, gx, gy, gz; found, separated by commas: time_s"),
        ("time_s,ax,ay,az,gx,gz", True, "gy; found, separated by commas: time_s"),
        ("time_s,ax,ay,az,gx,gy,gz,mx,my", True, "mz; found, separated by commas: time_s"),
    ],
)
def test_file_without_needed_columns_is_refused(names: str, lenient: bool, missing: str) -> None:
    """Without a column map, only the columns of a sample are required."""
    with pytest.raises(ValueError, match=f"no column {missing}"):
        rows_of(CsvReader(TRACKER, lenient=lenient), names, "1,2")


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"wings": "w", "time_us": "t"}, "wings"),
        ({}, "time_us"),
        ({"time_us": "t", "mag_y_b_ut": "m"}, "mapped too: mag_x_b_ut, mag_z_b_ut"),
    ],
)
def test_invalid_map_is_refused(columns: dict[str, str], text: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=text):
        msgspec.convert({"columns": columns}, ColumnMap)


def times_of(*times_s: float) -> tuple[int, list[float]]:
    reader, rows = read(*(f"{t},0,0,-9.8,0,0,0,,,,,,,,,,,,,," for t in times_s))
    return reader.faults, [row.time_us / 1e6 for row in rows]


SECONDS = tuple(range(10, 20))


@pytest.mark.parametrize("odd", [86_410.0, -86_400.0, 1e9, 10.0, 30.0])
def test_line_with_a_damaged_time_is_left_out(odd: float) -> None:
    assert times_of(*SECONDS[:5], odd, *SECONDS[5:]) == (1, [*SECONDS])


@pytest.mark.parametrize("leap", [-86_400, -60, 60, 86_400 * 400])
def test_jump_of_the_clock_is_kept(leap: int) -> None:
    times = [*SECONDS, *(t + leap for t in SECONDS)]
    assert times_of(*times) == (0, times)


@pytest.mark.parametrize("own", ["86401", "-86400", "1e12", "1780000000"])
def test_fix_time_of_another_clock_is_replaced_by_row_time(own: str) -> None:
    _, (row,) = read(f"1.5,0,0,-9.8,0,0,0,,,,,{own},47.1,8.5,430,1,2,3,,,")
    assert row.gps.time_us == row.time_us
