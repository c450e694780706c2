"""The record of an autopilot as MAVLink: its rows, state, parameters, mission and texts."""

import json
import math
import random
import struct
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from gateway.answers.log_answers import VehicleAnswers
from gateway.geometry.quaternion import from_euler
from gateway.recordings.autopilot_record import RecordTranslator
from gateway.recordings.files import FlightError
from gateway.recordings.message_table import UNITS
from gateway.recordings.opening import open_flights
from gateway.recordings.recording import open_recording
from gateway.recordings.summary import FileInfo, read_summary
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from gateway.wire.recorded_frames import RecordedFrame, fields_of
from gateway.wire.vehicle_types import mode_name
from tests.kit.cli import run
from tests.kit.recordings import messages_of as vehicle_messages
from tests.kit.recordings import read_tlog
from tests.recordings.flights import OPTIONS
from tests.recordings.formats import flown

pytestmark = pytest.mark.io

BEGIN_US = 60_000_000
FORMATS: dict[str, flown.Format] = {
    "PARM": (129, "QNf", "TimeUS,Name,Value"),
    "IMU": (130, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "ATT": (135, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "POS": (136, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "XKF1": (137, "QBfff", "TimeUS,C,VN,VE,VD"),
    "XKF4": (138, "QBcccccIb", "TimeUS,C,SV,SP,SH,SM,SVT,SS,PI"),
    "MODE": (139, "QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "ARM": (140, "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method"),
    "MSG": (141, "QZ", "TimeUS,Message"),
    "CMD": (142, "QHHHffffLLfB",
            "TimeUS,CTot,CNum,CId,Prm1,Prm2,Prm3,Prm4,Lat,Lng,Alt,Frame"),
    "BAT": (143, "QBfffff", "TimeUS,Inst,Volt,VoltR,Curr,CurrTot,Temp"),
    "CTUN": (144, "Qfh", "TimeUS,ThO,CRt"),
    "ORGN": (145, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "ODD": (146, "QB", "TimeUS,Value"),
}  # fmt: skip
GYRO, ACCEL = (0.01, -0.02, 0.03), (0.5, -0.25, -9.75)


def rows(seconds: float = 4.0) -> list[flown.Row]:
    """A flight north at 3 m/s with a bank of 10 deg, armed and in LOITER after 2 s."""
    found: list[flown.Row] = [
        ("PARM", (BEGIN_US, b"SYSID_THISMAV", 7.0)),
        ("PARM", (BEGIN_US, b"FRAME_CLASS", 2.0)),
        ("PARM", (BEGIN_US, b"BATT_CAPACITY", 5000.0)),
        ("MSG", (BEGIN_US, b"ArduCopter V4.5.7 (2a3dc4b7)")),
        ("MODE", (BEGIN_US, 0, 0, 1)),
        ("CMD", (BEGIN_US, 2, 0, 16, 0, 0, 0, 0, 47.3977, 8.5456, 488.0, 0)),
        ("CMD", (BEGIN_US, 2, 1, 22, 15, 0, 0, math.nan, 0, 0, 20.0, 3)),
        ("ORGN", (BEGIN_US, 1, 47.3977, 8.5456, 488.0)),
        ("ORGN", (BEGIN_US, 0, 47.4, 8.5, 480.0)),
    ]
    for number in range(round(seconds * 10)):
        t = BEGIN_US + 1000 + number * 100_000
        if number == 20:
            found += [("ARM", (t, 1, 0, 0, 0)), ("MODE", (t, 5, 5, 1))]
            found += [("PARM", (t, b"FRAME_CLASS", 1.0))]
            found += [("CMD", (t, 2, 1, 22, 15, 0, 0, math.nan, 0, 0, 20.0, 3))]
            found += [("MSG", (t, b"a text that is longer than the fifty bytes of a STATUSTEXT"))]
        found += [
            ("IMU", (t, 0, *GYRO, *ACCEL, 0, 0, 35.0, 1, 1, 400, 400)),
            ("IMU", (t, 1, *GYRO, *ACCEL, 0, 0, 36.0, 1, 1, 400, 400)),
            ("XKF1", (t, 0, 99.0, 99.0, 99.0)),
            ("XKF1", (t, 1, 3.0, 0.0, -0.5)),
            ("XKF4", (t, 0, 0.1, 0.2, 0.3, 0.4, 0.0, 831 | 1 << 13, 1)),
            ("XKF4", (t, 1, 0.2, 0.2, 0.3, 0.4, 0.0, 831, 1)),
            ("ATT", (t, 0, 10.0, 0, -2.0, 0, 359.99)),
            ("POS", (t, 47.3977418, 8.5455939, 500.25, 12.25, 12.0)),
            ("BAT", (t, 0, 15.8, 15.9, 12.5, 1250.0, 30.0)),
            ("BAT", (t, 1, 12.4, 12.4, 0.5, 100.0, 0.0)),
            ("CTUN", (t, 0.45, 50)),
            ("ODD", (t, 1)),
        ]
    return found


def write(path: Path, extra: Sequence[flown.Row] = (), formats: dict[str, Any] = FORMATS) -> Path:
    return flown.write(path, flown.dataflash_of(formats, [*extra, *rows()]))


def info_of(path: Path) -> FileInfo:
    return read_summary(open_recording(path), None, lambda: OPTIONS).info


def translated(path: Path) -> list[RecordedFrame]:
    return list(RecordTranslator(open_recording(path).log(OPTIONS)).frames())


def messages_of(records: Sequence[RecordedFrame], name: str) -> list[dict[str, Any]]:
    wanted = MESSAGE_IDS[name]
    return [fields_of(one.frame) for one in records if message_id_of(one.frame) == wanted]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[RecordedFrame]:
    return translated(write(tmp_path_factory.mktemp("log") / "flight.bin"))


EXPECTED: dict[str, dict[str, float]] = {
    "ATTITUDE": {
        "roll": math.radians(10), "pitch": math.radians(-2), "yaw": math.radians(-0.01),
        "rollspeed": 0.01, "yawspeed": 0.03, "time_boot_ms": 60_001,
    },
    "ATTITUDE_QUATERNION": {"q1": 0.996, "q2": 0.0871, "q3": -0.0174},
    "GLOBAL_POSITION_INT": {
        "lat": 473977418, "lon": 85455939, "alt": 500250, "relative_alt": 12250,
        "vx": 300, "vy": 0, "vz": -50, "hdg": 35999,
    },
    "VFR_HUD": {
        "groundspeed": 3.0, "heading": 0, "throttle": 45, "alt": 500.25, "climb": 0.5,
    },
    "BATTERY_STATUS": {
        "id": 0, "current_battery": 1250, "current_consumed": 1250, "battery_remaining": 75,
        "temperature": 3000,
    },
    "SYS_STATUS": {"voltage_battery": 15800, "current_battery": 1250, "battery_remaining": 75},
    "EKF_STATUS_REPORT": {"flags": 831, "velocity_variance": 0.2, "compass_variance": 0.4},
    "SCALED_IMU": {"xacc": 51, "zacc": -994, "xgyro": 10, "temperature": 3500},
    "SCALED_IMU2": {"xacc": 51, "temperature": 3600},
    "HOME_POSITION": {"latitude": 473977000, "longitude": 85456000, "altitude": 488000},
    "GPS_GLOBAL_ORIGIN": {"latitude": 474000000, "altitude": 480000},
    "LOCAL_POSITION_NED": {"vx": 3.0, "vz": -0.5},
}  # fmt: skip


@pytest.mark.parametrize("name", EXPECTED)
def test_row_becomes_message_in_its_units(records: list[RecordedFrame], name: str) -> None:
    found = messages_of(records, name)
    last = found[-1] if name in ("VFR_HUD", "SYS_STATUS", "LOCAL_POSITION_NED") else found[0]
    for field, value in EXPECTED[name].items():
        assert last[field] == pytest.approx(value, abs=2e-4), field


def test_every_row_is_sent_once_with_its_own_time(records: list[RecordedFrame]) -> None:
    times = [one["time_boot_ms"] for one in messages_of(records, "ATTITUDE")]
    assert times == [60_001 + 100 * number for number in range(40)]
    stamps = [one.time_us for one in records]
    assert stamps == sorted(set(stamps))


def test_capacity_of_the_first_battery_is_not_that_of_the_second(
    records: list[RecordedFrame],
) -> None:
    batteries = messages_of(records, "BATTERY_STATUS")
    assert [one["id"] for one in batteries] == [0, 1] * 40
    assert {one["battery_remaining"] for one in batteries if one["id"] == 1} == {-1}


def test_heartbeat_shows_type_armed_state_and_mode(records: list[RecordedFrame]) -> None:
    beats = messages_of(records, "HEARTBEAT")
    assert {(one["type"], one["autopilot"]) for one in beats} == {(13, 3)}
    assert (beats[0]["base_mode"] & 128, beats[0]["custom_mode"]) == (0, 0)
    assert (beats[-1]["base_mode"] & 128, beats[-1]["custom_mode"]) == (128, 5)
    assert {origin_of(one.frame) for one in records} == {(7, 1)}
    modes = messages_of(records, "AVAILABLE_MODES")
    assert {one["custom_mode"]: one["mode_name"] for one in modes}[5] == b"LOITER"


def test_texts_come_whole(records: list[RecordedFrame]) -> None:
    assert [found.text.text for found in vehicle_messages(records) if found.text] == [
        "ArduCopter V4.5.7 (2a3dc4b7)",
        "a text that is longer than the fifty bytes of a STATUSTEXT",
    ]


def test_item_that_is_known_is_the_current_one(records: list[RecordedFrame]) -> None:
    assert [one["seq"] for one in messages_of(records, "MISSION_CURRENT")] == [1]
    assert len(messages_of(records, "MISSION_COUNT")) == 1


def test_parameters_and_mission_are_answered_as_of_the_played_moment(tmp_path: Path) -> None:
    path = write(tmp_path / "flight.bin")
    with ExitStack() as opened:
        (flight,) = open_flights([path], OPTIONS, opened)
        source = flight.sources[0]
        while not source.prepare(1 << 62):
            pass
        moment = source.index.first_us or 0
        for at_us, frame_class in ((moment, 2.0), (moment + 3_000_000, 1.0)):
            answers = VehicleAnswers(flight.answers, 7, 7, lambda at_us=at_us: at_us)
            frames = answers.parameters()
            values = {name: fields_of(frame)["param_value"] for name, frame in frames.items()}
            expected = {"SYSID_THISMAV": 7.0, "BATT_CAPACITY": 5000.0, "FRAME_CLASS": frame_class}
            assert values == expected
            items = [fields_of(frame) for frame in answers.mission(0) or ()]
            assert [(one["command"], one["x"], one["z"]) for one in items] == [
                (16, 473977000, 488.0),
                (22, 0, 20.0),
            ]


TEXT_FORMATS = """\
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 3, 6, MODE, Mh, Mode,ThrCrs
FMT, 9, 23, ATT, IccccCCCC, TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw
FMT, 134, 67, MSG, Z, Message
"""
COPTER, PLANE = (2, [0, 5, 9]), (1, [0, 5, 9])
TEXT_LOGS = {
    "title line and numbers": ("ArduCopter V3.2.1 (36b405fb)\n", ["0", "5", "9"], COPTER),
    "title line and names": ("ArduCopter V3.2.1\n", ["STABILIZE", "Loiter", "LAND"], COPTER),
    "text and numbers": ("MSG, ArduPlane V3.5\n", ["0", "5", "9"], PLANE),
    "names of one firmware": ("", ["STABILIZE", "AltHold", "Mode(99)", "LAND"], (2, [0, 2, 99, 9])),
    "former names": ("ArduPlane V2.7\n", ["MANUAL", "FLY_BY_WIRE_A"], (1, [0, 5])),
    "names of several firmwares": ("", ["AUTO", "RTL"], (0, [0])),
    "numbers without a firmware": ("", ["0", "5", "9"], (0, [0, 5, 9])),
}
"""Lines before the data, modes, and the expected MAV_TYPE and custom modes."""


@pytest.mark.parametrize("name", TEXT_LOGS)
def test_text_log_has_type_and_modes_of_its_firmware(tmp_path: Path, name: str) -> None:
    head, modes, (mav_type, expected) = TEXT_LOGS[name]
    lines = [TEXT_FORMATS + head]
    for number, mode in enumerate(modes):
        at = f"ATT, {60_000 + 2000 * number}, 0.00, 0.50, 0.00, -0.73, 66.63, 66.08, 0.1, 0.2\n"
        lines += [f"MODE, {mode}, 430\n", at]
    records = translated(flown.write(tmp_path / "flight.log", "".join(lines).encode()))
    beats = messages_of(records, "HEARTBEAT")
    assert {beat["type"] for beat in beats} == {mav_type}
    assert list(dict.fromkeys(beat["custom_mode"] for beat in beats)) == expected
    names = {mode_name(3, mav_type, number) for number in expected}
    assert (names == {""}) == (mav_type == 0)


PLAN_FORMATS = FORMATS | {
    "PARM": (129, "QNff", "TimeUS,Name,Value,Default"),
    "FNCE": (147, "QBBBLLBf", "TimeUS,Tot,Seq,Type,Lat,Lng,Count,Radius"),
    "RALY": (148, "QBBLLhB", "TimeUS,Tot,Seq,Lat,Lng,Alt,Flags"),
}


def write_with_plans(path: Path) -> Path:
    corners = [(47.39, 8.54), (47.40, 8.54), (47.40, 8.55)]
    plans = [
        *(("FNCE", (BEGIN_US, 4, k, 98, *at, 3, 0.0)) for k, at in enumerate(corners)),
        ("FNCE", (BEGIN_US, 4, 3, 92, 47.39, 8.54, 0, 150.0)),
        ("RALY", (BEGIN_US, 1, 0, 47.391, 8.541, 30, 4)),
    ]
    parameters = [("PARM", (*row[1], 8.0)) for row in rows() if row[0] == "PARM"]
    others = [row for row in rows() if row[0] != "PARM"]
    return flown.write(path, flown.dataflash_of(PLAN_FORMATS, [*plans, *parameters[:3], *others]))


def test_plans_texts_and_parameters_of_a_log_are_extracted(tmp_path: Path) -> None:
    path, plan = write_with_plans(tmp_path / "flight.bin"), tmp_path / "flight.plan"
    texts, params = tmp_path / "texts.csv", tmp_path / "flight.param"
    run("extract", path, "--mission", plan, "--texts", texts, "--params", params)
    found = json.loads(plan.read_text())
    assert [one["command"] for one in found["mission"]["items"]] == [22]
    ((polygon,), (circle,)) = found["geoFence"]["polygons"], found["geoFence"]["circles"]
    assert polygon["polygon"] == [[47.39, 8.54], [47.4, 8.54], [47.4, 8.55]]
    assert circle["circle"] == {"center": [47.39, 8.54], "radius": 150.0}
    assert found["rallyPoints"]["points"] == [[47.391, 8.541, 30.0]]
    assert "a text that is longer than the fifty bytes" in texts.read_text()
    assert "BATT_CAPACITY,5000\n" in params.read_text()


def test_units_of_the_log_go_before_those_of_the_table(tmp_path: Path) -> None:
    formats = FORMATS | {
        "FMTU": (200, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
        "UNIT": (201, "QbZ", "TimeUS,Id,Label"),
        "MULT": (202, "Qbd", "TimeUS,Id,Mult"),
    }
    formats["BAT"] = (143, "QBfffff", "TimeUS,Inst,Volt,VoltR,Curr,CurrTot,Temp")
    units = [
        ("UNIT", (BEGIN_US, ord("v"), b"V")), ("MULT", (BEGIN_US, ord("C"), 1e-3)),
        ("MULT", (BEGIN_US, ord("-"), 0.0)),
        ("FMTU", (BEGIN_US, 143, b"s#v----", b"--C----")),
    ]  # fmt: skip
    path = write(tmp_path / "units.bin", units, formats)
    first = messages_of(translated(path), "BATTERY_STATUS")[0]
    assert first["voltages"][0] == 16  # 15.8 mV by the log's own unit


def test_current_of_later_firmware_is_in_volts_and_amperes(tmp_path: Path) -> None:
    found = {}
    for letters, values in (("Qhhf", (1580, 1250, 500.0)), ("Qfff", (15.8, 12.5, 500.0))):
        formats = FORMATS | {"CURR": (143, letters, "TimeUS,Volt,Curr,CurrTot")}
        formats.pop("BAT")
        kept: list[flown.Row] = [row for row in rows() if row[0] != "BAT"]
        kept.append(("CURR", (BEGIN_US + 4_100_000, *values)))
        path = flown.write(tmp_path / f"{letters}.bin", flown.dataflash_of(formats, kept))
        (found[letters],) = messages_of(translated(path), "BATTERY_STATUS")
    for battery in found.values():
        assert (battery["voltages"][0], battery["current_battery"]) == (15800, 1250)


PX4_FORMATS = {
    "vehicle_status": "uint64_t timestamp;uint8_t nav_state;uint8_t arming_state;"
    "uint8_t system_type;",
    "vehicle_attitude": flown.FORMATS["vehicle_attitude"],
    "vehicle_global_position": flown.FORMATS["vehicle_global_position"],
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;"
    "float vz;",
    "home_position": "uint64_t timestamp;double lat;double lon;float alt;",
    "vehicle_gps_position": flown.OLD_GPS,
    "battery_status": "uint64_t timestamp;float voltage_v;float current_a;float remaining;",
    "cpuload": "uint64_t timestamp;float load;",
    "odd_topic": "uint64_t timestamp;float value;",
}


def px4_log(seconds: float = 4.0, *, home_s: float = 0.0, text_s: float = 2.0) -> bytes:
    """The same flight by PX4, in HOLD and armed after 2 s, with the times of home and of a text."""
    log = flown.Ulog(PX4_FORMATS, {"MAV_SYS_ID": 7})
    roll, yaw = math.radians(10.0), math.radians(-0.01)
    q = from_euler(roll, math.radians(-2.0), yaw)
    utc_us = 1_780_000_000_000_000
    log.add("home_position", round(home_s * 1e6), 47.3977, 8.5456, 488.0)
    for number in range(round(seconds * 10)):
        t = 1000 + number * 100_000
        if number in (0, 20):
            log.add("vehicle_status", t, *((0, 1, 13) if number == 0 else (4, 2, 13)))
        if number == 20:
            text_us = flown.BOOT_US + round(text_s * 1e6)
            text = struct.pack("<BQ", ord("4"), text_us) + b"Low battery"
            log.parts.append(flown.ulog_message(b"L", text))
        log.add("vehicle_local_position", t, 1.0, 2.0, -12.25, 3.0, 0.0, -0.5)
        log.add("battery_status", t, 15.8, 12.5, 0.75)
        log.add("cpuload", t, 0.25)
        log.add("odd_topic", t, 1.0)
        fix = (473977418, 85455939, 500250, 547000, 0.2, 0.1, 1.5, 2.5, 0.8, 1.1)
        motion = (3.0, 3.0, 0.0, -0.5)
        log.add("vehicle_gps_position", t, utc_us + t, *fix, *motion, 0, 3, True, 14)
        log.add("vehicle_attitude", t, *q)
        log.add("vehicle_global_position", t, 47.3977418, 8.5455939, 500.25, 1.0)
    return b"".join(log.parts)


def test_receiver_without_a_fix_is_replaced_by_the_one_with_fixes(tmp_path: Path) -> None:
    fields = PX4_FORMATS["vehicle_gps_position"]
    log = flown.Ulog({"vehicle_gps_position": fields, "sensor_gps": fields}, {})
    for number in range(10):
        fix = (473977418 + number, 85455939, 500250, 547000, 0.2, 0.1, 1.5, 2.5, 0.8, 1.1)
        motion = (3.0, 3.0, 0.0, -0.5)
        t, utc_us = 1000 + number * 100_000, 1_780_000_000_000_000
        nothing = [0] * len(fix), [0] * len(motion)
        log.add("vehicle_gps_position", t, 0, *nothing[0], *nothing[1], 0, 0, False, 0)
        log.add("sensor_gps", t, utc_us + t, *fix, *motion, 0, 3, True, 14)
    records = translated(flown.write(tmp_path / "flight.ulg", b"".join(log.parts)))
    fixes = messages_of(records, "GPS_RAW_INT")
    assert [(one["fix_type"], one["lat"]) for one in fixes] == [
        (3, 473977418 + number) for number in range(10)
    ]
    assert len(messages_of(records, "GLOBAL_POSITION_INT")) == 10


PX4_EXPECTED: dict[str, dict[str, float]] = {
    "ATTITUDE": {"roll": math.radians(10), "pitch": math.radians(-2), "yaw": math.radians(-0.01)},
    "GLOBAL_POSITION_INT": EXPECTED["GLOBAL_POSITION_INT"],
    "LOCAL_POSITION_NED": {"x": 1.0, "z": -12.25, "vx": 3.0},
    "GPS_RAW_INT": {
        "lat": 473977418, "alt": 500250, "alt_ellipsoid": 547000, "eph": 80, "vel": 300,
        "h_acc": 1500, "satellites_visible": 14, "fix_type": 3,
    },
    "VFR_HUD": {"groundspeed": 3.0, "heading": 0, "alt": 500.25, "climb": 0.5},
    "BATTERY_STATUS": {"id": 0, "current_battery": 1250, "battery_remaining": 75},
    "SYS_STATUS": {"voltage_battery": 15800, "load": 250, "battery_remaining": 75},
    "HOME_POSITION": {"latitude": 473977000, "altitude": 488000},
}  # fmt: skip


@pytest.fixture(scope="module")
def px4_records(tmp_path_factory: pytest.TempPathFactory) -> list[RecordedFrame]:
    path = flown.write(tmp_path_factory.mktemp("log") / "flight.ulg", px4_log())
    log = open_recording(path).log(OPTIONS)
    assert log.lacks == "messages without a counterpart in MAVLink: odd_topic 40"
    return list(RecordTranslator(log).frames())


@pytest.mark.parametrize("name", PX4_EXPECTED)
def test_row_of_ulog_becomes_message_in_its_units(
    px4_records: list[RecordedFrame], name: str
) -> None:
    last = messages_of(px4_records, name)[-1]
    for field, value in PX4_EXPECTED[name].items():
        assert last[field] == pytest.approx(value, abs=2e-4), field


def test_state_of_px4_is_shown_with_its_mode(px4_records: list[RecordedFrame]) -> None:
    beats = messages_of(px4_records, "HEARTBEAT")
    assert {(one["type"], one["autopilot"]) for one in beats} == {(13, 12)}
    assert beats[0]["base_mode"] & 128 == 0
    assert beats[-1]["base_mode"] & 128 == 128
    modes = messages_of(px4_records, "AVAILABLE_MODES")
    names = {one["custom_mode"]: one["mode_name"] for one in modes}
    assert [names[beats[at]["custom_mode"]] for at in (0, -1)] == [b"Manual", b"Hold"]
    (text,) = messages_of(px4_records, "STATUSTEXT")
    assert (text["severity"], text["text"]) == (4, b"Low battery")
    (value,) = messages_of(px4_records, "PARAM_VALUE")
    assert struct.pack("<f", value["param_value"]) == struct.pack("<i", 7)
    assert messages_of(px4_records, "SYSTEM_TIME")[0]["time_unix_usec"] >= 1_780_000_000_000_000


@pytest.mark.parametrize(
    "times",
    [{"home_s": -3.0}, {"home_s": 1150.0}, {"text_s": -3.0}, {"text_s": 1150.0}],
    ids=["value of before the log", "value of another boot", "early text", "text of a wrong time"],
)
def test_value_with_a_time_outside_the_log_does_not_lengthen_it(
    tmp_path: Path, times: dict[str, float]
) -> None:
    path = flown.write(tmp_path / "flight.ulg", px4_log(**times))
    info = info_of(path)
    assert 3.8 < info.duration_s < 5.0
    assert not info.gaps
    records = translated(path)
    assert messages_of(records, "STATUSTEXT")[0]["text"] == b"Low battery"
    assert messages_of(records, "HOME_POSITION")[0]["latitude"] == 473977000


@pytest.mark.parametrize("name", ["flight.bin", "flight.ulg"])
def test_log_and_the_tlog_made_of_it_have_the_same_summary(tmp_path: Path, name: str) -> None:
    log, tlog = tmp_path / name, tmp_path / "made.tlog"
    flown.write(log, px4_log()) if log.suffix == ".ulg" else write(log)
    run("convert", log, "-o", tlog)
    found, made = map(info_of, (log, tlog))
    assert found.records > 100
    assert replace(found, kind="", size=0, remarks=()) == replace(made, kind="", size=0, remarks=())


def test_tlog_has_own_estimates_fused_ones_or_both(tmp_path: Path) -> None:
    path = flown.write(tmp_path / "flight.bin", flown.make_dataflash(20.0))
    origins = {}
    for words in ("convert", "fuse", "fuse --beside"):
        out = tmp_path / f"{words}.tlog"
        run(*words.split(), path, "-o", out)
        found = read_tlog(out)
        origins[words] = {origin_of(one.frame)[0] for one in found}
        assert messages_of(found, "ATTITUDE")
    assert origins == {"convert": {9}, "fuse": {9}, "fuse --beside": {9, 10}}


def test_damaged_log_gives_what_is_intact(tmp_path: Path) -> None:
    data = flown.dataflash_of(FORMATS, rows())
    path = flown.write(tmp_path / "cut.bin", data[:-700])
    log = open_recording(path).log(OPTIONS)
    found = list(RecordTranslator(log).frames())
    assert len(messages_of(found, "ATTITUDE")) > 30
    assert any("ends within a message" in remark for remark in log.remarks)


@pytest.mark.parametrize("part", [0.3, 0.6, 0.9])
def test_damage_of_whole_blocks_loses_no_message_around_it(tmp_path: Path, part: float) -> None:
    data = flown.dataflash_of(FORMATS, rows())
    at = data.index(b"\xa3\x95", round(len(data) * part))
    bits = random.Random(1)
    # Some of the damage looks like messages of known and unknown types.
    heads = [b"\xa3\x95" + bytes([kind]) + bits.randbytes(300) for kind in range(256)]
    damage = bits.randbytes(2000) + b"".join(heads)
    sound = flown.write(tmp_path / "sound.bin", data)
    damaged = flown.write(tmp_path / "damaged.bin", data[:at] + damage + data[at:])
    found, whole = map(info_of, (damaged, sound))
    assert any(f"left out {len(damage)} bytes" in remark for remark in found.remarks)
    kept = replace(found, size=whole.size, remarks=whole.remarks)
    assert kept == whole


@pytest.mark.parametrize("value", [math.nan, 0.0, 300.0])
def test_invalid_system_id_in_a_parameter_is_replaced_by_1(tmp_path: Path, value: float) -> None:
    parameter = ("PARM", (BEGIN_US, b"SYSID_THISMAV", value))
    path = flown.write(tmp_path / "a.bin", flown.dataflash_of(FORMATS, [*rows(), parameter]))
    assert open_recording(path).log(OPTIONS).vehicle_id == 1


def test_log_without_a_whole_message_is_refused(tmp_path: Path) -> None:
    path = flown.write(tmp_path / "a.bin", b"\xa3\x95~\0")
    with pytest.raises(FlightError, match=r"nothing to play: it has no list of formats \(FMT\)"):
        open_recording(path).log(OPTIONS)


def test_log_without_rows_is_refused(tmp_path: Path) -> None:
    path = flown.write(tmp_path / "empty.bin", flown.dataflash_of(FORMATS, []))
    with pytest.raises(FlightError, match="nothing to play"):
        open_recording(path).log(OPTIONS)


@pytest.mark.parametrize("name", ["dataflash", "ulog"])
def test_tables_name_fields_of_the_dialect_and_known_units(name: str) -> None:
    table = import_module(f"gateway.recordings.formats.{name}_record").table()
    for row in table.messages:
        definition = DEFINITIONS[MESSAGE_IDS[row.name]]
        lengths = dict(zip(definition.ordered_fieldnames, definition.array_lengths, strict=True))
        for key, values in row.fields.items():
            field, _, element = key.partition(".")
            assert field in definition.fieldnames, f"{row.name}.{key}"
            assert not element or int(element) < lengths[field]
            unit = definition.fieldunits_by_name.get(field, "")
            for source in (s for v in values if not v.function for s in v.sources):
                if source.quantity:
                    assert UNITS[unit][0] == source.quantity, f"{row.name}.{key}"
