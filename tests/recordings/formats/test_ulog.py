"""Topics of a PX4 log that are not as PX4 documents them, and times that cannot be."""

from typing import Any

import numpy as np
import pytest

from gateway.estimation.record import FloatArray
from gateway.recordings.formats.ulog import Px4Log
from gateway.records import BaroRaw, GpsFix, ImuCalibrated

ROWS = 60
STEP_US = 20_000


def topics() -> dict[tuple[str, int], dict[str, Any]]:
    time_us = 5_000_000 + STEP_US * np.arange(ROWS, dtype=np.uint64)
    axes = [f"{name}[{axis}]" for name in ("gyro_rad", "accelerometer_m_s2") for axis in range(3)]
    attitude = [f"q[{axis}]" for axis in range(4)]
    return {
        (topic, 0): {"timestamp": time_us, **dict.fromkeys(fields, np.ones(ROWS, np.float32))}
        for topic, fields in (("sensor_combined", axes), ("vehicle_attitude", attitude))
    }


def test_documented_topics_are_read() -> None:
    flight = Px4Log(topics(), 1)
    assert flight.left_out == []
    assert len(list(flight.records())) == 2 * ROWS


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
    dead: tuple[str, int], live: tuple[str, int], sensors: dict[str, int], remark: str
) -> None:
    found = topics()
    with_source(found, dead, 0.0)
    with_source(found, live, 47.0)
    flight = Px4Log(found, 1, sensors)
    assert flight.chosen == [remark]
    has_values = {
        BaroRaw: lambda record: record.pressure_pa > 0.0,
        GpsFix: lambda record: record.fix_ok,
        ImuCalibrated: lambda record: record.mag_b_ut is not None,
    }
    values = [has_values[type(r)](r) for r in flight.records() if type(r) in has_values]
    assert any(values) is not bool(sensors)


def test_chosen_sensor_that_the_log_lacks_is_reported() -> None:
    found = topics()
    with_source(found, (GPS, 0), 47.0)
    assert Px4Log(found, 1, {"GPS": 2}).chosen == ["has no GPS 3"]


@pytest.mark.parametrize(
    ("field", "values"),
    [("q[3]", None), ("timestamp", None), ("timestamp", np.linspace(0.0, 1.0, ROWS))],
    ids=["no field", "no time", "fractional times"],
)
def test_topic_without_its_fields_is_left_out(field: str, values: FloatArray | None) -> None:
    found = topics()
    columns = found["vehicle_attitude", 0]
    del columns[field]
    if values is not None:
        columns[field] = values
    flight = Px4Log(found, 1)
    assert flight.left_out == ["vehicle_attitude"]
    assert len(list(flight.records())) == ROWS


@pytest.mark.parametrize("off_us", [86_400_000_000, 31_536_000_000_000, -4_000_000, 1 << 60])
def test_damaged_times_give_no_gap(off_us: int) -> None:
    found = topics()
    time_us = found["sensor_combined", 0]["timestamp"].astype(np.int64)
    time_us[[9, 30]] += off_us
    found["sensor_combined", 0]["timestamp"] = time_us.astype(np.uint64)
    flight = Px4Log(found, 1)
    times = [record.time_us for record in flight.records()]
    assert times == sorted(times)
    assert times[-1] - times[0] <= ROWS * STEP_US
    assert flight.dropped == 2


@pytest.mark.parametrize(
    ("fix_type", "valid", "known"), [(3, 1, True), (3, 0, False), (1, 1, False)]
)
def test_velocity_is_used_with_a_fix_and_where_it_is_valid(
    fix_type: int, valid: int, known: bool
) -> None:
    found = topics()
    time_us = found["sensor_combined", 0]["timestamp"][0]
    numbers = {"fix_type": fix_type, "vel_ned_valid": valid, "lat": 470000000, "lon": 80000000}
    speeds = dict.fromkeys(("vel_n_m_s", "vel_e_m_s", "vel_d_m_s"), 1.5)
    columns = {"timestamp": time_us} | numbers | speeds
    found[GPS, 0] = {name: np.array([value]) for name, value in columns.items()}
    (fix,) = (record for record in Px4Log(found, 1).records() if isinstance(record, GpsFix))
    assert (fix.vel_n_mps == (1.5, 1.5, 1.5)) is known
