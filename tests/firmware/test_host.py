"""The portable half of the firmware, compiled for the PC under sanitizers."""

from collections.abc import Callable
from pathlib import Path

import pytest

from firmware.rig.build import make

pytestmark = [pytest.mark.io, pytest.mark.slow]


def test_host_tests_pass(build: Callable[..., Path]) -> None:
    assert " 0 failed checks" in make("host-test")
