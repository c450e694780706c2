"""Programs are small, build for every board, and the checker finds nothing."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware.rig.build import make

pytestmark = [pytest.mark.io, pytest.mark.slow]

SIZES = re.compile(r"^(\w+) +flash +(\d+) bytes .*static RAM +(\d+) bytes", re.MULTILINE)
FLASH, RAM = 32768, 2048


def test_every_program_fits_flash_and_ram(programs: Path) -> None:
    said = make("all", f"BUILD={programs}")
    found = {name: (int(flash), int(ram)) for name, flash, ram in SIZES.findall(said)}
    assert set(found) == {"imu_node", "gps_node", "receiver"}
    for flash, ram in found.values():
        assert flash < 0.7 * FLASH
        assert ram < 0.6 * RAM


@pytest.mark.parametrize("settings", ["-DVEHICLE_ID=32", "-DIMU_SEND_HZ=300", "-DBARO_HZ=31"])
def test_impossible_settings_are_refused(build: Callable[..., Path], settings: str) -> None:
    with pytest.raises(RuntimeError, match="static assertion failed"):
        build(settings, programs=("imu_node",))


def test_cppcheck_finds_nothing(programs: Path) -> None:
    if shutil.which("cppcheck") is None:
        pytest.skip("cppcheck not found: apt-get install cppcheck")
    make("lint")
