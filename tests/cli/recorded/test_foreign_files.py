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
