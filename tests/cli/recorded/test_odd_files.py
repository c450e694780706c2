"""Invalid input to the commands: the message states file, line, fault and remedy."""

import gzip
import os
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from gateway.aircraft import AircraftSettings
from gateway.recordings.columns import TableRow
from gateway.recordings.recorded_table import header_for
from gateway.recordings.table import FORMAT_LINE
from tests.kit.cli import run
from tests.kit.recordings import make_frames, write_table
from tests.kit.records import state_at

pytestmark = pytest.mark.io

NAMES = "time_s,ax,ay,az,gx,gy,gz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m"
VEHICLE = '"vehicle_id":1'
NUMBERS = ("0", "0", "-9.8", "0", "0", "0", "100", "0.1", "47", "8", "500")


def log(path: Path, **odd: str) -> Path:
    """Write a tracker's log of a second, every tenth row of which has an odd cell."""
    lines = [NAMES]
    for number in range(100):
        cells = dict(zip(NAMES.split(","), [f"{number / 100}", *NUMBERS], strict=True))
        lines.append(",".join((cells | odd if number % 10 == 5 else cells).values()))
    path.write_text("\n".join(lines) + "\n")
    return path


def table(path: Path, **head: object) -> Path:
    """Write a table of one state."""
    header = msgspec.structs.replace(header_for(AircraftSettings(), 1), **head)
    return write_table(path, header, [TableRow(1000, state=state_at(1000))])


@pytest.mark.parametrize(
    ("column", "cell", "left_out"),
    [
        *(("time_s", cell, "lines") for cell in ("inf", "1e300", "")),
        ("ax", "1" * 140_000, "lines"),
        ("gps_lat", "inf", "cells"),
        *(("baro_alt_m", cell, "") for cell in ("44331", "99999", "1e308", "inf")),
    ],
    ids=lambda value: value[:9],
)
def test_impossible_values_are_left_out_with_their_line_or_alone(
    tmp_path: Path, column: str, cell: str, left_out: str
) -> None:
    printed = run("fuse", log(tmp_path / "log.csv", **{column: cell}), "-o", tmp_path / "out.csv")
    assert f"{90 if left_out == 'lines' else 100} samples at" in printed
    assert "fused by eskf" in printed
    remark = f"left out 10 {left_out} that cannot be read (line 7: "
    assert (remark in printed) == bool(left_out)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"# gps_latency_s=1.1.1\n", "line 1: gps_latency_s=1.1.1 is not a number"),
        (b"# gps_latency_s=99\n", "Expected `float` <= 2.0"),
        (b"# \xe4\xf6\xfc gps_latency_s=0.2\n", "fused by eskf"),
        (b"\xef\xbb\xbf", "fused by eskf"),
    ],
)
def test_comments_before_a_log_are_read_or_refused_with_their_line(
    tmp_path: Path, text: bytes, words: str
) -> None:
    path = log(tmp_path / "log.csv")
    path.write_bytes(text + path.read_bytes())
    printed = run("fuse", path, "-o", tmp_path / "out.csv", code=0 if "fused" in words else 2)
    assert words in printed


Make = Callable[[Path], None]


def pipe(path: Path) -> None:
    os.mkfifo(path)


def link(path: Path) -> None:
    path.symlink_to("/dev/zero")


def cut(path: Path) -> None:
    path.write_bytes(gzip.compress(log(path).read_bytes())[:-100])


def damage(path: Path) -> None:
    path.write_bytes(gzip.compress(log(path).read_bytes())[:-8] + bytes(8))


def packed(path: Path, head: bytes, piece: bytes, mb: int) -> Path:
    """Pack a head and many copies of a piece of a megabyte."""
    with gzip.open(path, "wb") as file:
        file.write(head)
        for _ in range(mb):
            file.write(piece)
    return path


def bomb(path: Path) -> None:
    packed(path, NAMES.encode() + b"\n", b"#\n" * (1 << 19), 34)


def run_within(peak_mb: int, *words: object) -> str:
    """Run a command that is refused, within bounded memory."""
    tracemalloc.start()
    printed = run(*words, code=2)
    assert tracemalloc.get_traced_memory()[1] < peak_mb << 20
    tracemalloc.stop()
    return printed


DEVICE = "is a pipe or a device; save its bytes as a file"
RATIO = "has a compression ratio above 100"
REFUSED: list[tuple[Make | None, str, tuple[str, ...]]] = [
    *((make, DEVICE, ("info", "fuse", "recover", "play")) for make in (pipe, link, None)),
    *((make, "is a damaged gzip file", ("info", "fuse", "recover")) for make in (cut, damage)),
    (bomb, RATIO, ("info", "fuse", "play")),
]


@pytest.mark.parametrize(
    ("make", "words", "command"),
    [(make, words, command) for make, words, commands in REFUSED for command in commands],
)
def test_unreadable_file_is_refused_in_a_moment(
    tmp_path: Path, make: Make | None, words: str, command: str
) -> None:
    path, out = Path("/dev/zero"), tmp_path / "out.csv"
    if make is not None:
        make(path := tmp_path / "log.csv.gz")
    begin_s = time.process_time()
    printed = run(command, path, *(["-o", out] if command in ("fuse", "recover") else []), code=2)
    assert time.process_time() - begin_s < 20.0
    assert f"{path}: {words}" in printed
    assert ("gzip -dc" in printed) == ("damaged" in words)
    assert not out.exists()


def test_packed_file_is_recognised_by_its_first_bytes_not_its_name(tmp_path: Path) -> None:
    plain, zipped = log(tmp_path / "log.csv.gz"), tmp_path / "log.csv"
    zipped.write_bytes(gzip.compress(plain.read_bytes()))
    for path in (plain, zipped):
        assert "100 records in 0:00.990" in run("info", path)


def test_overlong_line_is_refused_within_bounded_memory(tmp_path: Path) -> None:
    path = packed(tmp_path / "log.csv.gz", NAMES.encode() + b"\n", b"1" * (1 << 20), 64)
    printed = run_within(32, "fuse", path, "-o", tmp_path / "out.csv")
    assert "line 2 is longer than 1 MB" in printed


@pytest.mark.parametrize(
    ("command", "head"),
    [
        ("info", b"ULog\x01\x12\x35\x01"),
        ("fuse", b"\xa3\x95\x80"),
        ("convert", b"PAR1"),
        ("play", b"\0"),
    ],
)
def test_packed_log_beyond_the_unpacked_limit_is_refused_and_fills_neither_memory_nor_disk(
    tmp_path: Path, temporary: Path, command: str, head: bytes
) -> None:
    path = packed(tmp_path / "bomb.gz", head, bytes(1 << 20), 128)
    config = tmp_path / "gateway.toml"
    config.write_text("[recording]\nunpacked_limit_mb = 8\n")
    temporary.mkdir()
    words = ["-o", tmp_path / "out.csv"] if command in ("fuse", "convert") else []
    printed = run_within(48, command, path, *words, "--config", config)
    # To play it, all of it is read to find its format.
    reason = RATIO if command == "play" else "unpacks to more than 8 MB"
    assert f"bomb.gz: {reason}" in printed
    assert ("unpacked_limit_mb" in printed) == (command != "play")
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("end", [".kml", ".gpx"])
@pytest.mark.parametrize("zero_us", [0, -(10**17), 10**18, 2**62])
def test_times_beyond_the_calendar_are_written_and_reported(
    tmp_path: Path, end: str, zero_us: int
) -> None:
    path = table(tmp_path / "table.csv", unix_us_at_zero=zero_us)
    run("convert", path, "-o", tmp_path / f"out{end}")
    printed = run("info", path)
    assert ("without a valid date" in printed) == (zero_us != 0)


@pytest.mark.parametrize(
    ("after", "words"),
    [
        ("# mavgate table 2", "line 1: table version '2'; this mavgate reads"),
        *((f'"vehicle_id":{number}', "line 2: Expected `int`") for number in (-5, 0, 300)),
    ],
)
def test_unusable_head_of_a_table_is_refused_with_its_line(
    tmp_path: Path, after: str, words: str
) -> None:
    path, before = table(tmp_path / "table.csv"), FORMAT_LINE if after[0] == "#" else VEHICLE
    path.write_text(path.read_text().replace(before, after))
    printed = run("convert", path, "-o", tmp_path / "out.tlog", code=2)
    assert f"table.csv: {words}" in printed
    assert "mavgate recover" in printed or before == FORMAT_LINE


def test_table_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = table(tmp_path / "table.csv")
    path.write_text("\ufeff" + path.read_text())
    assert "vehicle 1" in run("info", path)


def test_tlog_of_the_far_future_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "future.tlog"
    path.write_bytes(b"".join(struct.pack(">Q", 10**18) + frame for frame in make_frames(20)))
    assert "unknown file format" in run("info", path, code=2)


def test_invalid_column_map_is_refused(tmp_path: Path) -> None:
    (columns := tmp_path / "map.toml").write_text("[columns]\nfoo = 3\n")
    printed = run("fuse", log(tmp_path / "log.csv"), "--columns", columns, "-o", "o.csv", code=2)
    assert "map.toml: is not a column map" in printed


def test_times_increase_across_a_restart_of_the_logs_clock(tmp_path: Path) -> None:
    path = log(tmp_path / "log.csv")
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows, *rows[:50], *rows, ""]))
    printed = run("info", path)
    assert "250 records in 0:02.480" not in printed
    assert "its clock went back" not in printed
    late = [f"{float(row.partition(',')[0]) + 60:.2f},{row.partition(',')[2]}" for row in rows]
    path.write_text("\n".join([head, *late, *rows, *late, ""]))
    printed = run("info", path)
    assert "300 records in 1:01.980" in printed
    assert "its clock went back 1 time;" in printed
    run("convert", path, "-o", tmp_path / "once.csv")
    lines = (tmp_path / "once.csv").read_text().splitlines()
    times_us = [int(line.partition(",")[0]) for line in lines if line[:1].isdigit()]
    assert times_us == sorted(times_us)


def test_text_of_a_recording_cannot_control_the_terminal(tmp_path: Path) -> None:
    evil = "\x1b]0;owned\x07 \x9b2J [red] :bomb: \u202egnp.exe"
    recorded = table(tmp_path / "a\x1b[31m[red].csv")
    mark = msgspec.json.encode({"time_us": 1000, "text": evil}).decode()
    with recorded.open("a") as file:
        file.write(f"# note: {mark}\n")
    printed = run("info", recorded)
    assert r"\x1b]0;owned\x07 \x9b2J [red] :bomb: \u202egnp.exe" in printed
    assert r"a\x1b[31m[red].csv: table" in printed
    refused = run("info", tmp_path / "b\x1b[31m.csv", code=2)
    assert r"b\x1b[31m.csv: No such file" in refused
    as_json = run("info", recorded, "--json")
    assert msgspec.json.decode(as_json)["notes"][0]["text"] == evil
    assert not set("\x1b\x07\x9b\u202e") & set(printed + refused + as_json)


def test_names_in_brackets_are_no_markup_for_the_catalogue(tmp_path: Path) -> None:
    (tmp_path / "x[").mkdir()
    table(tmp_path / "x[" / "y].csv")
    assert "x[/y].csv" in run("info", tmp_path)
