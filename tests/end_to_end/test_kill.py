"""A recorder that is killed leaves recordings that open."""

import pytest

from tests.kit.process import python


@pytest.mark.io
@pytest.mark.slow
def test_kills_lose_nothing_that_was_written() -> None:
    """How much of the rest is lost depends on the disk; the tool prints it."""
    done = python("-m", "tools.kill_recorder", "--kills", 3, "--seed", 7, "--any-loss")
    assert "3 kills: every recording opens" in done.stdout
