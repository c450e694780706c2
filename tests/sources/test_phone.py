"""A phone: three apps' formats as they are published, and the vehicle that they make."""

import json
import math
from itertools import takewhile
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest

from gateway.geometry.quaternion import to_euler
from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuFlags, ImuRaw, NodeId, VehicleReport
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.source_bytes import SOURCE_BYTES
from gateway.sources.kinds import make_decoder
from gateway.sources.settings import parse_source
from gateway.units import US_PER_S
from gateway.wire.framing import Fault
from tests.kit.pipeline_bench import PipelineBench

NODE = NodeId(4, 8)
UTC_S = 1_790_000_000
Readings = list[tuple[float, str, dict[str, Any]]]
"""Seconds, Sensor Logger's name of a sensor, and its values."""


def decoder(url: str = "phone:stdin") -> Any:
    return make_decoder(parse_source(url), NODE)


def sensor_logger(readings: Readings, number: int = 0) -> bytes:
    """Write a post as PUSHING.md describes it."""
    payload = [
        {"name": name, "time": (UTC_S * 1000 + round(seconds * 1000)) * 1_000_000, "values": values}
        for seconds, name, values in readings
    ]
    head = {"messageId": number, "sessionId": "one", "deviceId": "phone"}
    return json.dumps(head | {"payload": payload}).encode() + b"\n"


def xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"z": z, "y": y, "x": x}


class Phyphox:
    """The REST interface of an experiment: buffers, and answers with eight digits."""

    def __init__(self) -> None:
        self.buffers: dict[str, list[float]] = {}
        self.measuring = True

    def add(self, **values: float) -> None:
        for name, value in values.items():
            self.buffers.setdefault(name, []).append(value)

    def answer(self, request: str) -> bytes:
        found = {}
        for name, wanted in parse_qsl(urlsplit(request).query, keep_blank_values=True):
            if (values := self.buffers.get(name)) is None:
                continue
            threshold, _, reference = wanted.partition("|")
            mode, kept = "single", values[-1:]
            if threshold:
                above = float(threshold)
                above += 10.0 ** math.floor(math.log10(above / 1e7))
                times, mode = self.buffers[reference or name], "partial"
                kept = [v for v, t in zip(values, times, strict=True) if t > above]
            digits = ",".join(f"{value:.7E}" for value in kept)
            found[name] = f'"{name}":{{"size":0,"updateMode":"{mode}", "buffer":[{digits}]}}'
        measuring = str(self.measuring).lower()
        status = f'"session":"a1", "measuring":{measuring}, "timedRun":false, "countDown":0'
        buffers = " , ".join(found.values())
        return f'{{"buffer":{{ {buffers} }}, "status":{{ {status} }} }} \n'.encode()


def hyperimu(time_s: float, *sensors: tuple[float, float, float]) -> bytes:
    """Write a packet as its documentation describes it."""
    values = [str(value) for sensor in sensors for value in sensor]
    return ",".join([str(UTC_S * 1000 + round(time_s * 1000)), *values]).encode()


ACCEL, RATE, FIELD = (1.0, 2.0, 9.5), (0.1, -0.2, 0.3), (-12.0, 20.0, -40.0)
"""Of a phone: x right, y to its top, z out of the screen."""


def of_sensor_logger() -> Any:
    readings: Readings = [
        (1.02, "gyroscope", xyz(*RATE)),
        (1.00, "accelerometer", xyz(0.5, 1.5, 0.5)),
        (1.00, "gravity", xyz(0.5, 0.5, 9.0)),
        (1.01, "magnetometer", xyz(*FIELD)),
        (1.01, "light", {"lux": 3}),
    ]
    return decoder().feed(sensor_logger(readings), 5_000_000)


def of_phyphox() -> Any:
    stream, phone = decoder("phone:poll:127.0.0.1:8080"), Phyphox()
    phone.add(acc_time=2.0, accX=ACCEL[0], accY=ACCEL[1], accZ=ACCEL[2])
    phone.add(mag_time=2.001, magX=FIELD[0], magY=FIELD[1], magZ=FIELD[2])
    phone.add(gyr_time=2.005, gyrX=RATE[0], gyrY=RATE[1], gyrZ=RATE[2])
    return stream.feed(phone.answer(stream.request()), 5_000_000)


def of_hyperimu() -> Any:
    packet = hyperimu(1.0, ACCEL, RATE, FIELD, (0.0, 0.0, 0.0))
    return decoder("phone:udp:127.0.0.1:2055").feed(packet, 5_000_000)


@pytest.mark.parametrize("app", [of_sensor_logger, of_phyphox, of_hyperimu])
def test_each_app_gives_the_same_sample_in_axes_of_a_flat_phone(app: Any) -> None:
    (raw,) = app()
    assert isinstance(raw, ImuRaw)
    sample = SensorChain(NodeCalibration()).imu(raw)
    # Forward is the phone's top, down is behind its screen.
    assert sample.accel_b_mps2 == pytest.approx((2.0, 1.0, -9.5), abs=0.001)
    assert sample.gyro_b_radps == pytest.approx((-0.2, 0.1, -0.3), abs=0.0001)
    assert sample.mag_b_ut == pytest.approx((20.0, -12.0, 40.0), abs=0.01)


LOCATION = {
    "latitude": 48.1173, "longitude": -11.5167, "altitude": 592.0, "speed": 11.5, "bearing": 90.0,
    "altitudeAboveMeanSeaLevel": 545.4, "horizontalAccuracy": 3.5, "verticalAccuracy": 6.0,
}  # fmt: skip


def test_location_pressure_and_battery_of_sensor_logger_are_records() -> None:
    readings: Readings = [
        (1.0, "location", LOCATION),
        (1.1, "barometer", {"pressure": 1001.5, "relativeAltitude": 0.2}),
        (1.2, "battery", {"batteryLevel": 0.63, "batteryState": "unplugged"}),
        (1.3, "battery", {"batteryLevel": -1, "voltage": 3.9}),
    ]
    fix, baro, report, unknown = decoder().feed(sensor_logger(readings), 9_000_000)
    assert (fix.lat_dege7, fix.lon_dege7, fix.alt_amsl_m) == (481173000, -115167000, 545.4)
    assert fix.vel_n_mps[:2] == pytest.approx((0.0, 11.5), abs=1e-9)
    assert (fix.h_acc_m, fix.v_acc_m, fix.fix_type) == (3.5, 6.0, GpsFixType.FIX_3D)
    assert (baro.pressure_pa, report.battery.remaining_percent) == (100_150.0, 63.0)
    assert math.isnan(report.battery.voltage_v)
    assert (unknown.battery.voltage_v, repr(unknown.battery.remaining_percent)) == (3.9, "nan")
    assert 99_000 <= baro.time_us - fix.time_us <= 101_000


def test_invalid_values_of_a_location_are_unknown() -> None:
    values = LOCATION | {"speed": -1, "bearing": -1, "horizontalAccuracy": -1}
    (fix,) = decoder().feed(sensor_logger([(1.0, "location", values)]), 0)
    assert [*map(math.isnan, (*fix.vel_n_mps, fix.h_acc_m))] == [True] * 4


def test_height_above_the_ellipsoid_is_used_with_the_geoid_where_there_is_no_other() -> None:
    values = {k: v for k, v in LOCATION.items() if k != "altitudeAboveMeanSeaLevel"}
    post = sensor_logger([(1.0, "location", values)])
    (fix,) = decoder("phone:stdin?geoid_m=46.6").feed(post, 0)
    assert fix.alt_amsl_m == pytest.approx(545.4)
    with pytest.raises(ValueError, match="geoid_m must be a number"):
        decoder("phone:stdin?geoid_m=high")


def turning(begin_s: float, count: int) -> Readings:
    """Make readings of 100 Hz."""
    found: Readings = []
    for tick in range(count):
        found.append((begin_s + tick * 0.01, "totalacceleration", xyz(0, 0, 9.81)))
        found.append((begin_s + tick * 0.01 + 0.001, "gyroscope", xyz(0, 0, 0.1)))
    return found


def test_times_are_those_of_the_phone_though_posts_come_late_and_in_batches() -> None:
    stream, found = decoder(), []
    for number in range(20):
        post = sensor_logger(turning(number * 0.5, 50), number)
        late_us = (number * 37 % 5) * 20_000
        found += stream.feed(post, 2_000_000 + number * 500_000 + 500_000 + late_us)
    times = np.array([sample.time_us for sample in found if isinstance(sample, ImuRaw)])
    assert len(times) == 1000
    steps = np.diff(times)
    assert (steps.min(), np.median(steps)) == (1, 10_000)
    assert np.ptp(times - np.arange(1000) * 10_000) < 30_000, "though posts wait up to 80 ms"


def test_readings_that_come_again_or_late_are_dropped_and_counted() -> None:
    stream = decoder()
    first, second = (sensor_logger(turning(s, 10), n) for n, s in enumerate((1.0, 1.1)))
    assert len(stream.feed(second, 2_000_000)) == 10
    (fault,) = stream.feed(first, 2_000_000)
    assert (fault.kind, fault.size) == ("late", 20)
    *_, again = stream.feed(second, 2_100_000)
    assert again.kind == "late"
    after = stream.feed(sensor_logger(turning(1.2, 10)), 2_200_000)
    assert [type(each) for each in after] == [ImuRaw] * 10
    set_back = stream.feed(sensor_logger(turning(-60.0, 10)), 2_300_000)
    assert [type(each) for each in set_back] == [ImuRaw] * 10, "its clock was set back"


def test_gyroscope_without_an_accelerometer_is_no_sample() -> None:
    stream = decoder()
    rates = [(1.0, "gyroscope", xyz(0, 0, 1)), (1.1, "accelerometer", xyz(0, 0, 9))]
    assert stream.feed(sensor_logger(rates), 0) == [], "the accelerometer has no gravity"
    assert stream.feed(sensor_logger(turning(2.0, 1)), 0)
    late: Readings = [(3.0, "gyroscope", xyz(0, 0, 1))]
    assert stream.feed(sensor_logger(late), 0) == [], "the accelerometer is too old"


def test_request_to_phyphox_covers_newer_readings_and_each_is_decoded_once() -> None:
    stream, phone = decoder("phone:poll:127.0.0.1:8080"), Phyphox()
    found, now_us = [], 0
    for tick in range(300):
        seconds = 1234.5 + tick * 0.01
        phone.add(acc_time=seconds, accX=0.0, accY=0.0, accZ=9.81)
        phone.add(gyr_time=seconds + 0.002, gyrX=0.0, gyrY=0.0, gyrZ=0.1)
        if tick % 100 == 50:
            phone.add(
                loc_time=seconds, locLat=48.11732, locLon=-11.51669, locZ=545.4, locV=5.0,
                locDir=0.0, locAccuracy=4.0, locZAccuracy=9.0, locStatus=1, locSatellites=12,
            )  # fmt: skip
        now_us += 10_000
        if tick % 7 == 0:
            found += stream.feed(phone.answer(stream.request()), now_us)
    fixes = [each for each in found if isinstance(each, GpsFix)]
    assert ([*map(type, found)].count(ImuRaw), len(fixes), len(found)) == (295, 3, 298)
    assert (fixes[0].lat_dege7, fixes[0].satellites) == (481173200, 12)
    phone.buffers.clear()
    phone.add(acc_time=0.5, accX=0.0, accY=0.0, accZ=9.81)
    phone.add(gyr_time=0.5, gyrX=0.0, gyrY=0.0, gyrZ=0.1)
    stream.feed(phone.answer(stream.request()), now_us)
    (sample,) = stream.feed(phone.answer(stream.request()), now_us + 100_000)
    assert isinstance(sample, ImuRaw), "after a restart of the measurement"


def test_phyphox_that_does_not_measure_is_an_explained_fault() -> None:
    stream, phone = decoder("phone:poll:127.0.0.1:8080"), Phyphox()
    phone.measuring = False
    (fault,) = stream.feed(phone.answer(stream.request()), 0)
    assert "start it in the app" in fault.detail


def test_hyperimu_repeats_its_field_and_position_which_are_taken_once() -> None:
    order, found = "gyroscope,light,accelerometer,gps,magnetometer", []
    stream = decoder(f"phone:udp:127.0.0.1:2055?sensors={order}")
    for tick in range(4):
        sensors = (RATE, (5.0, 0.0, 0.0), ACCEL, (48.5, 11.5, 600.0), FIELD)
        found += stream.feed(hyperimu(1.0 + tick * 0.01, *sensors), tick * 10_000)
    kinds = [type(each) for each in found]
    assert (kinds.count(ImuRaw), kinds.count(GpsFix)) == (4, 1)
    with_field = [e for e in found if isinstance(e, ImuRaw) and e.flags & ImuFlags.MAG_NEW]
    assert len(with_field) == 1


GYROSCOPE = '{"payload": [{"name": "gyroscope", "time": %s, "values": {}}]}'


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("{}", "not from a known app"),
        ("[" * 9999, "could not convert"),
        ('{"payload":' + "[" * 9999, "not from a known app"),
        ('{"payload": 3}', "not from a known app"),
        ('{"payload": [{"name": "gyroscope"}]}', "not from a known app"),
        (GYROSCOPE % "1e999", "has an invalid time"),
        (GYROSCOPE % ("1" + "0" * 400), "app"),
        ('{"buffer": [], "status": 3}', "not from a known app"),
        ('{"buffer": {"acc_time": 3}, "status": {}}', "not from a known app"),
        ("1000,1,2", "not three of each"),
        ("1000,x", "could not convert"),
        ("nan,1,2,3,1,2,3,1,2,3,1,2,3", "has an invalid time"),
    ],
)
def test_line_of_no_app_is_an_explained_fault_and_the_next_is_read(line: str, why: str) -> None:
    post = sensor_logger(turning(1.0, 1))
    fault, sample = decoder().feed(line.encode() + b"\n" + post, 0)
    assert isinstance(fault, Fault)
    assert why in fault.detail
    assert isinstance(sample, ImuRaw)


def test_values_that_are_no_numbers_make_no_record() -> None:
    values: Readings = [
        (1.0, "totalacceleration", {"x": "1", "y": None, "z": []}),
        (1.01, "gyroscope", xyz(0, 0, 0)),
        (1.02, "barometer", {}),
        (1.03, "location", {"latitude": 95.0}),
    ]
    assert decoder().feed(sensor_logger(values), 0) == []


def test_flight_of_a_phone_has_attitude_heading_and_position_of_the_truth() -> None:
    bench = PipelineBench(url="phone:stdin")
    posts = SOURCE_BYTES["phone"](SimulatorSettings(), UTC_S * US_PER_S)
    for post in takewhile(lambda post: post.time_s < 30.0, posts):
        bench.wait(post.time_s - bench.now_us / US_PER_S)
        bench.feed(post.data)
    assert bench.source.report(0).faults == ()
    attitude, position = bench.newest("ATTITUDE"), bench.newest("GLOBAL_POSITION_INT")
    motion = SimulatedAircraft(SimulatorSettings(), 0, UTC_S * US_PER_S).trajectory
    truth = motion.truth_at(np.array([attitude.time_boot_ms, position.time_boot_ms]) / 1000.0)
    wanted = to_euler(tuple(truth.q_nb[0].tolist()))
    found = (attitude.roll, attitude.pitch, attitude.yaw)
    errors = [math.remainder(a - b, math.tau) for a, b in zip(found, wanted, strict=True)]
    assert np.degrees(errors) == pytest.approx(0.0, abs=12.0)
    assert math.radians(position.hdg / 100.0) == pytest.approx(attitude.yaw % math.tau, abs=0.1)
    assert position.lat * 1e-7 == pytest.approx(truth.lat_deg[1], abs=1e-4)
    assert position.lon * 1e-7 == pytest.approx(truth.lon_deg[1], abs=1e-4)
    assert position.alt / 1000.0 == pytest.approx(truth.alt_amsl_m[1], abs=10.0)


def test_only_a_phone_is_polled() -> None:
    with pytest.raises(ValueError, match="lines cannot be polled"):
        decoder("lines:poll:127.0.0.1:8080")
    assert [*map(type, decoder("lines:push").feed(b'{"pressure_hpa": 1000}\n', 0))] == [BaroRaw]
    assert VehicleReport in [*map(type, decoder("lines:push").feed(b'{"mode": "X"}\n', 0))]
