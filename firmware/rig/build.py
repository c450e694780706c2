"""Build the programs and the shim with make, each set of settings in a folder of its own."""

import fcntl
import hashlib
import shutil
import subprocess
from pathlib import Path
from typing import Final

from firmware.rig.mcu import FIRMWARE

PACKAGES: Final = "make g++ gcc-avr binutils-avr avr-libc libsimavr-dev"
"""Debian packages that the programs, the shim and the bench need."""

PROGRAMS: Final = ("imu_node", "gps_node", "receiver")

_SIMAVR_HEADER: Final = Path("/usr/include/simavr/sim_avr.h")
_BUILD: Final = FIRMWARE / "build"


class BuildError(RuntimeError):
    """A tool is missing, or the compiler refused."""


def missing_tools() -> list[str]:
    """List what has to be installed first."""
    missing = [tool for tool in ("make", "g++", "avr-g++", "avr-nm") if shutil.which(tool) is None]
    return missing if _SIMAVR_HEADER.exists() else [*missing, "libsimavr"]


def build(
    settings: str = "",
    frequency_hz: int = 16_000_000,
    programs: tuple[str, ...] = PROGRAMS,
    radio: str = "nrf24",
) -> Path:
    """Build programs and the shim.

    Parameters
    ----------
    settings : str
        Definitions for `settings.h`, such as `-DIMU_RAW=1`.
    frequency_hz : int
        The boards' clock: 8 or 16 MHz.
    programs : tuple of str
        Which ones; all three by default.
    radio : str
        The driver, nrf24 or sx1276.

    Returns
    -------
    Path
        The folder with the `.hex` and `.elf` files.

    Raises
    ------
    BuildError
        If a tool is missing or the compiler refuses.
    """
    if missing := missing_tools():
        raise BuildError(f"{', '.join(missing)} not found: apt-get install {PACKAGES}")
    # As `make images` names it, so that neither builds again.
    folder = _BUILD / f"{radio}_{frequency_hz // 1_000_000}mhz"
    if settings:
        name = hashlib.sha256(f"{settings} {frequency_hz} {radio}".encode()).hexdigest()[:12]
        folder = _BUILD / f"variant-{name}"
    options = (f"SETTINGS={settings}", f"F_CPU={frequency_hz}UL", f"RADIO={radio}")
    make(*programs, f"BUILD={folder}", *options)
    make("rig")
    return folder


def make(*arguments: str) -> str:
    """Run make in the firmware's folder and return its output.

    Raises
    ------
    BuildError
        If it failed.
    """
    command = ["make", "-j2", "-C", str(FIRMWARE), *arguments]
    _BUILD.mkdir(exist_ok=True)
    with (_BUILD / "lock").open("w") as lock:
        # Two makes in one folder would read each other's half-written files.
        fcntl.flock(lock, fcntl.LOCK_EX)
        result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    if result.returncode:
        raise BuildError(f"{' '.join(command)}:\n{result.stdout[-2000:]}{result.stderr[-4000:]}")
    return result.stdout
