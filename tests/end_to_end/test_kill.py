"""A recorder that is killed leaves recordings that open."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "kill_recorder.py"


@pytest.mark.io
@pytest.mark.slow
def test_kills_and_cuts_lose_nothing_that_was_written() -> None:
    """How much of the rest is lost depends on the disk; the tool prints it."""
    done = subprocess.run(
        [sys.executable, str(TOOL), "--kills", "3", "--seed", "7", "--any-loss"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "3 kills: every recording opens" in done.stdout
