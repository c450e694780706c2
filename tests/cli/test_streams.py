"""Standard streams that are closed, full or know few signs: clear errors, and no traceback."""

import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli import app
from tests.kit.cli import invoke, reset_logging

pytestmark = pytest.mark.io


def run(*words: str, stdout: int | None = subprocess.PIPE, closed: int | None = None, **env: str):
    head = [] if closed is None else ["/bin/sh", "-c", f'exec "$@" {closed}>&-', "sh"]
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


@pytest.mark.parametrize("closed", [0, 1, 2])
def test_command_succeeds_with_a_closed_stream(closed: int) -> None:
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
