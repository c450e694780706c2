"""Commands are imported when they are called, and the list agrees with them."""

import subprocess
import sys
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from gateway.cli.app import COMMANDS, MODULES, app, load_command

CLI = Path(__file__).resolve().parents[2] / "gateway" / "cli"
LARGE = (
    *("numba", "numpy", "scipy", "pandas", "pymavlink", "matplotlib", "nicegui"),
    *("mcap", "pyarrow", "pyulog"),
)


@pytest.mark.parametrize("name", COMMANDS)
def test_listed_summary_is_first_paragraph_of_command_help(name: str) -> None:
    command = load_command(name)
    assert command.help is not None
    assert " ".join(command.help.split("\n\n")[0].split()) == COMMANDS[name]


def test_every_command_of_every_file_is_listed() -> None:
    files = [path for room in ("live", "recorded") for path in (CLI / room).glob("[!_]*.py")]
    modules = {f"{path.parent.name}.{path.stem}" for path in files}
    assert set(MODULES) == modules
    assert {name for names in MODULES.values() for name in names} == set(COMMANDS)
    for module, listed in MODULES.items():
        part = typer.main.get_group(import_module(f"gateway.cli.{module}").app)
        assert set(part.commands) == set(listed)


@pytest.mark.parametrize("words", [["play"], ["sweep"], ["clients", "add"], []], ids=" ".join)
def test_help_flows_to_the_width_and_names_no_type_of_a_flag(words: list[str]) -> None:
    found = CliRunner().invoke(app, [*words, "--help"], terminal_width=80, env={"COLUMNS": "80"})
    above = found.output.partition("╭")[0].splitlines()
    text = [line.strip() for line in above if line.strip() and "Usage" not in line]
    # A line ends early only where the next word does not fit, or a paragraph ends.
    for line, after in pairwise(text):
        assert line.endswith(".") or len(f"{line} {after.split()[0]}") > 70, line
    assert "<bool>" not in found.output


def test_help_lists_every_command() -> None:
    found = CliRunner().invoke(app, ["--help"], terminal_width=200)
    assert found.exit_code == 0
    assert [name for name in COMMANDS if f" {name} " not in found.output] == []


@pytest.mark.parametrize(
    "words", [["--help"], ["status"], ["clients", "list"], ["mark", "1", "2"], ["ports"],
              ["record", "status"], ["nonsense"]],
    ids=" ".join,
)  # fmt: skip
def test_small_commands_import_nothing_large(words: list[str], tmp_path: Path) -> None:
    # What parses options takes as long as all else that `--help` needs.
    large = {*LARGE, "pydantic"} if words == ["--help"] else {*LARGE}
    program = (
        "import sys; from gateway.cli.app import main; sys.argv = ['mavgate', *sys.argv[1:]]\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print(*({large!r} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=CLI.parents[1],
        env={"HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path), "PATH": "/usr/bin:/bin"},
    )
    assert done.stderr.splitlines()[-1] == ""
