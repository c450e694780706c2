"""Files of other programs, in the forms that their users report: read, and the oddity stated."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from tests.kit.cli import run

pytestmark = pytest.mark.io

BEGIN_US = 1_700_000_000_000_000
DAY_US = 86_400_000_000
SECONDS = 20


def info(path: Path, *words: object) -> dict[str, object]:
    found: dict[str, object] = json.loads(run("info", path, "--json", *words))
    return found


def frames(*, v1: bool = False, timed: bool = True) -> Iterator[tuple[int, bytes]]:
    """Fly straight north for some seconds: ten samples and a position a second."""
    mav = mavlink.MAVLink(None, 1, 1)
    for tick in range(10 * SECONDS):
        ms = 100 * tick
        messages = [mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)] if tick % 10 == 0 else []
        if timed:
            imu = (10 * tick, 20, -1000, 1, 2, 3, 200, 10, 400)
            messages.append(mavlink.MAVLink_scaled_imu_message(ms + 5000, *imu))
            if tick % 10 == 1:
                position = (471_000_000 + 100 * tick, 82_000_000, 500_000, 0, 100, 0, 0, 0)
                messages.append(mavlink.MAVLink_global_position_int_message(ms + 5000, *position))
                messages.append(mavlink.MAVLink_system_time_message(BEGIN_US + 1000 * ms, ms))
        else:
            messages.append(mavlink.MAVLink_statustext_message(6, b"tick %d" % tick))
        for message in messages:
            yield 1000 * ms, bytes(message.pack(mav, force_mavlink1=v1))
            mav.seq = (mav.seq + 1) % 256


def tlog(path: Path, stamps: "list[int] | None" = None, pad: bytes = b"") -> Path:
    """Write a tlog with given stamps, and bytes behind each stamp."""
    flight = [*frames()]
    times = [BEGIN_US + time_us for time_us, _ in flight] if stamps is None else stamps
    path.write_bytes(
        b"".join(
            struct.pack(">Q", t) + pad + frame for t, (_, frame) in zip(times, flight, strict=True)
        )
    )
    return path


def stamps_of(path: Path) -> list[int]:
    data, at, found = path.read_bytes(), 0, []
    while at < len(data):
        found.append(int.from_bytes(data[at : at + 8], "big"))
        at += 8 + data[at + 9] + (12 if data[at + 8] == 0xFD else 8)
    return found


def first_zero() -> list[int]:
    return [0 if number < 5 else BEGIN_US + t for number, (t, _) in enumerate(frames())]


def set_in_flight() -> list[int]:
    return [t + (5_000_000 if t < 9_900_000 else BEGIN_US) for t, _ in frames()]


def set_back() -> list[int]:
    return [BEGIN_US + t - (7_200_000_000 if t > 9_900_000 else 0) for t, _ in frames()]


@pytest.mark.parametrize("stamps", [first_zero, set_in_flight, set_back])
def test_clock_set_while_recording_gives_one_timeline_to_every_command(
    tmp_path: Path, stamps: "object"
) -> None:
    assert callable(stamps)
    path = tlog(tmp_path / "set.tlog", stamps())
    found = info(path)
    assert found["duration_s"] == pytest.approx(SECONDS, abs=0.5)
    assert "its clock jumped" in str(found["remarks"])
    printed = run("info", path)
    assert "2023-11-14" in printed
    assert "its clock jumped" in printed
    cut = tmp_path / "cut.tlog"
    run("convert", path, "--from", 5, "--to", 15, "-o", cut)
    times_us = stamps_of(cut)
    assert (times_us[-1] - times_us[0]) / 1e6 == pytest.approx(10.0, abs=0.2)
    assert times_us == sorted(times_us)
    for ending in (".gpx", ".kml"):
        run("convert", path, "-o", tmp_path / f"map{ending}")
        text = (tmp_path / f"map{ending}").read_text()
        assert "2023-11-14" in text
        assert "1970-" not in text


@pytest.mark.parametrize("v1", [False, True])
def test_capture_without_time_stamps_takes_times_from_its_messages(
    tmp_path: Path, v1: bool
) -> None:
    path = tmp_path / "flight.tlog.raw"
    all_frames = [frame for _, frame in frames(v1=v1)]
    path.write_bytes(b"noise" + b"".join(all_frames))
    found = info(path)
    assert found["records"] == len(all_frames)
    assert found["duration_s"] == pytest.approx(SECONDS, abs=0.5)
    assert found["damaged_bytes"] == 0
    assert "without time stamps" in str(found["remarks"])
    assert "left out 5 bytes between frames" in str(found["remarks"])
    out = tmp_path / "out.tlog"
    run("recover", path, "-o", out)
    times_us = stamps_of(out)
    assert len(times_us) == len(all_frames)
    assert abs(times_us[0] - BEGIN_US) < 1_000_000
    run("fuse", path, "-o", tmp_path / "fused.csv")


def test_capture_without_any_time_is_spaced_by_the_size_of_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "plain.raw"
    path.write_bytes(b"".join(frame for _, frame in frames(timed=False)))
    size = path.stat().st_size
    found = info(path)
    assert found["duration_s"] == pytest.approx(size * 10 / 57_600, rel=0.05)
    assert "57600 baud" in str(found["remarks"])


def test_tlog_with_padded_records_keeps_its_times(tmp_path: Path) -> None:
    plain, padded = tlog(tmp_path / "plain.tlog"), tlog(tmp_path / "padded.tlog", pad=bytes(8))
    run("convert", padded, "-o", tmp_path / "out.tlog")
    assert (tmp_path / "out.tlog").read_bytes() == plain.read_bytes()
    assert "eight extra zero bytes" in run("info", padded)


AC31 = (
    "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
    "FMT, 129, 23, PARM, Nf, Name,Value",
    (
        "FMT, 130, 45, GPS, BIHBcLLeeEefI, "
        "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"
    ),
    "FMT, 131, 31, IMU, Iffffff, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
    "PARM, SYSID_THISMAV, 3.0",
)
RECENT = (
    "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
    "FMT, 129, 31, PARM, QNff, TimeUS,Name,Value,Default",
    (
        "FMT, 130, 51, GPS, QBBIHBcLLeffffB, "
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"
    ),
    (
        "FMT, 131, 48, IMU, QBffffffIIfBBHH, "
        "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    ),
    "PARM, 10000000, MAV_SYSID, 7, 1",
)


def old_log(seconds: int = 12) -> list[str]:
    lines = [*AC31]
    for n in range(50 * seconds):
        ms = 60_000 + 20 * n
        lines.append(f"IMU, {ms}, 0.001, 0.002, 0.003, 0.01, -0.02, -9.8")
        if n % 10 == 0:
            week_ms = 345_600_000 + 20 * n
            lines.append(f"GPS, 3, {week_ms}, 1770, 10, 1.2, 47.1, 8.5, 0.1, 500, 5, 90, 0, {ms}")
    return lines


def recent_log(
    begin_us: int = 10_000_000, gps: int = 0, imu: int = 0, week: int = 2300
) -> list[str]:
    lines = []
    for n in range(600):
        t = begin_us + 20_000 * n
        lines.append(
            f"IMU, {t}, {imu}, 0.001, 0.002, 0.003, 0.01, -0.02, -9.8, 0, 0, 25, 1, 1, 400, 400"
        )
        if n % 10 == 0:
            place = "12, 0.8, 47.1, 8.5, 500, 5, 90, 0, 0, 1"
            lines.append(f"GPS, {t}, {gps}, 3, {345_600_000 + 20 * n}, {week}, {place}")
    return lines


def dataflash(path: Path, *lines: str, before: bytes = b"") -> Path:
    path.write_bytes(before + "\n".join([*lines, ""]).encode())
    return path


def rates(path: Path, *words: object) -> dict[str, int]:
    vehicles = info(path, *words)["vehicles"]
    assert isinstance(vehicles, list)
    return {rate["name"]: rate["count"] for rate in vehicles[0]["rates"]}


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
    path = dataflash(tmp_path / "second.log", *RECENT, *recent_log(gps=1, imu=2))
    assert rates(path) == {"imu": 600, "gps": 60}
    printed = run("info", path)
    assert "uses GPS 2" in printed
    assert "uses IMU 3" in printed
    both = dataflash(tmp_path / "both.log", *RECENT, *recent_log(), *recent_log(gps=1)[1::11])
    out = tmp_path / "out.csv"
    assert "uses GPS 2" in run("convert", both, "-o", out, "--sensor", "gps=2")
    assert "write imu, mag" in run("convert", both, "-o", out, "--sensor", "gps=x", code=2)


def test_dataflash_with_lost_gps_weeks_has_a_date_of_today(tmp_path: Path) -> None:
    path = dataflash(tmp_path / "rolled.log", *RECENT, *recent_log(week=2300 - 1024))
    printed = run("info", path)
    assert "2024-02-07" in printed
    assert "1024 weeks too few" in printed


@pytest.mark.parametrize("after_us", [0, 40_000])
def test_dataflash_with_a_restart_keeps_every_sample(tmp_path: Path, after_us: int) -> None:
    first = recent_log()
    path = dataflash(tmp_path / "boots.log", *RECENT, *first, *recent_log(10_000_000 + after_us))
    assert rates(path) == {"imu": 1200, "gps": 120}
    assert "the autopilot restarted 1 time" in run("info", path)
    short = dataflash(tmp_path / "short.log", *RECENT, *first, *first[:20])
    assert rates(short)["imu"] == 618


@pytest.mark.parametrize(
    ("formats", "reason"),
    [
        (b"\x83\x30", "it has no list of formats"),
        (b"\x80\x83\x27IMU\0fffffffff" + bytes(7) + b"AccX,AccY,AccZ,GyroX,GyroY", "no GyrX, GyrY"),
        (
            b"\x80\x83\x1bIMU\0Qffffff" + bytes(9) + b"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
            "no IMU",
        ),
    ],
)
def test_dataflash_without_samples_states_why(tmp_path: Path, formats: bytes, reason: str) -> None:
    path = tmp_path / "empty.bin"
    path.write_bytes(b"\xa3\x95" + formats.ljust(87, b"\0") + bytes(600))
    assert reason in run("info", path, code=2)


NAMES = ("time_s", "ax", "ay", "az", "gx", "gy", "gz")


def rows(delimiter: str, *, comma: bool = False, blank: str = "") -> str:
    lines = [(delimiter + blank).join(NAMES)]
    for n in range(500):
        cells = [f"{n / 100:.2f}", "0.01", "-0.02", "-9.80", "0.001", "0.002", "0.003"]
        lines.append((delimiter + blank).join(c.replace(".", ",") if comma else c for c in cells))
    return "\n".join([*lines, ""])


@pytest.mark.parametrize(
    "content",
    [
        rows(",").encode(),
        rows(",", blank=" ").encode(),
        rows(";").encode(),
        rows(";", comma=True).encode(),
        rows("\t").encode(),
        rows("\t", comma=True).encode(),
        rows(",").replace("\n", "\r\n").encode("utf-16"),
        rows(",").encode("utf-16-le"),
        rows(",").encode("utf-16-be"),
        ("MPU6050 connection successful\nInitializing...\n" + rows(",")).encode(),
    ],
    ids=[
        "plain",
        "blanks",
        "semi",
        "semi-comma",
        "tabs",
        "tabs-comma",
        "utf16",
        "le",
        "be",
        "text",
    ],
)
def test_csv_dialect_and_encoding_are_recognised(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    printed = run("fuse", path, "-o", tmp_path / "out.csv")
    assert "500 samples at 100 Hz fused by" in printed
    assert ("left out 2 lines of text before the column names" in printed) == (b"MPU" in content)


def test_csv_without_the_needed_columns_names_those_found(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(rows(";").replace("gz", "gyro_z").encode("utf-16"))
    printed = run("fuse", path, "-o", tmp_path / "out.csv", code=2)
    assert "log.csv: the file has no column gz" in printed
    assert "(as UTF-16)" in printed
    assert "found, separated by semicolons: time_s, ax, ay, az, gx, gy, gyro_z" in printed


def test_fuse_warns_of_imu_samples_below_ten_hertz(tmp_path: Path) -> None:
    path = tlog(tmp_path / "slow.tlog", [BEGIN_US + 5 * t for t, _ in frames()])
    slow = tmp_path / "slow.csv"
    slow.write_text("\n".join([rows(",").split("\n")[0], *rows(",").split("\n")[1::50]]) + "\n")
    assert "at 2 Hz" in run("fuse", slow, "-o", tmp_path / "out.csv")
    assert "below 10 Hz" in run("fuse", slow, "-o", tmp_path / "out.csv", "--force")
    assert "below 10 Hz" not in run("fuse", path, "-o", tmp_path / "out2.csv")


def test_unknown_command_suggests_the_nearest() -> None:
    assert "Did you mean 'run'" in run("runn", code=2)
