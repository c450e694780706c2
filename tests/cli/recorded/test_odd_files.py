"""Invalid input to the commands: the message states file, line, fault and remedy."""

import gc
import tracemalloc
from pathlib import Path

import msgspec
import pytest

from tests.cli.arrangements import NAMES, log, packed, table
from tests.kit.cli import run

pytestmark = pytest.mark.io


def run_within(peak_mb: int, *words: object) -> str:
    """Run a command that is refused, within bounded memory."""
    tracemalloc.start()
    printed = run(*words, code=2)
    assert tracemalloc.get_traced_memory()[1] < peak_mb << 20
    tracemalloc.stop()
    return printed


RATIO = "has a compression ratio above 100"


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
    # What the error refers to is removed with it, at the latest at the end of the process.
    gc.collect()
    assert not list(temporary.iterdir())


def test_times_increase_across_a_restart_of_the_logs_clock(tmp_path: Path) -> None:
    path = log(tmp_path)
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
    recorded = table(tmp_path, name="a\x1b[31m[red].csv")
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
    table(tmp_path / "x[", name="y].csv")
    assert "x[/y].csv" in run("info", tmp_path)
