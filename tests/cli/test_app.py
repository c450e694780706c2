"""Commands are imported when they are called, and the list agrees with them."""

import re
import sys
from collections.abc import Iterator
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import typer
from typer.testing import CliRunner

from gateway.cli.app import COMMANDS, GROUPS, app, hoisted, load_command
from tests.kit.cli import invoke, run

CLI = Path(__file__).resolve().parents[2] / "gateway" / "cli"


def test_listed_summary_is_first_paragraph_of_command_help() -> None:
    helps = {name: load_command(name).help.split("\n\n")[0] for name in COMMANDS}
    assert {name: " ".join(text.split()) for name, text in helps.items()} == COMMANDS


def test_every_command_of_every_file_is_listed() -> None:
    found = set[str]()
    for path in (path for room in ("live", "recorded") for path in (CLI / room).glob("[!_]*.py")):
        module = import_module(f"gateway.cli.{path.parent.name}.{path.stem}")
        found |= set(typer.main.get_group(module.app).commands)
    assert found == set(COMMANDS)


@pytest.mark.parametrize("words", [["play"], ["sweep"], ["clients", "add"], []], ids=" ".join)
def test_help_flows_to_the_width_and_names_no_type_of_a_flag(words: list[str]) -> None:
    found = CliRunner().invoke(app, [*words, "--help"], terminal_width=80, env={"COLUMNS": "80"})
    above = found.output.partition("╭")[0].splitlines()
    text = [line.strip() for line in above if line.strip() and "Usage" not in line]
    # A line ends early only where the next word does not fit, or a paragraph ends.
    for line, after in pairwise(text):
        assert line.endswith(".") or len(f"{line} {after.split()[0]}") > 70, line
    assert "<bool>" not in found.output


def leaves_of(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    yield words
    for name, below in getattr(command, "commands", {}).items():
        yield from leaves_of(below, (*words, name))


def all_commands() -> list[tuple[str, ...]]:
    return [words for name in COMMANDS for words in leaves_of(load_command(name), (name,))]


@pytest.mark.parametrize("option", ["-h", "--help"])
def test_every_command_and_group_shows_its_help(option: str) -> None:
    for words in ((), *all_commands()):
        assert "Usage: " in invoke(*words, option, code=0).output, words


def test_help_lists_commands_by_reader() -> None:
    output = CliRunner().invoke(app, ["--help"], terminal_width=100).output
    at = [output.index(f"╭─ {heading} ─") for heading in GROUPS]
    assert at == sorted(at)
    for (begin, end), below in zip(pairwise([*at, len(output)]), GROUPS.values(), strict=True):
        assert re.findall(r"^│ ([a-z-]+) ", output[begin:end], re.MULTILINE) == [*below]


@pytest.mark.parametrize(
    ("words", "moved"),
    [
        ("info x --config f", "--config f info x"),
        ("info x -c f --json", "-c f info x --json"),
        ("--config=f info x", "--config=f info x"),
        ("status --socket s", "--socket s status"),
        ("info -- --config f", "info -- --config f"),
        ("info --config", "--config"),
    ],
)
def test_settings_and_socket_may_follow_the_command(words: str, moved: str) -> None:
    assert hoisted(words.split()) == moved.split()


def test_user_without_a_home_gets_defaults_and_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("pwd.getpwuid", Mock(side_effect=KeyError))
    monkeypatch.delenv("HOME")
    assert "no recordings in /mavgate/recordings" in run("info")
    assert "HOME is not set" in caplog.text


@pytest.mark.parametrize(
    ("typed", "offered"), [("mavgate doc", "doctor"), ("mavgate doctor --he", "--help")]
)
def test_shell_completion_offers_commands_and_options(
    typed: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_MAVGATE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    monkeypatch.setattr(sys, "argv", ["mavgate"])
    with pytest.raises(SystemExit):
        app(prog_name="mavgate")
    assert offered in capsys.readouterr().out.split()
