"""Confirmations and errors of `mavgate play` and `player` before they play."""

from pathlib import Path

import pytest

from tests.kit.cli import invoke

pytestmark = pytest.mark.io


def test_playing_commands_beyond_this_machine_needs_a_confirmation(tmp_path: Path) -> None:
    file = str(tmp_path / "missing.tlog")
    away = ("--endpoint", "udp:tablet.example:14550")
    asked = invoke("play", file, "--with-commands", *away, answers="n\n", code=1)
    assert "udp:tablet.example:14550" in asked.output
    for options in (("--yes", *away), ("--endpoint", "udp:127.0.0.1:14550")):
        # They get as far as the file.
        done = invoke("play", file, "--with-commands", *options)
        assert (done.exit_code, "No such file" in done.output) == (2, True)
    plain = invoke("play", file, *away)
    assert (plain.exit_code, "No such file" in plain.output) == (2, True)


@pytest.mark.parametrize("speed", ["0", "nan", "101", "fast", ""])
@pytest.mark.parametrize("words", [["play", "x.tlog", "--speed"], ["player", "speed"]])
def test_speed_out_of_range_is_refused(words: list[str], speed: str) -> None:
    done = invoke(*words, speed, code=2)
    assert f"speed {speed!r}: write 0.1 to 100, or max" in done.output
