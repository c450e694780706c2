"""CRSF: frames of an independent writer, the scales of flight controllers, damage and noise."""

import math
import struct
from typing import Any

import pytest
from crsf_parser.handling import crsf_build_frame
from crsf_parser.payloads import PacketsTypes
from fastcrc.crc8 import dvb_s2
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import GpsFixType, ImuFlags, NodeId, VehicleReport
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.sources.kinds import make_decoder
from gateway.sources.settings import parse_source
from tests.kit.payloads import ltm

NODE = NodeId(2, 8)
QUADROTOR, FIXED_WING = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_FIXED_WING


def decoder(options: str = "", kind: str = "crsf") -> Any:
    return make_decoder(parse_source(f"{kind}:/dev/ttyACM0{options}"), NODE)


def frame(kind: int, payload: bytes, address: int = 0xEA) -> bytes:
    body = bytes([kind]) + payload
    return bytes([address, len(body) + 1]) + body + bytes([dvb_s2(body)])


def one(kind: int, payload: bytes, options: str = "") -> Any:
    (record,) = decoder(options).feed(frame(kind, payload), 5_000_000)
    return record


ATTITUDE = struct.pack(">hhh", 1745, -3491, 31416)


def test_battery_of_another_implementation_is_read() -> None:
    values = {"voltage": 168, "current": 123, "capacity": 70_000, "remaining": 81}
    (report,) = decoder().feed(crsf_build_frame(PacketsTypes.BATTERY_SENSOR, values), 0)
    battery = report.battery
    assert (battery.voltage_v, battery.current_a) == pytest.approx((16.8, 12.3))
    assert (battery.used_mah, battery.remaining_percent) == (70_000.0, 81.0)


def test_link_statistics_of_another_implementation_are_read() -> None:
    values = {
        "uplink_rssi_ant_1": 70, "uplink_rssi_ant_2": 65, "uplink_link_quality": 98,
        "uplink_snr": 9, "diversity_active_antenna": 1, "rf_mode": 2, "uplink_tx_power": 3,
        "downlink_rssi": 88, "downlink_link_quality": 100, "downlink_snr": -7,
    }  # fmt: skip
    (report,) = decoder().feed(crsf_build_frame(PacketsTypes.LINK_STATISTICS, values), 0)
    assert (report.signal.rssi_dbm, report.signal.snr_db) == (-88, -7.0)
    assert report.link_quality_percent == 98.0
    values["downlink_rssi"] = 0
    (report,) = decoder().feed(crsf_build_frame(PacketsTypes.LINK_STATISTICS, values), 0)
    assert (report.signal.rssi_dbm, report.signal.snr_db) == (-65, 9.0), "of the active antenna"


def test_channels_of_another_implementation_are_read() -> None:
    ticks = [172, 992, 1811, *[992] * 12, 191]
    # This writer takes the last channel first.
    data = crsf_build_frame(PacketsTypes.RC_CHANNELS_PACKED, {"channels": ticks[::-1]})
    (report,) = decoder().feed(data, 0)
    assert report.channels_us[:3] == (988, 1500, 2012)
    assert report.channels_us[15] == 999


def test_attitude_has_the_order_and_scale_of_the_specification() -> None:
    for address in (0xC8, 0xEA, 0xEE, 0xEC, 0x00, 0x7F):
        (report,) = decoder().feed(frame(0x1E, ATTITUDE, address), 5_000_000)
        assert report.attitude_rad == pytest.approx((-0.3491, 0.1745, 3.1416)), address
        assert report.time_us == 5_000_000


TENTHS = struct.pack(">hhh", 1745, -3490, 25097)
"""10, -20 and 143.8 degrees, as Betaflight rounds them."""
BETAFLIGHT, ARDUPILOT = (b"\xea\xc8" + name for name in (b"Betaflight 4.5\0", b"ArduCopter V4.6\0"))


@pytest.mark.parametrize(
    ("before", "attitude", "options", "pitch"),
    [
        (b"", ATTITUDE, "", 0.1745),
        (b"", TENTHS, "", -0.1745),
        (frame(0x21, b"ACRO\0") + frame(0x1E, bytes(6)), TENTHS, "", -0.1745),
        (frame(0x1E, ATTITUDE) + frame(0x21, b"ACRO*\0"), TENTHS, "", 0.1745),
        (frame(0x21, b"ACRO!\0"), ATTITUDE, "", -0.1745),
        (frame(0x21, b"ANGL\0"), ATTITUDE, "", -0.1745),
        (frame(0x21, b"FBWA\0"), TENTHS, "", 0.1745),
        (frame(0x21, b"STAB\0"), ATTITUDE, "", 0.1745),
        (frame(0x12, bytes(6)), ATTITUDE, "", -0.1745),
        (frame(0x29, BETAFLIGHT), ATTITUDE, "", -0.1745),
        (frame(0x29, ARDUPILOT), TENTHS, "", 0.1745),
        (frame(0x29, b"\xea\xeeINAV\0"), ATTITUDE, "", 0.1745),
        (frame(0x21, b"ANGL\0"), ATTITUDE, "?pitch=up", 0.1745),
        (b"", ATTITUDE, "?pitch=down", -0.1745),
    ],
)
def test_pitch_sign_is_that_of_the_firmware(
    before: bytes, attitude: bytes, options: str, pitch: float
) -> None:
    found = decoder(options).feed(before + frame(0x1E, attitude), 0)
    assert found[-1].attitude_rad[1] == pytest.approx(pitch)


def test_firmware_is_identified_again_after_a_gap() -> None:
    stream = decoder()
    stream.feed(frame(0x29, BETAFLIGHT), 0)
    (report,) = stream.feed(frame(0x1E, ATTITUDE), 20_000_000)
    assert report.attitude_rad[1] == pytest.approx(0.1745)


GPS = struct.pack(">iiHHHB", 481173000, -115167000, 414, 27050, 1545, 11)
GPS_EXTENDED = struct.pack(">BhhhhhhhhBBB", 3, 250, -130, 40, 30, 100, 590, 180, 250, 0, 9, 14)


def test_gps_frame_is_a_fix() -> None:
    fix = one(0x02, GPS)
    assert (fix.lat_dege7, fix.lon_dege7, fix.alt_amsl_m) == (481173000, -115167000, 545.0)
    assert (fix.satellites, fix.fix_type, fix.fix_ok) == (11, GpsFixType.FIX_3D, True)
    speed = 41.4 / 3.6
    assert fix.vel_n_mps[1] == pytest.approx(speed * math.sin(math.radians(270.5)))
    west = one(0x02, struct.pack(">iiHhHB", 481173000, -115167000, 360, -9000, 1545, 11))
    assert west.vel_n_mps[:2] == pytest.approx((0.0, -10.0), abs=1e-9), "a signed course of PX4"
    lost = one(0x02, GPS[:-1] + bytes(1))
    assert (lost.fix_type, lost.fix_ok) == (GpsFixType.NONE, False), "the last position"


def test_extended_gps_and_time_belong_to_the_next_fix() -> None:
    time = struct.pack(">hBBBBBH", 2026, 3, 23, 10, 15, 33, 250)
    data = frame(0x03, time) + frame(0x06, GPS_EXTENDED) + frame(0x02, GPS)
    (fix,) = decoder().feed(data, 7_000_000)
    assert fix.vel_n_mps == pytest.approx((2.5, -1.3, -0.4))
    assert (fix.h_acc_m, fix.v_acc_m, fix.speed_acc_mps) == pytest.approx((1.8, 2.5, 0.3))
    assert fix.utc_us == 1_774_260_933_250_000


@pytest.mark.parametrize(
    ("kind", "payload", "field", "value"),
    [
        (0x07, struct.pack(">h", -250), "climb_mps", -2.5),
        (0x09, struct.pack(">Hb", 10_000, 0), "alt_home_m", 0.0),
        (0x09, struct.pack(">Hb", 0, 0), "alt_home_m", -1000.0),
        (0x09, struct.pack(">Hb", 0x7FFF, 0), "alt_home_m", 2276.7),
        (0x09, struct.pack(">H", 0x8000 | 5000), "alt_home_m", 5000.0),
        (0x09, struct.pack(">Hb", 0, 127), "climb_mps", math.exp(127 * 0.026) - 1),
        (0x09, struct.pack(">Hb", 0, -10), "climb_mps", 1 - math.exp(0.26)),
        (0x0A, struct.pack(">H", 720), "airspeed_mps", 20.0),
        (0x1C, bytes([80, 60, 93, 5, 20]), "link_quality_percent", 93.0),
    ],
)
def test_scale_and_sign_of_a_number(kind: int, payload: bytes, field: str, value: float) -> None:
    assert getattr(one(kind, payload), field) == pytest.approx(value)


def test_rpm_temperatures_and_cells_are_read() -> None:
    turns = one(0x0C, bytes([0]) + (1200).to_bytes(3, "big") + b"\xff\xff\x38")
    assert turns.values == (("rpm0.0", 1200.0), ("rpm0.1", -200.0))
    warm = one(0x0D, b"\x01" + struct.pack(">hh", 250, -50))
    assert warm.values == (("temp1.0", 25.0), ("temp1.1", -5.0))
    battery = one(0x0E, b"\x00" + struct.pack(">HHH", 3850, 3840, 3830)).battery
    assert battery.cells_v == pytest.approx((3.85, 3.84, 3.83))
    assert battery.voltage_v == pytest.approx(11.52)


def test_pressure_field_and_inertial_sample_of_betaflight_are_samples() -> None:
    stream = decoder()
    # At rest and level, as Betaflight writes it: specific force is up, and its z axis down.
    values = (0, 0, 16384, round(32767 / 16), 0, -round(32767 / 16), 2550)
    data = frame(0x11, struct.pack(">ii", 100_150, 2150))
    data += frame(0x12, struct.pack(">hhh", 600, -30, -1200))
    for stamp_us in (5_000, 15_000):
        data += frame(0x13, struct.pack(">I7h", stamp_us, *values))
    baro, first, second = stream.feed(data, 1_000_000)
    assert (baro.pressure_pa, baro.temperature_degc) == (100_150.0, 21.5)
    sample = SensorChain(NodeCalibration()).imu(first)
    assert sample.accel_b_mps2 == pytest.approx((9.806, 0.0, -9.806), abs=0.01)
    assert sample.gyro_b_radps == pytest.approx((0.0, 0.0, math.radians(1000.0)), rel=1e-3)
    assert sample.mag_b_ut == pytest.approx((20.0, 1.0, 40.0), abs=0.01)
    assert sample.temperature_degc == pytest.approx(25.5, abs=0.01)
    assert not second.flags & ImuFlags.MAG_NEW, "one field, one sample"


@pytest.mark.parametrize(
    ("text", "mode", "number", "armed", "kind"),
    [
        (b"ANGL", "ANGL", 0, True, QUADROTOR),
        (b"ANGL*", "ANGL", 0, False, QUADROTOR),
        (b"ACRO!", "ACRO", 1, False, QUADROTOR),
        (b"RTH?", "RTH", 6, False, QUADROTOR),
        (b"3CRS", "3CRS", 7, True, FIXED_WING),
        (b"WAIT", "WAIT", None, False, None),
        (b"!ERR", "!ERR", None, False, None),
        (b"!FS!", "!FS!", None, None, None),
        (b"!FS!*", "!FS!", None, False, None),
        (b"FBWA", "FBWA", 5, None, FIXED_WING),
        (b"LOIT*", "LOIT", 5, False, QUADROTOR),
        (b"XYZ", "XYZ", None, None, None),
    ],
)
def test_mode_and_arming_are_read_from_the_text(
    text: bytes, mode: str, number: int | None, armed: bool | None, kind: int | None
) -> None:
    report = one(0x21, text + b"\0")
    found = (report.mode, report.custom_mode, report.armed, report.vehicle_type)
    assert found == (mode, number, armed, kind)


@pytest.mark.parametrize(
    ("before", "armed"),
    [(b"", None), (b"LOIT*", True), (b"ACRO", None), (b"ACRO?", True), (b"ANGL", True)],
)
def test_mode_without_a_mark_is_armed_if_the_firmware_has_marks(
    before: bytes, armed: bool | None
) -> None:
    *_, report = decoder().feed(frame(0x21, before + b"\0") + frame(0x21, b"STAB\0"), 0)
    assert report.armed is armed


def test_aeroplane_remains_one_in_modes_that_copters_have_too() -> None:
    stream = decoder()
    _, report = stream.feed(frame(0x21, b"CRS\0") + frame(0x21, b"ANGL\0"), 0)
    assert (report.vehicle_type, report.custom_mode) == (FIXED_WING, 5)
    assert one(0x21, b"ANGL\0", "?type=fixed_wing").custom_mode == 5


def passthrough(*packets: tuple[int, int]) -> bytes:
    packed = b"".join(struct.pack("<HI", *packet) for packet in packets)
    return frame(0x80, (b"\xf0" if len(packets) == 1 else bytes([0xF2, len(packets)])) + packed)


def test_ardupilot_frames_have_mode_type_arming_batteries_and_text() -> None:
    stream = decoder()
    parameter = (1 << 24) | FIXED_WING
    status = (10 + 1) | 1 << 8 | 63 << 19
    (report,) = stream.feed(passthrough((0x5007, parameter), (0x5001, status)), 0)
    assert (report.mode, report.custom_mode, report.armed) == ("AUTO", 10, True)
    assert report.vehicle_type == FIXED_WING
    assert report.throttle_percent == pytest.approx(100.0)
    assert stream.feed(frame(0x21, b"MANU\0"), 0) == [], "the text is coarser"
    # 12.6 V; 25 A as 25 * 10 tenths; 1500 mAh.
    battery = 126 | (25 << 1 | 1) << 9 | 1500 << 17
    (report,) = stream.feed(passthrough((0x5008, battery)), 0)
    assert (report.battery.number, report.battery.voltage_v) == (1, pytest.approx(12.6))
    assert (report.battery.current_a, report.battery.used_mah) == (pytest.approx(25.0), 1500.0)
    (report,) = stream.feed(frame(0x80, b"\xf1\x04PreArm: Compass not healthy\0"), 0)
    assert report.text == (4, "PreArm: Compass not healthy")


def test_home_of_ardupilot_is_found_from_distance_and_direction() -> None:
    stream = decoder()
    stream.feed(frame(0x02, GPS), 0)
    # 1200 m as 120 * 10, height 45 m as 45 * 10 dm, direction 90 degrees.
    home = (120 << 2 | 1) | (45 << 2 | 1) << 12 | 30 << 25
    (report,) = stream.feed(passthrough((0x5004, home)), 0)
    lat, lon, alt = report.home
    assert (lat, alt) == (pytest.approx(48.1173, abs=1e-6), pytest.approx(500.0))
    metres = (lon + 11.5167) * 111_195 * math.cos(math.radians(48.1173))
    assert metres == pytest.approx(1200.0, rel=1e-3)
    assert report.alt_home_m == pytest.approx(45.0)


FLIGHT = frame(0x1E, ATTITUDE) + frame(0x02, GPS) + frame(0x21, b"ACRO*\0") + frame(0x07, b"\0\1")


def test_frame_of_a_backpack_is_read_from_its_msp_packet() -> None:
    content = frame(0x1E, ATTITUDE)
    body = struct.pack("<BHH", 0, 0x11, len(content)) + content
    stream = make_decoder(parse_source("crsf:udp:127.0.0.1:14550"), NODE)
    found = [e for _ in range(3) for e in stream.feed(b"$X<" + body + bytes([dvb_s2(body)]), 0)]
    assert [type(each) for each in found] == [VehicleReport] * 3


def test_damaged_frame_is_one_fault_and_the_next_frame_is_read() -> None:
    damaged = bytearray(FLIGHT)
    damaged[4] ^= 0x40
    fault, *records = decoder().feed(bytes(damaged), 0)
    assert (fault.kind, fault.size) == ("checksum", len(frame(0x1E, ATTITUDE)))
    assert len(records) == 3


def test_unknown_type_and_short_payload_are_counted() -> None:
    unknown, short = decoder().feed(frame(0x60, b"abc") + frame(0x02, b"abc"), 0)
    assert (unknown.kind, short.kind) == ("unknown type", "payload")
    assert decoder().feed(frame(0x3A, b"\xea\xee\x10\x00\x00"), 0) == [], "known and not used"


def test_ltm_is_read_behind_the_same_interface() -> None:
    stream = decoder(kind="ltm")
    data = ltm(b"O", struct.pack("<iiiBB", 481000000, 115000000, 50_000, 1, 1))
    data += ltm(b"A", struct.pack("<hhh", -5, 20, 270))
    data += ltm(b"G", struct.pack("<iiBiB", 481100000, 115100000, 17, 12_300, 11 << 2 | 3))
    data += ltm(b"S", struct.pack("<HHBBB", 15_900, 420, 127, 18, 2 << 2 | 1))
    found = [e for k in range(len(data)) for e in stream.feed(data[k : k + 1], 9)]
    home, attitude, height, fix, state = found
    assert home.home == pytest.approx((48.1, 11.5, 500.0))
    assert attitude.attitude_rad == pytest.approx([math.radians(v) for v in (20, 5, 270)])
    assert height.alt_home_m == 123.0
    assert (fix.alt_amsl_m, fix.satellites) == (623.0, 11)
    assert fix.vel_n_mps[:2] == pytest.approx((0.0, -17.0), abs=1e-9)
    assert (state.mode, state.armed, state.battery.voltage_v) == ("ANGLE", True, 15.9)
    assert state.link_quality_percent == 50.0
    assert state.airspeed_mps == 18.0


@pytest.mark.parametrize(
    ("options", "schedule", "pitch_deg", "mode", "current_a"),
    [
        ("", b"ASAGASAGASAG", -12, "STABILIZED1", math.nan),
        ("", b"ASOAGASAGASAG", -12, "STABILIZED1", math.nan),
        ("", b"SAGASAGASAGAGASAGASAGAGAS", 12, "LOITER", 4.2),
        ("", b"SAGASAGASAGAGASAGASAGAGAOAS", -12, "STABILIZED1", math.nan),
        ("?pitch=up", b"ASAG", 12, "STABILIZED1", math.nan),
    ],
    ids=["INAV", "Betaflight", "ArduPilot", "losses of INAV", "set"],
)
def test_ltm_of_ardupilot_is_recognised_by_its_schedule(
    options: str, schedule: bytes, pitch_deg: float, mode: str, current_a: float
) -> None:
    payloads = {
        b"A": struct.pack("<hhh", 12, 0, 0),
        b"S": struct.pack("<HHBBB", 12_600, 420, 0, 0, 5 << 2),
        b"G": struct.pack("<iiBiB", 481100000, 115100000, 17, 0, 11 << 2 | 3),
        b"O": struct.pack("<iiiBB", 481000000, 115000000, 0, 1, 1),
    }
    kinds = [schedule[k : k + 1] for k in range(len(schedule))]
    data = b"".join(ltm(kind, payloads[kind]) for kind in [*kinds, b"S", b"A"])
    *_, state, attitude = decoder(options, kind="ltm").feed(data, 0)
    assert attitude.attitude_rad[1] == pytest.approx(math.radians(pitch_deg))
    assert (state.mode, state.battery.current_a) == (mode, pytest.approx(current_a, nan_ok=True))
    assert math.isnan(state.link_quality_percent), "0 means that it is not measured"


def test_wanted_type_is_that_of_crsf_and_ltm_and_must_exist() -> None:
    stream = decoder("?type=fixed_wing", kind="ltm")
    (state,) = stream.feed(ltm(b"S", struct.pack("<HHBBB", 0, 0, 0, 0, 2 << 2)), 0)
    assert (state.vehicle_type, state.custom_mode) == (FIXED_WING, 5)
    for kind in ("ltm", "crsf"):
        with pytest.raises(ValueError, match="no MAV_TYPE 'plane'"):
            decoder("?type=plane", kind=kind)
