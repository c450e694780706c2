"""What a process ends with: its signals, its terminal, and as a child with its parent.

The parent gives a child a pipe as standard input and keeps the other end open. The kernel closes
that end even if the parent is killed.
"""

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from typing import Final

READ_BYTES: Final = 1024
"""Nothing is meant to come; what comes is ignored."""


def on_parent_gone(end: Callable[[], None]) -> None:
    """Call back on the running event loop when standard input ends.

    Parameters
    ----------
    end : callable
        Called once.
    """
    loop, source = asyncio.get_running_loop(), sys.stdin.fileno()

    def read() -> None:
        if not os.read(source, READ_BYTES):
            loop.remove_reader(source)
            end()

    loop.add_reader(source, read)


def on_end_signals(end: Callable[[], None]) -> None:
    """Call back on the running event loop on SIGINT, SIGTERM, and SIGHUP, with a terminal's end.

    SIGHUP stays ignored where it is at the start, as by `nohup`.

    Parameters
    ----------
    end : callable
        Called at each of them.
    """
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            loop.add_signal_handler(number, end)


def own_command(*words: str) -> list[str]:
    """Return the command line that starts mavgate as a child process.

    `-P` keeps the current folder off the child's module path: a `msgspec.py` among unpacked
    recordings would be imported instead of the library.

    Parameters
    ----------
    *words : str
        Command and options, as after `mavgate`.

    Returns
    -------
    list of str
    """
    return [sys.executable, "-P", "-m", "gateway.cli", *words]
