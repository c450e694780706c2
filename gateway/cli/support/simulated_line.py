"""The frames of a simulated receiver: made by a process of their own, or by simulated boards."""

import importlib
import logging
import signal
import sys
from collections.abc import Iterator
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from gateway.analysis.processes import begin_copy
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame

log = logging.getLogger(__name__)

AT_ONCE: Final = 16
"""Frames that cross at once; the pipe holds some hundreds, which are made ahead."""


def made_ahead(frames: Iterator[TimedFrame]) -> Iterator[TimedFrame]:
    """Let a background process make frames, so that the event loop that plays them need not.

    Parameters
    ----------
    frames : iterator of TimedFrame
        Used in that process alone, which ends with this one.

    Returns
    -------
    iterator of TimedFrame
        The same frames.
    """
    return _take(begin_copy(_make, frames))


def _take(receiver: Connection) -> Iterator[TimedFrame]:
    with receiver:
        while True:
            try:
                made = receiver.recv()
            except EOFError:
                log.warning("the simulated receiver has ended")
                return
            for time_s, data, damaged in made:
                yield TimedFrame(time_s, data, damaged)


def _make(frames: Iterator[TimedFrame], sender: Connection) -> None:
    # A terminal's Ctrl+C, and its end, are for the gateway, which ends this process.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    while made := [(f.time_s, f.data, f.damaged) for f in islice(frames, AT_ONCE)]:
        sender.send(made)


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
