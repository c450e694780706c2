"""Topics of a PX4 log that are not as PX4 documents them, and times that cannot be."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gateway.estimation.record import FloatArray
from gateway.recordings.formats import ulog_record
from gateway.recordings.logged_samples import read_samples
from gateway.recordings.rows import TableRow
from tests.recordings.flights import OPTIONS

ROWS = 60
STEP_US = 20_000
PATH = Path("flight.ulg")
Topics = dict[tuple[str, int], dict[str, Any]]
Read = Callable[..., tuple[list[TableRow], list[str]]]


def topics() -> Topics:
    time_us = 5_000_000 + STEP_US * np.arange(ROWS, dtype=np.uint64)
    axes = [f"{name}[{axis}]" for name in ("gyro_rad", "accelerometer_m_s2") for axis in range(3)]
    attitude = [f"q[{axis}]" for axis in range(4)]
    return {
        (topic, 0): {"timestamp": time_us, **dict.fromkeys(fields, np.ones(ROWS, np.float32))}
        for topic, fields in (("sensor_combined", axes), ("vehicle_attitude", attitude))
    }


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Read:
    """Read topics as rows; also return the remarks."""

    def read(found: Topics, sensors: dict[str, int] | None = None) -> Any:
        data = [
            SimpleNamespace(name=name, multi_id=number, data=columns)
            for (name, number), columns in found.items()
        ]
        log = SimpleNamespace(
            data_list=data, initial_parameters={}, logged_messages=[], changed_parameters=[],
            logged_messages_tagged={}, get_default_parameters=lambda _: {}, _missing_message_ids=(),
        )  # fmt: skip
        monkeypatch.setattr(ulog_record, "load", lambda *_: (log, []))
        options = replace(OPTIONS, sensors=tuple((sensors or {}).items()))
        table = read_samples(PATH, ulog_record.open_record(PATH, options, sampled=True), options)
        remarks = [text.removeprefix(f"{PATH}: ") for text in table.remarks]
        return [*table.plain_rows], remarks

    return read


def test_documented_topics_are_read(read: Read) -> None:
    rows, remarks = read(topics())
    assert remarks == []
    assert len(rows) == ROWS
    assert all(row.imu is not None and row.state is not None for row in rows)


GPS, MAG, BARO = "vehicle_gps_position", "vehicle_magnetometer", "vehicle_air_data"


def with_source(
    found: dict[tuple[str, int], dict[str, Any]], source: tuple[str, int], value: float
) -> None:
    """Add a topic of a receiver, magnetometer or barometer; one of value 0 has no data."""
    name, _ = source
    fix = {"fix_type": 3 if value else 1, "lat": int(value), "lon": 8, "vel_ned_valid": 1}
    columns: dict[str, Any] = dict.fromkeys(("vel_n_m_s", "vel_e_m_s", "vel_d_m_s"), 0.0) | fix
    if name == MAG:
        columns = {f"magnetometer_ga[{axis}]": value for axis in range(3)}
    elif name in (BARO, "sensor_baro"):
        columns = {"baro_pressure_pa" if name == BARO else "pressure": value}
    times = {"timestamp": found["sensor_combined", 0]["timestamp"]}
    found[source] = times | {key: np.full(ROWS, v) for key, v in columns.items()}


@pytest.mark.parametrize(
    ("dead", "live", "sensors", "remark"),
    [
        ((GPS, 0), (GPS, 1), {}, "uses GPS 2"),
        ((GPS, 0), ("sensor_gps", 0), {}, "uses GPS 1 of sensor_gps"),
        (("sensor_gps", 0), ("sensor_gps", 2), {}, "uses GPS 3"),
        ((MAG, 0), (MAG, 1), {}, "uses MAG 2"),
        ((BARO, 0), ("sensor_baro", 0), {}, "uses BARO 1 of sensor_baro"),
        ((BARO, 0), ("sensor_baro", 1), {}, "uses BARO 2 of sensor_baro"),
        ((GPS, 1), (GPS, 0), {"GPS": 1}, "uses GPS 2"),
    ],
)
def test_first_source_with_data_is_used_unless_another_is_chosen(
    read: Read,
    dead: tuple[str, int],
    live: tuple[str, int],
    sensors: dict[str, int],
    remark: str,
) -> None:
    found = topics()
    with_source(found, dead, 0.0)
    with_source(found, live, 47.0)
    rows, remarks = read(found, sensors)
    assert remarks == [remark]
    fields = [row.imu.mag_b_ut for row in rows if row.imu is not None]
    fixes = [row.gps.fix_ok for row in rows if row.gps is not None]
    baros = [row.baro.pressure_pa > 0.0 for row in rows if row.baro is not None]
    assert any([*fields, *fixes, *baros]) is not bool(sensors)


def test_chosen_sensor_that_the_log_lacks_is_reported(read: Read) -> None:
    found = topics()
    with_source(found, (GPS, 0), 47.0)
    rows, remarks = read(found, {"GPS": 2})
    assert remarks == ["has no GPS 3"]
    assert not any(row.gps for row in rows)


@pytest.mark.parametrize(
    ("field", "values"),
    [("q[3]", None), ("timestamp", None), ("timestamp", np.linspace(0.0, 1.0, ROWS))],
    ids=["no field", "no time", "fractional times"],
)
def test_topic_without_its_fields_is_left_out(
    read: Read, field: str, values: FloatArray | None
) -> None:
    found = topics()
    columns = found["vehicle_attitude", 0]
    del columns[field]
    if values is not None:
        columns[field] = values
    rows, remarks = read(found)
    assert remarks == ["lacks fields that PX4 documents for vehicle_attitude; left out"]
    assert [row.state for row in rows] == [None] * ROWS


@pytest.mark.parametrize("off_us", [86_400_000_000, 31_536_000_000_000, -4_000_000, 1 << 60])
def test_damaged_times_give_no_gap(read: Read, off_us: int) -> None:
    found = topics()
    time_us = found["sensor_combined", 0]["timestamp"].astype(np.int64)
    time_us[[9, 30]] += off_us
    found["sensor_combined", 0]["timestamp"] = time_us.astype(np.uint64)
    rows, remarks = read(found)
    times = [row.time_us for row in rows]
    assert times == sorted(times)
    assert times[-1] - times[0] <= ROWS * STEP_US
    assert remarks == ["left out 2 rows with an impossible time"]


@pytest.mark.parametrize(
    ("fix_type", "valid", "known"), [(3, 1, True), (3, 0, False), (1, 1, False)]
)
def test_velocity_is_used_with_a_fix_and_where_it_is_valid(
    read: Read, fix_type: int, valid: int, known: bool
) -> None:
    found = topics()
    time_us = found["sensor_combined", 0]["timestamp"][0]
    numbers = {"fix_type": fix_type, "vel_ned_valid": valid, "lat": 470000000, "lon": 80000000}
    speeds = dict.fromkeys(("vel_n_m_s", "vel_e_m_s", "vel_d_m_s"), 1.5)
    columns = {"timestamp": time_us} | numbers | speeds
    found[GPS, 0] = {name: np.array([value]) for name, value in columns.items()}
    (fix,) = (row.gps for row in read(found)[0] if row.gps is not None)
    assert (fix.vel_n_mps == (1.5, 1.5, 1.5)) is known
