"""Files of other programs, in the forms that their users report: read, and the oddity stated."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.tlog import encode_record
from tests.kit.cli import run
from tests.kit.mavlink import packed
from tests.kit.recordings import read_tlog

pytestmark = pytest.mark.io

BEGIN_US = 1_700_000_000_000_000
SECONDS = 20
Stamp = Callable[[int, int], int]
"""The time in a tlog of a frame of a number and a time of the flight."""


def info(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run("info", path, "--json"))
    return found


def frames(*, version: int = 2, timed: bool = True) -> list[tuple[int, bytes]]:
    """Fly straight north for some seconds: ten samples and a position a second."""
    said: list[tuple[int, Any]] = []
    for tick in range(10 * SECONDS):
        ms = 100 * tick
        found = [mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)] if tick % 10 == 0 else []
        if timed:
            imu = (10 * tick, 20, -1000, 1, 2, 3, 200, 10, 400)
            found.append(mavlink.MAVLink_scaled_imu_message(ms + 5000, *imu))
            if tick % 10 == 1:
                position = (471_000_000 + 100 * tick, 82_000_000, 500_000, 0, 100, 0, 0, 0)
                found.append(mavlink.MAVLink_global_position_int_message(ms + 5000, *position))
                found.append(mavlink.MAVLink_system_time_message(BEGIN_US + 1000 * ms, ms))
        else:
            found.append(mavlink.MAVLink_statustext_message(6, b"tick %d" % tick))
        said += [(1000 * ms, message) for message in found]
    return [
        (time_us, packed(message, sequence=number % 256, version=version))
        for number, (time_us, message) in enumerate(said)
    ]


def tlog(path: Path, stamp: Stamp = lambda _, t: BEGIN_US + t, pad: bytes = b"") -> Path:
    """Write a tlog with other stamps, or with bytes behind each stamp."""
    records = [encode_record(stamp(n, t), pad + frame) for n, (t, frame) in enumerate(frames())]
    path.write_bytes(b"".join(records))
    return path


STAMPS: dict[str, Stamp] = {
    "first ones zero": lambda n, t: 0 if n < 5 else BEGIN_US + t,
    "set in flight": lambda _, t: t + (5_000_000 if t < 9_900_000 else BEGIN_US),
    "set back": lambda _, t: BEGIN_US + t - (7_200_000_000 if t > 9_900_000 else 0),
}


@pytest.mark.parametrize("stamp", STAMPS.values(), ids=STAMPS)
def test_clock_set_while_recording_gives_one_timeline_to_every_command(
    tmp_path: Path, stamp: Stamp
) -> None:
    path, cut = tlog(tmp_path / "set.tlog", stamp), tmp_path / "cut.tlog"
    assert info(path)["duration_s"] == pytest.approx(SECONDS, abs=0.5)
    printed = run("info", path)
    assert "2023-11-14" in printed
    assert "its clock jumped" in printed
    run("convert", path, "--from", 5, "--to", 15, "-o", cut)
    times_us = [record.time_us for record in read_tlog(cut)]
    assert (times_us[-1] - times_us[0]) / 1e6 == pytest.approx(10.0, abs=0.2)
    assert times_us == sorted(times_us)
    for ending in ("gpx", "kml"):
        run("convert", path, "-o", tmp_path / f"map.{ending}")
        text = (tmp_path / f"map.{ending}").read_text()
        assert ("2023-11-14" in text, "1970-" in text) == (True, False)


@pytest.mark.parametrize("version", [1, 2])
def test_capture_without_time_stamps_takes_times_from_its_messages(
    tmp_path: Path, version: int
) -> None:
    path, out = tmp_path / "flight.tlog.raw", tmp_path / "out.tlog"
    all_frames = [frame for _, frame in frames(version=version)]
    path.write_bytes(b"noise" + b"".join(all_frames))
    found = info(path)
    assert (found["records"], found["damaged_bytes"]) == (len(all_frames), 0)
    assert found["duration_s"] == pytest.approx(SECONDS, abs=0.5)
    assert "without time stamps" in str(found["remarks"])
    assert "left out 5 bytes between frames" in str(found["remarks"])
    run("recover", path, "-o", out)
    records = read_tlog(out)
    assert len(records) == len(all_frames)
    assert abs(records[0].time_us - BEGIN_US) < 1_000_000
    run("fuse", path, "-o", tmp_path / "fused.csv")


def test_capture_without_any_time_is_spaced_by_the_size_of_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "plain.raw"
    path.write_bytes(b"".join(frame for _, frame in frames(timed=False)))
    found = info(path)
    assert found["duration_s"] == pytest.approx(path.stat().st_size * 10 / 57_600, rel=0.05)
    assert "57600 baud" in str(found["remarks"])


def test_tlog_with_padded_records_keeps_its_times(tmp_path: Path) -> None:
    plain, padded = tlog(tmp_path / "plain.tlog"), tlog(tmp_path / "padded.tlog", pad=bytes(8))
    run("convert", padded, "-o", tmp_path / "out.tlog")
    assert (tmp_path / "out.tlog").read_bytes() == plain.read_bytes()
    assert "eight extra zero bytes" in run("info", padded)


AC31 = """\
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 129, 23, PARM, Nf, Name,Value
FMT, 130, 45, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T
FMT, 131, 31, IMU, Iffffff, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ
PARM, SYSID_THISMAV, 3.0"""
RECENT = """\
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 129, 31, PARM, QNff, TimeUS,Name,Value,Default
FMT, 130, 51, GPS, QBBIHBcLLeffffB, TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U
FMT, 131, 48, IMU, QBffffffIIfBBHH, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz
PARM, 10000000, MAV_SYSID, 7, 1"""


def old_log() -> list[str]:
    lines = [AC31]
    for ms in range(60_000, 72_000, 20):
        lines.append(f"IMU, {ms}, 0.001, 0.002, 0.003, 0.01, -0.02, -9.8")
        if ms % 200 == 0:
            week_ms = 345_540_000 + ms
            lines.append(f"GPS, 3, {week_ms}, 1770, 10, 1.2, 47.1, 8.5, 0.1, 500, 5, 90, 0, {ms}")
    return lines


def recent_log(
    begin_us: int = 10_000_000, gps: int = 0, imu: int = 0, week: int = 2300
) -> list[str]:
    lines = []
    for ms in range(0, 12_000, 20):
        head, axes = f"{begin_us + 1000 * ms}", "0.001, 0.002, 0.003, 0.01, -0.02, -9.8"
        lines.append(f"IMU, {head}, {imu}, {axes}, 0, 0, 25, 1, 1, 400, 400")
        if ms % 200 == 0:
            location = "12, 0.8, 47.1, 8.5, 500, 5, 90, 0, 0, 1"
            lines.append(f"GPS, {head}, {gps}, 3, {345_600_000 + ms}, {week}, {location}")
    return lines


def dataflash(path: Path, *lines: str) -> Path:
    path.write_text("\n".join([*lines, ""]))
    return path


def rates(path: Path) -> dict[str, int]:
    return {rate["name"]: rate["count"] for rate in info(path)["vehicles"][0]["rates"]}


@pytest.mark.parametrize("title", [[], ["", "ArduCopter V3.1.2 (abc)", "Free RAM: 990", ""]])
def test_dataflash_of_old_firmware_is_read_in_milliseconds(
    tmp_path: Path, title: list[str]
) -> None:
    path = dataflash(tmp_path / "old.log", *title, *old_log())
    assert rates(path) == {"imu": 600, "gps": 60}
    assert info(path)["duration_s"] == pytest.approx(11.98)
    # 16 leap seconds then.
    assert "2013-12-11 23:59:44" in run("info", path)


def test_second_sensor_of_a_dataflash_is_used_without_a_first(tmp_path: Path) -> None:
    path = dataflash(tmp_path / "second.log", RECENT, *recent_log(gps=1, imu=2))
    assert rates(path) == {"imu": 600, "gps": 60}
    assert "uses GPS 2" in (printed := run("info", path))
    assert "uses IMU 3" in printed
    both = dataflash(tmp_path / "both.log", RECENT, *recent_log(), *recent_log(gps=1)[1::11])
    out = tmp_path / "out.csv"
    assert "uses GPS 2" in run("convert", both, "-o", out, "--sensor", "gps=2")
    assert "write imu, mag" in run("convert", both, "-o", out, "--sensor", "gps=x", code=2)


def test_dataflash_with_lost_gps_weeks_has_a_date_of_today(tmp_path: Path) -> None:
    path = dataflash(tmp_path / "rolled.log", RECENT, *recent_log(week=2300 - 1024))
    printed = run("info", path)
    assert "2024-02-07" in printed
    assert "1024 weeks too few" in printed


@pytest.mark.parametrize("after_us", [0, 40_000])
def test_dataflash_with_a_restart_keeps_every_sample(tmp_path: Path, after_us: int) -> None:
    first = recent_log()
    path = dataflash(tmp_path / "boots.log", RECENT, *first, *recent_log(10_000_000 + after_us))
    assert rates(path) == {"imu": 1200, "gps": 120}
    assert "the autopilot restarted 1 time" in run("info", path)
    short = dataflash(tmp_path / "short.log", RECENT, *first, *first[:20])
    assert rates(short)["imu"] == 618


AXES = b"GyrX,GyrY,GyrZ,AccX,AccY,AccZ"


@pytest.mark.parametrize(
    ("formats", "reason"),
    [
        (b"\x83\x30", "it has no list of formats"),
        (b"\x80\x83\x27IMU\0fffffffff" + bytes(7) + b"AccX,AccY,AccZ,GyroX,GyroY", "no GyrX, GyrY"),
        (b"\x80\x83\x1bIMU\0Qffffff" + bytes(9) + b"TimeUS," + AXES, "no IMU"),
    ],
)
def test_dataflash_without_samples_states_why(tmp_path: Path, formats: bytes, reason: str) -> None:
    path = tmp_path / "empty.bin"
    path.write_bytes(b"\xa3\x95" + formats.ljust(87, b"\0") + bytes(600))
    assert reason in run("info", path, code=2)


def rows(delimiter: str, *, comma: bool = False, step: int = 1) -> str:
    """Return a log with samples at 100 Hz, or with some of them."""
    lines = ["time_s ax ay az gx gy gz"]
    lines += [f"{n / 100:.2f} 0.01 -0.02 -9.80 0.001 0.002 0.003" for n in range(0, 500, step)]
    text = "\n".join([*lines, ""])
    return (text.replace(".", ",") if comma else text).replace(" ", delimiter)


LOGS = {
    "plain": rows(",").encode(),
    "blanks": rows(", ").encode(),
    "semicolons": rows(";").encode(),
    "semicolons and decimal commas": rows(";", comma=True).encode(),
    "tabs": rows("\t").encode(),
    "tabs and decimal commas": rows("\t", comma=True).encode(),
    "utf-16": rows(",").replace("\n", "\r\n").encode("utf-16"),
    "utf-16-le": rows(",").encode("utf-16-le"),
    "utf-16-be": rows(",").encode("utf-16-be"),
    "text before": b"MPU6050 connection successful\nInitializing...\n" + rows(",").encode(),
}


@pytest.mark.parametrize("name", LOGS)
def test_csv_dialect_and_encoding_are_recognised(tmp_path: Path, name: str) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(LOGS[name])
    printed = run("fuse", path, "-o", tmp_path / "out.csv")
    assert "500 samples at 100 Hz fused by" in printed
    is_left_out = "left out 2 lines of text before the column names" in printed
    assert is_left_out == (name == "text before")


def test_csv_without_the_needed_columns_names_those_found(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(rows(";").replace("gz", "gyro_z").encode("utf-16"))
    printed = run("fuse", path, "-o", tmp_path / "out.csv", code=2)
    assert "log.csv: the file has no column gz" in printed
    assert "(as UTF-16)" in printed
    assert "found, separated by semicolons: time_s, ax, ay, az, gx, gy, gyro_z" in printed


def test_fuse_warns_of_imu_samples_below_ten_hertz(tmp_path: Path) -> None:
    fast, slow = tlog(tmp_path / "fast.tlog", lambda _, t: BEGIN_US + 5 * t), tmp_path / "slow.csv"
    slow.write_text(rows(",", step=50))
    printed = run("fuse", slow, "-o", tmp_path / "out.csv")
    assert "at 2 Hz" in printed
    assert "below 10 Hz" in printed
    assert "below 10 Hz" not in run("fuse", fast, "-o", tmp_path / "out2.csv")
