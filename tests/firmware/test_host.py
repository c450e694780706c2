"""The portable half of the firmware, compiled for the PC under sanitizers."""

import pytest

from tests.firmware.conftest import make, need

pytestmark = [pytest.mark.io, pytest.mark.slow]


def test_the_host_tests_pass() -> None:
    need("make", "g++")
    result = make("host-test")
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    assert "0 failed checks" in result.stdout
