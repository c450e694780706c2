"""The boards' own programs for the demo: from the checkout, not in the package."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame

CHECKOUT: Final = Path(__file__).resolve().parents[3]


class BenchError(RuntimeError):
    """The bench is missing, or cannot be built."""


def firmware_line(settings: SimulatorSettings, start_unix_us: int) -> Iterator[TimedFrame]:
    """Fly the simulated aircraft with the firmware on simulated chips.

    Parameters
    ----------
    settings : SimulatorSettings
        Of which the first aircraft flies.
    start_unix_us : int
        UTC at the start.

    Returns
    -------
    iterator of TimedFrame
        The receiver's frames, endless.

    Raises
    ------
    BenchError
        If this is no checkout, or a compiler or the chip simulator is missing.
    """
    if not (CHECKOUT / "firmware" / "rig").is_dir():
        raise BenchError("--firmware needs a checkout of the project, not an installed package")
    if str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    line = importlib.import_module("firmware.rig.line")
    try:
        frames: Iterator[TimedFrame] = line.frames(settings, start_unix_us)
    except (RuntimeError, OSError) as error:
        raise BenchError(f"--firmware: {error}") from error
    return frames
