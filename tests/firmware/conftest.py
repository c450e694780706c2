"""The firmware's tests need compilers and the simulator; without them they are skipped."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
FIRMWARE = ROOT / "firmware"
PACKAGES = "gcc-avr avr-libc libsimavr-dev libelf-dev g++ make cppcheck"

sys.path.insert(0, str(ROOT))


def need(*programs: str) -> None:
    missing = [program for program in programs if shutil.which(program) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not found: apt-get install {PACKAGES}")


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = ["make", "-j2", "-C", str(FIRMWARE), f"PYTHON={sys.executable}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
