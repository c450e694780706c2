"""Standard streams that are closed, full or know few signs: clear errors, and no traceback."""

import dataclasses
import io
import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from gateway.cli import app
from gateway.cli.live import clients
from gateway.cli.support.terminal import console_of, table_of
from tests.cli.machines import CLIENT
from tests.kit.cli import invoke, reset_logging

pytestmark = pytest.mark.io


def run(*words: str, stdout: int | None = subprocess.PIPE, closed: str = "", **env: str):
    head = ["/bin/sh", "-c", f'exec "$@" {closed}', "sh"] if closed else []
    return subprocess.run(
        [*head, sys.executable, "-m", "gateway.cli", *words],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=240,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **env},
        check=False,
    )


@pytest.mark.parametrize("closed", ["0>&- 1>&-", "2>&-"])
def test_command_succeeds_with_closed_streams(closed: str) -> None:
    done = run("doctor", "--template", "usual", closed=closed)
    assert (done.returncode, done.stderr) == (0, "")


def test_full_disk_behind_the_output_is_reported() -> None:
    full = os.open("/dev/full", os.O_WRONLY)
    done = run("doctor", "--template", "usual", stdout=full)
    os.close(full)
    assert done.returncode == 1
    assert done.stderr.splitlines()[0] == "output: No space left on device"
    assert "Traceback" not in done.stderr


def test_characters_missing_in_the_output_encoding_are_escaped() -> None:
    done = run("doctor", "--template", "all", PYTHONIOENCODING="ascii")
    assert done.returncode == 0
    assert r"\u" in done.stdout or r"\x" in done.stdout


def test_too_long_name_is_refused(tmp_path: Path) -> None:
    name = str(tmp_path / ("x" * 300))
    done = run("recover", name, "-o", str(tmp_path / "out.tlog"))
    assert done.returncode == 2
    assert done.stderr == f"{name}: File name too long\n"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_log_lines_stay_above_a_progress_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes the place of `sys.stderr` while it is shown."""
    before, above_the_bar = Terminal(), Terminal()
    reset_logging(monkeypatch)
    monkeypatch.setattr(sys, "stderr", before)
    app._begin_logging(verbose=False)
    monkeypatch.setattr(sys, "stderr", above_the_bar)
    logging.getLogger("gateway").warning("the port has gone")
    assert "the port has gone" in above_the_bar.getvalue()
    assert before.getvalue() == ""


def test_found_fonts_are_not_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first report of a machine collects them."""
    reset_logging(monkeypatch)
    invoke("--verbose", "doctor", "--template", "usual", code=0)
    assert logging.getLogger("gateway").isEnabledFor(logging.DEBUG)
    assert not logging.getLogger("matplotlib.font_manager").isEnabledFor(logging.INFO)


def test_client_fits_on_one_line_of_a_narrow_terminal() -> None:
    client = dataclasses.replace(
        CLIENT, name="udp:127.0.0.1:14550", state="refused", sent=1234567, systems=()
    )
    paper = io.StringIO()
    terminal = Console(file=paper, width=80, force_terminal=True, color_system=None)
    found = json.loads(msgspec.json.encode([client]))
    terminal.print(clients._clients(found, client.heard_us + 12_300_000))
    [row] = [line.split()[:3] for line in paper.getvalue().splitlines()[2:]]
    assert row == ["udp:127.0.0.1:14550", "refused", "1234567"]


def test_piped_tables_and_texts_are_never_wrapped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    rows = [("a name that is long", "a text that is long")]
    console_of().print(
        "a line that is as long", table_of("first", "second", left=2, rows=rows), sep="\n"
    )
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "a line that is as long"
    assert lines[-1] == "a name that is long a text that is long"


def test_template_is_written_into_a_new_folder_for_its_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    file = tmp_path / ".config" / "mavgate" / "gateway.toml"
    assert invoke("doctor", "--write").output == f"wrote {file}\n"
    template = file.read_text()
    assert template == invoke("doctor", "--template", "usual").output
    assert file.stat().st_mode & 0o777 == 0o600
    assert invoke("doctor", "--template", "all").output.count("\n[") > template.count("\n[")
