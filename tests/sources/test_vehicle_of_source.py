"""A source as a vehicle: what ground stations see, and what its loss does."""

import json
import math
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.stats import HubCounters
from gateway.records import BatteryReport, GpsFix, NodeId, VehicleReport
from gateway.sources.kinds import make_sources
from gateway.sources.sampling import fix_at, imu_raw
from gateway.sources.settings import SourceSettings, nodes_of, parse_source
from gateway.status import Snapshot, status_of, summary_line
from gateway.wire.framing import encode_frame
from tests.kit.pipeline_bench import PipelineBench

NODE = NodeId(1, 8)


class Flight(PipelineBench):
    """A pipeline without a receiver whose source is open."""

    def __init__(self, url: str = "lines:stdin") -> None:
        super().__init__(url=url)
        self.pipeline.disconnect("none")
        self.source.opened()

    def report(self, time_us: int | None = None, **fields: Any) -> None:
        """Let the vehicle report fields, by default now."""
        time_us = self.now_us if time_us is None else time_us
        self.take(VehicleReport(time_us=time_us, node=NODE, **fields))

    def line(self, **content: object) -> None:
        self.feed(json.dumps(content).encode() + b"\n")


@pytest.fixture
def flight() -> Flight:
    return Flight()


def fix(time_us: int, lat_deg: float = 48.0) -> GpsFix:
    made = fix_at(time_us, NODE, lat_deg, 11.0, 500.0, vel_n_mps=(10.0, 0.0, -1.0), satellites=9)
    assert made is not None
    return made


def test_vehicle_with_gps_only_has_a_position_and_no_attitude(flight: Flight) -> None:
    for _ in range(50):
        flight.wait(0.2)
        flight.line(lat=48.0, lon=11.0, alt_m=500, speed_mps=10, course_deg=90, satellites=9)
    position = flight.newest("GLOBAL_POSITION_INT")
    found = (position.lat, position.alt, position.vy, position.hdg)
    assert found == (480000000, 500000, 1000, 65535)
    assert flight.newest("VFR_HUD").heading == 90, "course over ground"
    for kind in ("ATTITUDE", "ATTITUDE_QUATERNION", "ESTIMATOR_STATUS"):
        assert flight.newest(kind) is None
    assert flight.newest("HEARTBEAT").system_status == mavlink.MAV_STATE_ACTIVE
    present = flight.newest("SYS_STATUS").onboard_control_sensors_present
    assert present & mavlink.MAV_SYS_STATUS_SENSOR_GPS
    assert not present & mavlink.MAV_SYS_STATUS_AHRS


def test_reported_attitude_is_passed_on_with_its_own_time(flight: Flight) -> None:
    for _ in range(20):
        flight.wait(0.1)
        flight.report(flight.now_us - 40_000, attitude_rad=(0.2, -0.1, 2.5))
    attitude = flight.newest("ATTITUDE")
    assert attitude.time_boot_ms == (flight.now_us - 40_000) // 1000
    assert (attitude.roll, attitude.pitch, attitude.yaw) == pytest.approx((0.2, -0.1, 2.5))
    assert math.isnan(attitude.rollspeed), "not reported"
    assert flight.newest("GLOBAL_POSITION_INT") is None
    health = flight.newest("SYS_STATUS").onboard_control_sensors_health
    assert health & mavlink.MAV_SYS_STATUS_AHRS


def test_position_of_a_reporting_vehicle_is_that_of_its_fixes_at_once(flight: Flight) -> None:
    flight.report(attitude_rad=(0.0, 0.0, 1.0))
    flight.take(fix(50_000))
    position = flight.newest("GLOBAL_POSITION_INT")
    assert (position.lat, position.vx, position.hdg) == (480000000, 1000, 5730)


def test_old_attitude_is_not_repeated_with_a_new_position(flight: Flight) -> None:
    flight.report(attitude_rad=(0.0, 0.0, 1.0))
    flight.wait(5.0)
    flight.take(fix(flight.now_us))
    assert flight.newest("GLOBAL_POSITION_INT").hdg == 65535


def test_battery_mode_arming_and_link_are_passed_on(flight: Flight) -> None:
    battery = BatteryReport(voltage_v=15.8, current_a=12.5, remaining_percent=63.0, used_mah=420.0)
    flight.report(
        battery=battery, mode="ANGL", custom_mode=0, armed=True,
        vehicle_type=mavlink.MAV_TYPE_QUADROTOR, link_quality_percent=97.0,
    )  # fmt: skip
    flight.wait(2.0)
    status = flight.newest("SYS_STATUS")
    found = (status.voltage_battery, status.current_battery, status.battery_remaining)
    assert found == (15800, 1250, 63)
    assert flight.newest("BATTERY_STATUS").current_consumed == 420
    heartbeat = flight.newest("HEARTBEAT")
    assert heartbeat.type == mavlink.MAV_TYPE_QUADROTOR
    assert heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert flight.newest("RC_CHANNELS").rssi == 97
    assert flight.newest("AVAILABLE_MODES_MONITOR").seq == 1
    flight.report(armed=False)
    flight.wait(1.0)
    assert not flight.newest("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def test_unknown_fields_of_a_battery_are_unknown_and_not_zero(flight: Flight) -> None:
    flight.report(battery=BatteryReport(voltage_v=7.4))
    sent = flight.newest("BATTERY_STATUS")
    unknown = (sent.current_battery, sent.current_consumed, sent.battery_remaining)
    assert unknown == (-1, -1, -1)
    flight.wait(12.0)
    assert flight.newest("SYS_STATUS").voltage_battery == 65535, "old"


def test_modes_of_unknown_autopilots_have_numbers_of_their_own(flight: Flight) -> None:
    numbers = []
    for mode in ("ALPHA", "BETA", "ALPHA"):
        flight.report(mode=mode)
        flight.wait(1.0)
        numbers.append(flight.newest("HEARTBEAT").custom_mode)
    assert numbers == [1000, 1001, 1000]


def test_home_is_set_by_the_first_fix_after_arming(flight: Flight) -> None:
    flight.take(fix(0, 48.0))
    flight.report(armed=True)
    flight.take(fix(200_000, 48.5))
    assert flight.newest("HOME_POSITION").latitude == 485000000


def test_samples_of_a_source_are_fused(flight: Flight) -> None:
    for _ in range(400):
        flight.now_us += 10_000
        flight.take(imu_raw(flight.now_us, NODE, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
    attitude = flight.newest("ATTITUDE")
    assert (attitude.roll, attitude.pitch) == pytest.approx((0.0, 0.0), abs=0.02)


@pytest.mark.parametrize(
    ("samples_until_s", "roll", "origin"),
    [(20.0, 0.0, "fused from samples"), (2.0, 0.5, "reported by its autopilot")],
)
def test_reported_attitude_is_used_only_without_samples(
    flight: Flight, samples_until_s: float, roll: float, origin: str
) -> None:
    for count in range(1, 1001):
        flight.now_us = count * 10_000
        if count * 0.01 <= samples_until_s:
            flight.take(imu_raw(flight.now_us, NODE, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
        if count % 10 == 5:
            flight.report(attitude_rad=(0.5, 0.0, 1.0), alt_home_m=99.0)
    rolls = [each.roll for each in flight.messages if each.get_type() == "ATTITUDE"]
    assert rolls[-20:] == pytest.approx([roll] * 20, abs=0.02)
    assert status_of(flight.pipeline.find(1), flight.now_us).origins["attitude"] == origin


def test_mode_arming_and_type_expire(flight: Flight) -> None:
    kind = mavlink.MAV_TYPE_QUADROTOR
    flight.report(mode="ALPHA", armed=True, vehicle_type=kind)
    flight.wait(10.0)
    beat = flight.newest("HEARTBEAT")
    assert (beat.base_mode >> 7, beat.custom_mode, beat.type) == (1, 1000, kind)
    assert flight.pipeline.find(1).vehicle.operates
    flight.wait(10.0)
    beat = flight.newest("HEARTBEAT")
    assert (beat.base_mode >> 7, beat.custom_mode) == (0, 0)
    assert beat.type != kind
    assert not flight.pipeline.find(1).vehicle.operates


def test_silent_source_is_announced_and_so_is_a_lost_one(flight: Flight) -> None:
    for _ in range(30):
        flight.wait(0.1)
        flight.line(pressure_hpa=1000)
    flight.wait(6.0)
    assert "Source 1 silent" in flight.texts
    flight.source.lost("unplugged")
    flight.wait(6.0)
    assert "Source lost: lines:stdin" in flight.texts
    assert not [text for text in flight.texts if "Receiver" in text]


def test_signal_of_a_source_is_its_radio_status(flight: Flight) -> None:
    flight.line(rssi_dbm=-71, snr_db=9)
    flight.wait(2.5)
    radio = flight.newest("RADIO_STATUS")
    assert (radio.rssi - 256, radio.noise - 256) == (-71, -80)
    flight.line(rssi_dbm=-71)
    flight.wait(2.5)
    assert flight.newest("RADIO_STATUS").noise == 255


def test_packets_of_radiohead_through_the_receiver_are_lines() -> None:
    flight = Flight("lines:receiver?id=5")
    flight.pipeline.connect("/dev/ttyUSB0")
    for number in range(4):
        packet = b"\xff\x01\x00\x00" + b'{"pressure_hpa": 990}'
        head = struct.pack("<BBBIBb", 0x14, number, 0xFF, number * 500_000, 104, 20)
        flight.now_us += 500_000
        flight.keep(flight.pipeline.feed(encode_frame(head + packet), flight.now_us))
    flight.wait(2.0)
    assert flight.newest("SCALED_PRESSURE").press_abs == 990.0
    assert flight.newest("SCALED_PRESSURE").get_srcSystem() == 5
    assert flight.newest("RADIO_STATUS").rssi - 256 == -104


def test_faults_are_counted_and_explained_and_are_no_loss(flight: Flight) -> None:
    flight.wait(1.0)
    flight.line(pressure_hpa=1000)
    flight.feed(b"one\n{\ntwo\n")
    flight.wait(2.0)
    report = flight.pipeline.report
    (source,) = report.sources
    assert source.faults == (("json", 1), ("text", 2))
    assert "'two'" in source.newest_fault
    status = flight.newest("SYS_STATUS")
    assert (report.nodes, status.drop_rate_comm, status.errors_comm) == ((), 0, 0)
    line = summary_line(Snapshot(flight.now_us, report, (), (), (), HubCounters()))
    assert line == (
        "source lines:stdin: 1 records, 0 a second, the last 2.0 s ago, 1 json, 2 text; 0 clients"
    )


@pytest.mark.parametrize(
    ("url", "transport", "address", "baud"),
    [
        ("lines:/dev/ttyUSB0", "serial", "/dev/ttyUSB0", 115_200),
        ("crsf:usb:1a86:7523", "serial", "usb:1a86:7523", 420_000),
        ("ltm:usb:1a86:7523?baud=1200", "serial", "usb:1a86:7523", 1200),
        ("lines:udp:0.0.0.0:5600", "udp", "0.0.0.0:5600", 0),
        ("lines:tcp-listen:[::1]:70", "tcp-listen", "[::1]:70", 0),
        ("lines:tcp:host:70?id=4", "tcp", "host:70", 0),
        ("lines:stdin", "stdin", "", 0),
        ("lines:-", "stdin", "", 0),
        ("lines:file:/tmp/a:b", "file", "/tmp/a:b", 0),
    ],
)
def test_url_has_transport_and_address(url: str, transport: str, address: str, baud: int) -> None:
    found = parse_source(url)
    assert (found.transport, found.address) == (transport, address)
    if baud:
        assert (found.endpoint.host, found.endpoint.port) == (address, baud)
    elif found.endpoint is not None:
        assert found.endpoint.address == address


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("lines", "KIND:WHERE"),
        ("lines:", "no device"),
        ("lines:udp:5600", "HOST:PORT"),
        ("lines:udp:127.0.0.1:99999", "port 99999 is not"),
        ("lines:udp:host:5600", "not an address"),
        ("lines:/dev/ttyUSB0?baud=x", "baud rate 'x'"),
        ("line:stdin", "did you mean 'lines'"),
        ("lines-udp:0.0.0.0:5600", "did you mean 'lines'"),
        ("crsf:stdin?pitch=left", "up or down"),
        ("lines:stdin?bad=1", "unknown option 'bad'"),
        ("lines:stdin?id=x", "whole number"),
        ("lines:stdin?id=0", "1 to 31"),
        ("lines:stdin?id=256", "1 to 31"),
        ("phone:push?geoid_m=x", "a number"),
        ("phone:push?token=", "token= needs 16"),
        ("phone:push?token=open-sesame", "token= needs 16"),
        ("phone:push?token=open/sesame/open/sesame", "token= needs 16"),
    ],
)
def test_wrong_url_is_refused_with_the_reason_and_without_its_token(url: str, why: str) -> None:
    secret = (
        url if "token=" in url else url + ("&" if "?" in url else "?") + "token=open-sesame-open"
    )
    with pytest.raises(ValueError, match=why.replace("'", ".")) as refusal:
        make_sources((SourceSettings(url=secret),), str)
    assert "sesame" not in str(refusal.value)


def test_sources_are_vehicles_by_their_position_unless_an_id_is_set() -> None:
    settings = (
        SourceSettings(url="lines:stdin"),
        SourceSettings(url="lines:file:/a?id=7"),
        SourceSettings(url="lines:file:/b?id=7"),
    )
    assert nodes_of(settings) == [NodeId(1, 8), NodeId(7, 8), NodeId(7, 9)]


def test_reported_home_and_height_are_used_and_small_steps_are_not(flight: Flight) -> None:
    flight.take(fix(0, 48.0))
    for lat in (48.01, 48.0101):
        flight.report(home=(lat, 11.0, 480.0), alt_home_m=33.0)
        flight.take(fix(flight.now_us, 48.0))
        flight.wait(1.1)
    assert flight.newest("HOME_POSITION").latitude == 480100000
    assert flight.newest("GLOBAL_POSITION_INT").relative_alt == 33000
