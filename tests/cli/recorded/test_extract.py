"""`mavgate extract`: each file is read back by the program it is for, or by its rules."""

import csv
import json
import re
import struct
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavparm, mavwp
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings import files
from gateway.recordings.recording import open_recording
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.recordings.workshop.extracts import parameter_text
from tests.kit.cli import invoke, run
from tests.kit.mavlink import Sender
from tests.kit.recordings import START_US, make_records, records_of, write_tlog
from tests.recordings.flights import OPTIONS

pytestmark = pytest.mark.io

LAT, LON = 47.1234567, 8.7654321
E7 = (round(LAT * 1e7), round(LON * 1e7))
HOME = (471_000_000, 87_000_000)


def item(
    seq: int, kind: int, command: int, at: tuple[int, int], z: float, param1: float = 0
) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        255, 190, seq, 3, command, 0, 1, param1, 0, 0, float("nan"), *at, z, kind
    )


def flight(autopilot: int = 3) -> list[Any]:
    """Return the messages of a flight, one every 100 ms."""
    beat = mavlink.MAVLink_heartbeat_message(2, autopilot, 128, 5, 4, 3)
    disarmed = mavlink.MAVLink_heartbeat_message(2, autopilot, 0, 6, 4, 3)
    found = [
        beat,
        mavlink.MAVLink_param_value_message(b"WPNAV_SPEED", 512.5, 9, 3, 0),
        mavlink.MAVLink_param_value_message(b"ARMING_CHECK", 1.0, 6, 3, 1),
        mavlink.MAVLink_param_value_message(b"ATC_RAT_RLL_P", 0.135, 9, 3, 2),
        mavlink.MAVLink_param_value_message(b"WPNAV_SPEED", 600.0, 9, 3, 0),
        mavlink.MAVLink_home_position_message(*HOME, 500_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0),
        mavlink.MAVLink_mission_count_message(255, 190, 3, 0),
        item(0, 0, 16, HOME, 500.0),
        item(1, 0, 22, E7, 20.0),
        item(2, 0, 16, (E7[0] + 1000, E7[1]), 50.0),
        mavlink.MAVLink_mission_count_message(255, 190, 4, 1),
        *(item(k, 1, 5001, (E7[0] + k, E7[1]), 0.0, 3.0) for k in range(3)),
        item(3, 1, 5003, E7, 0.0, 120.0),
        mavlink.MAVLink_mission_count_message(255, 190, 1, 2),
        item(0, 2, 5100, E7, 30.0),
        mavlink.MAVLink_statustext_message(6, "Höhe, 5 \"m\"".encode()),
        mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12_600, 0, 87, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_camera_feedback_message(
            START_US, 1, 0, 7, *E7, 550.0, 50.0, 1.0, 2.0, 3.0, 0.0, 0),
        mavlink.MAVLink_camera_image_captured_message(
            1, START_US, 1, *E7, 550_000, 50_000, [1, 0, 0, 0], 8, 1, b"DCIM/8.jpg"),
        mavlink.MAVLink_mission_item_reached_message(2),
    ]  # fmt: skip
    positions = [
        mavlink.MAVLink_global_position_int_message(
            k, E7[0] + 1000 * k, E7[1], 550_000, 50_000, 300, 400, 0, 0)
        for k in range(40)
    ]  # fmt: skip
    return [*found, *positions, disarmed]


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    return written(tmp_path, flight())


def written(folder: Path, messages: list[Any]) -> Path:
    frames = map(Sender().pack, messages)
    return write_tlog(folder / "flight.tlog", records_of(frames, 100_000))


def test_parameters_are_read_by_pymavlink(tlog: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.param"
    run("extract", tlog, "--params", out)
    read = mavparm.MAVParmDict()
    assert read.load(str(out))
    assert dict(read) == pytest.approx(
        {"WPNAV_SPEED": 600.0, "ARMING_CHECK": 1, "ATC_RAT_RLL_P": 0.135}
    )
    assert "ATC_RAT_RLL_P,0.135\n" in out.read_text()


def test_integers_that_px4_sends_bytewise_are_read_as_integers(tmp_path: Path) -> None:
    (value,) = struct.unpack("<f", struct.pack("<i", 123_456))
    messages = [
        mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3),
        mavlink.MAVLink_param_value_message(b"COM_X", value, 6, 1, 0),
    ]
    run("extract", written(tmp_path, messages), "--params", tmp_path / "a.param")
    assert (tmp_path / "a.param").read_text() == "COM_X,123456\n"


@pytest.mark.parametrize(
    ("value", "text"), [(0.1, "0.1"), (1e-7, "1e-07"), (3.0, "3"), (16777217.5, "16777218")]
)
def test_parameter_is_written_with_the_digits_of_a_float(value: float, text: str) -> None:
    assert parameter_text(float(np.float32(value))) == text


@pytest.mark.parametrize(("option", "count"), [("--mission", 3), ("--fence", 4), ("--rally", 1)])
def test_waypoints_are_read_by_pymavlink(
    tlog: Path, tmp_path: Path, option: str, count: int
) -> None:
    out = tmp_path / "flight.waypoints"
    run("extract", tlog, option, out)
    loader = mavwp.MAVWPLoader()
    assert loader.load(str(out)) == count
    last = loader.wp(count - 1)
    assert last.x == pytest.approx(LAT, abs=2e-4)
    assert last.y == pytest.approx(LON, abs=1e-7)


def test_plan_follows_the_rules_of_qgroundcontrol(tlog: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.plan"
    run("extract", tlog, "--mission", out)
    plan = json.loads(out.read_text(), parse_constant=lambda name: pytest.fail(name))
    assert (plan["fileType"], plan["version"]) == ("Plan", 1)
    assert {"mission", "geoFence", "rallyPoints"} <= set(plan)
    mission = plan["mission"]
    assert mission["version"] == 2
    assert mission["plannedHomePosition"] == pytest.approx([47.1, 8.7, 500.0])
    assert [each["command"] for each in mission["items"]] == [22, 16]
    for each in mission["items"]:
        assert each["type"] == "SimpleItem"
        assert len(each["params"]) == 7
        assert each["params"][3] is None
    (polygon,) = plan["geoFence"]["polygons"]
    assert (polygon["inclusion"], polygon["version"]) == (True, 1)
    assert polygon["polygon"] == [pytest.approx([LAT + k * 1e-7, LON], abs=1e-9) for k in range(3)]
    (circle,) = plan["geoFence"]["circles"]
    assert circle["circle"] == {"center": pytest.approx([LAT, LON]), "radius": 120.0}
    assert plan["rallyPoints"]["points"] == [[pytest.approx(LAT), pytest.approx(LON), 30.0]]


def captured(number: int, utc_us: int, lat: int = E7[0], name: bytes = b"") -> Any:
    at = (lat, E7[1] if lat else 0)
    return mavlink.MAVLink_camera_image_captured_message(
        1, utc_us, 1, *at, 550_000, 50_000, [1, 0, 0, 0], number, 1, name)  # fmt: skip


def test_each_image_of_any_camera_is_one_row_at_its_own_time(tmp_path: Path) -> None:
    second, camera = 1_000_000, Sender(component=100)
    sent = [
        *(captured(k, START_US + k * second) for k in (0, 2, 1, 0)), captured(0, 0, E7[0] + 1),
        captured(0, 0, E7[0] + 1), captured(3, START_US + 3 * second, 0, b"=1+1\x1b"),
    ]  # fmt: skip
    beat = Sender().pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
    records = records_of([beat, *map(camera.pack, sent)], 10 * second)
    path, out = write_tlog(tmp_path / "a.tlog", records), tmp_path / "images.csv"
    run("extract", path, "--images", out)
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [(int(row["image"]), row["time"][-7:]) for row in rows] == [
        *((k, f"2{k}.000Z") for k in (0, 1, 2, 3)), (0, "10.000Z"),
    ]  # fmt: skip
    assert (rows[3]["lat_deg"], rows[3]["alt_amsl_m"], rows[3]["file"]) == ("", "", "'=1+1\\x1b")


def test_unknown_numbers_and_hostile_names_stay_data(tmp_path: Path) -> None:
    nan, unknown = float("nan"), (1 << 31) - 1
    messages = [
        mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3),
        mavlink.MAVLink_param_value_message(b"A\nB,1\x1b", 1.0, 9, 2, 0),
        mavlink.MAVLink_param_value_message(b"=C", 2.0, 9, 2, 1),
        mavlink.MAVLink_statustext_message(6, b"=cmd()"),
        mavlink.MAVLink_mission_count_message(255, 190, 1, 0),
        item(0, 0, 16, (unknown, -unknown - 1), nan),
        mavlink.MAVLink_mission_count_message(255, 190, 1, 2),
        item(0, 2, 5100, E7, nan),
    ]
    path = written(tmp_path, messages)
    outs = [tmp_path / name for name in ("a.param", "a.waypoints", "a.plan", "a.csv")]
    run("extract", path, "--params", outs[0], "--mission", outs[1], "--texts", outs[3])
    run("extract", path, "--mission", outs[2])
    params, waypoints, plan, texts = (out.read_text() for out in outs)
    assert params.splitlines() == ["\\x3dC,2", "A\\x0aB\\x2c1\\x1b,1"]
    assert "nan" not in waypoints
    assert waypoints.split("\t")[8:11] == ["0.00000000"] * 3
    found = json.loads(plan, parse_constant=lambda name: pytest.fail(name))
    assert found["mission"]["plannedHomePosition"] == [None, None, None]
    assert found["mission"]["items"][0]["params"][4:] == [None, None, None]
    assert found["rallyPoints"]["points"][0][2] is None
    assert texts.splitlines()[1].endswith(",'=cmd()")


def parsed_srt(text: str) -> list[tuple[float, float, str]]:
    """Read SubRip by its rules: a number, a line with two times, text, and an empty line."""
    found = []
    for number, block in enumerate(text.strip().split("\n\n"), 1):
        head, times, *lines = block.split("\n")
        assert int(head) == number
        assert re.fullmatch(r"\d\d:\d\d:\d\d,\d{3} --> \d\d:\d\d:\d\d,\d{3}", times)
        values = [int(one) for one in re.findall(r"\d+", times)]
        begin, end = (h * 3600 + m * 60 + s + ms / 1000 for h, m, s, ms in (values[:4], values[4:]))
        found.append((begin, end, "\n".join(lines)))
    return found


def test_subtitles_are_shown_at_their_rate_from_the_begin_of_the_video(
    tlog: Path, tmp_path: Path
) -> None:
    out = tmp_path / "flight.srt"
    run("extract", tlog, "--subtitles", out, "--offset", "2.5")
    shown = parsed_srt(out.read_text())
    assert [end - begin for begin, end, _ in shown] == pytest.approx([0.2] * len(shown))
    assert shown[0][0] == 0.0
    assert shown[-1][0] == pytest.approx(3.6, abs=0.25)
    for word in ("LOITER", "50.0 m", "5.0 m/s", "12.6 V 87 %", "m flown", "8.765432"):
        assert word in shown[-1][2]
    # 1000e-7 deg in 100 ms: the field at the begin of the video is that of the recording then.
    lat = float(shown[5][2].split("  ")[-1].split(",")[0])
    assert lat == pytest.approx(LAT + 1e-4 * (25 + 10 - 23), abs=2.1e-4)


def test_subtitles_of_a_video_years_before_the_flight_begin_with_the_flight(
    tlog: Path, tmp_path: Path
) -> None:
    out = tmp_path / "flight.srt"
    first = datetime.fromtimestamp(START_US / 1e6, UTC)
    run("extract", tlog, "--subtitles", out, "--offset", f"{first.replace(year=2016).isoformat()}")
    (begin, _), *_ = re.findall(r"(\d+):(\d\d):\d\d,\d{3} -->", out.read_text())
    assert int(begin) == (first - first.replace(year=2016)).total_seconds() // 3600


def test_recording_from_time_zero_begins_at_its_first_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "CHUNK", 500)
    path = write_tlog(
        tmp_path / "a.tlog", [replace(r, time_us=1000 * k) for k, r in enumerate(make_records(60))]
    )
    flight = FlightToWrite([open_recording(path)], OPTIONS)
    assert sum(map(len, flight.answered())) == 60
    assert flight.first_us == 0


@pytest.mark.parametrize("verb", ["extract", "diff"])
def test_csv_is_refused_before_it_is_read(tmp_path: Path, verb: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time;speed\n1;2\n")
    words = ("--texts", tmp_path / "t.csv") if verb == "extract" else (path,)
    found = invoke(verb, path, *words, code=2)
    assert "is neither MAVLink nor the log of an autopilot" in found.output
