"""Invalid input to the commands: the message states file, line, fault and remedy."""

import gzip
import os
import struct
import tempfile
import time
import tracemalloc
from pathlib import Path

import msgspec
import pytest

from gateway.aircraft import AircraftSettings
from gateway.recordings.columns import COLUMNS
from gateway.recordings.recorded_table import header_for
from gateway.recordings.table import FORMAT_LINE, encode_head
from gateway.records import NavFlags
from tests.kit.cli import run
from tests.kit.recordings import make_frames

pytestmark = pytest.mark.io

NAMES = "time_s,ax,ay,az,gx,gy,gz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m"
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
    cells = dict.fromkeys(COLUMNS, "") | {"time_us": "1000", "nav_time_us": "1000"}
    cells |= dict.fromkeys((name for name in COLUMNS if name.startswith("nav_")), "1")
    cells["nav_flags"] = str(int(NavFlags.POSITION_VALID))
    path.write_text(encode_head(header) + ",".join(cells.values()) + "\n")
    return path


@pytest.mark.parametrize(
    "odd",
    [
        {"time_s": "inf"},
        {"time_s": "1e300"},
        {"gps_lat": "inf"},
        {"ax": "1" * 140_000},
        {"time_s": ""},
    ],
    ids=lambda odd: next(iter(odd)) + next(iter(odd.values()))[:5],
)
def test_lines_with_impossible_values_are_left_out(tmp_path: Path, odd: dict[str, str]) -> None:
    out = tmp_path / "out.csv"
    printed = run("fuse", log(tmp_path / "log.csv", **odd), "-o", out)
    assert "fused by eskf" in printed
    # Of a line with an impossible fix only that is left out.
    unit, kept = ("cells", 100) if "gps_lat" in odd else ("lines", 90)
    assert f"left out 10 {unit} that cannot be read (line 7: " in printed
    assert f"; {kept} samples at" in printed


@pytest.mark.parametrize("height", ["44331", "99999", "1e308", "inf"])
def test_height_beyond_the_atmosphere_gives_no_barometer_sample(
    tmp_path: Path, height: str
) -> None:
    printed = run("fuse", log(tmp_path / "log.csv", baro_alt_m=height), "-o", tmp_path / "out.csv")
    assert "100 samples at 100 Hz fused" in printed


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


@pytest.mark.parametrize("command", ["info", "fuse", "recover", "play"])
@pytest.mark.parametrize("kind", ["pipe", "zeros", "link"])
def test_pipe_or_device_is_refused(tmp_path: Path, command: str, kind: str) -> None:
    path = Path("/dev/zero") if kind == "zeros" else tmp_path / "log.csv"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to("/dev/zero")
    words = ["-o", tmp_path / "out.csv"] if command in ("fuse", "recover") else []
    printed = run(command, path, *words, code=2)
    assert f"{path}: is a pipe or a device; save its bytes as a file" in printed
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("command", ["info", "fuse", "recover"])
@pytest.mark.parametrize("how", ["cut", "checksum"])
def test_damaged_gzip_file_is_refused(tmp_path: Path, command: str, how: str) -> None:
    whole = gzip.compress(log(tmp_path / "log.csv").read_bytes())
    path = tmp_path / "log.csv.gz"
    damaged = {"cut": whole[:-100], "checksum": whole[:-8] + bytes(8)}
    path.write_bytes(damaged[how])
    words = ["-o", tmp_path / "out.csv"] if command != "info" else []
    printed = run(command, path, *words, code=2)
    assert "log.csv.gz: is a damaged gzip file" in printed
    assert "gzip -dc" in printed
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("packed", [False, True])
def test_packed_file_is_recognised_by_its_first_bytes_not_its_name(
    tmp_path: Path, packed: bool
) -> None:
    data = log(tmp_path / "plain").read_bytes()
    path = tmp_path / ("log.csv" if packed else "log.csv.gz")
    path.write_bytes(gzip.compress(data) if packed else data)
    assert "100 records in 0:00.990" in run("info", path)


@pytest.mark.parametrize("command", ["info", "fuse", "play"])
def test_comment_lines_of_a_bomb_are_refused_in_a_moment(tmp_path: Path, command: str) -> None:
    path = tmp_path / "bomb.csv.gz"
    with gzip.open(path, "wb") as file:
        file.write(NAMES.encode() + b"\n")
        for _ in range(20):
            file.write(b"#\n" * (1 << 20))
    words = ["-o", tmp_path / "out.csv"] if command == "fuse" else []
    begin_s = time.process_time()
    printed = run(command, path, *words, code=2)
    assert "bomb.csv.gz: has a compression ratio above 100" in printed
    assert time.process_time() - begin_s < 20.0


def test_overlong_line_is_refused_within_bounded_memory(tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    with gzip.open(path, "wb") as file:
        file.write(NAMES.encode() + b"\n")
        for _ in range(64):
            file.write(b"1" * (1 << 20))
    tracemalloc.start()
    printed = run("fuse", path, "-o", tmp_path / "out.csv", code=2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "line 2 is longer than 1 MB" in printed
    assert peak < 32 << 20


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, head: bytes
) -> None:
    path, temporary = tmp_path / "bomb.gz", tmp_path / "temporary"
    with gzip.open(path, "wb") as file:
        file.write(head)
        for _ in range(128):
            file.write(bytes(1 << 20))
    config = tmp_path / "gateway.toml"
    config.write_text("[recording]\nunpacked_limit_mb = 8\n")
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    words = ["-o", tmp_path / "out.csv"] if command in ("fuse", "convert") else []
    tracemalloc.start()
    printed = run(command, path, *words, "--config", config, code=2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    if command == "play":
        # All of it is read to find its format.
        assert "bomb.gz: has a compression ratio above 100" in printed
    else:
        assert "bomb.gz: unpacks to more than 8 MB" in printed
        assert "unpacked_limit_mb" in printed
    assert peak < 48 << 20
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("end", [".kml", ".gpx"])
@pytest.mark.parametrize("zero_us", [0, -(10**17), 10**18, 2**62])
def test_times_beyond_the_calendar_are_written_and_reported(
    tmp_path: Path, end: str, zero_us: int
) -> None:
    path = table(tmp_path / "table.csv", unix_us_at_zero=zero_us)
    run("convert", path, "-o", tmp_path / f"out{end}")
    printed = run("info", path)
    assert ("no day of the calendar" in printed) == (zero_us != 0)


def test_tlog_of_the_far_future_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "future.tlog"
    path.write_bytes(b"".join(struct.pack(">Q", 10**18) + frame for frame in make_frames(20)))
    assert "unknown file format" in run("info", path, code=2)


def test_table_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    path = table(tmp_path / "table.csv")
    path.write_text(path.read_text().replace(FORMAT_LINE, "# mavgate table 2"))
    printed = run("fuse", path, "-o", tmp_path / "out.csv", code=2)
    assert "table.csv: line 1: table version '2'; this mavgate reads version 1" in printed


@pytest.mark.parametrize("vehicle_id", [-5, 0, 300])
def test_table_with_an_invalid_vehicle_id_is_refused(tmp_path: Path, vehicle_id: int) -> None:
    path = table(tmp_path / "table.csv", vehicle_id=vehicle_id)
    printed = run("convert", path, "-o", tmp_path / "out.tlog", code=2)
    assert "table.csv: line 2: Expected `int`" in printed
    assert "mavgate recover" in printed


def test_table_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = table(tmp_path / "table.csv")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert "vehicle 1" in run("info", path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (bytes(range(128, 200)), "map.toml: line 1: is not UTF-8 text; save it as UTF-8"),
        (b'[columns]\ntime_us = "t"\n\xe4 = "x"\n', "map.toml: line 3: is not UTF-8"),
        (b"[columns]\nfoo = 3\n", "map.toml: is not a column map"),
        (b"[columns", "map.toml: is not valid TOML"),
        (b"x = " + b"[" * 10_000, "map.toml: line 1: is nested in more than 8 levels"),
    ],
)
def test_invalid_column_map_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    columns = tmp_path / "map.toml"
    columns.write_bytes(content)
    path = log(tmp_path / "log.csv")
    assert words in run("fuse", path, "--columns", columns, "-o", tmp_path / "o.csv", code=2)


@pytest.mark.parametrize("moment", ["9" * 400, "inf", "nan", "1e400", "9999-99-99T00:00:00Z", ""])
def test_invalid_moment_is_refused(tmp_path: Path, moment: str) -> None:
    path = table(tmp_path / "table.csv")
    printed = run("convert", path, "--from", moment, "-o", tmp_path / "o.csv", code=2)
    assert "use 80, 1:20 or 2026-06-11T14:25:30Z" in printed


@pytest.mark.parametrize("words", [("nan", "nan"), ("inf", "0"), ("47", "8", "--alt", "nan")])
def test_mark_at_invalid_coordinates_is_refused(words: tuple[str, ...]) -> None:
    assert "write a number" in run("mark", *words, code=2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[hub]\nendpoints = ["udp:127.0.0.1:0"]', "port must be 1 to 65535"),
        ('[hub]\nendpoints = ["udp-listen:127.0.0.1:0"]', "takes any free port"),
        ('[hub]\nendpoints = ["serial::57600"]', "write serial:DEVICE:BAUD"),
        ('[hub]\nendpoints = ["udp-multicast:127.0.0.1:14550"]', "is not a multicast group"),
        ('[recording]\nfolder = "~no-such-user/x"', "no user has the home ~no-such-user"),
        ('aircraft_folder = "~no-such-user"', "write the whole path"),
        ('[recording]\nmode = "sometimes"', "allowed: manual, in_flight, armed, always"),
    ],
)
def test_unusable_settings_are_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "gateway.toml"
    file.write_text(text + "\n")
    assert words in run("check-config", file, code=2)


def test_settings_with_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"
    file.write_bytes(b"\xef\xbb\xbf[recording]\nmode = 'always'\n")
    assert "all settings are right" in run("check-config", file)


def test_times_increase_across_a_restart_of_the_logs_clock(tmp_path: Path) -> None:
    path = log(tmp_path / "log.csv")
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows, *rows[:50], *rows, ""]))
    once, printed = tmp_path / "once.csv", run("info", path)
    assert "250 records in 0:02.480" not in printed
    assert "its clock went back" not in printed
    late = [f"{float(row.partition(',')[0]) + 60:.2f},{row.partition(',')[2]}" for row in rows]
    path.write_text("\n".join([head, *late, *rows, *late, ""]))
    printed = run("info", path)
    assert "300 records in 1:01.980" in printed
    assert "its clock went back 1 time;" in printed
    run("convert", path, "-o", once)
    times_us = [
        int(line.partition(",")[0])
        for line in once.read_text().splitlines()[2:]
        if line[:1].isdigit()
    ]
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
    run("catalogue", tmp_path, "--jobs", 1)
    assert "x[/y].csv" in run("catalogue", "list", "-d", tmp_path)
