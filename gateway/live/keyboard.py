"""Keys of a terminal, one by one and without an echo, on the event loop."""

import asyncio
import contextlib
import os
import re
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from typing import Any, Final

READ_BYTES: Final = 64

_SEQUENCE: Final = re.compile(r"\x1b(?:[\[O]([0-9;]*)([A-Za-z~]))?")
_NAMES: Final = {"A": "up", "B": "down", "C": "right", "D": "left", "H": "home", "F": "end"}


def keys_of(text: str) -> Iterator[str]:
    """Yield the names of the keys that a terminal sent.

    Parameters
    ----------
    text : str
        What was read.

    Yields
    ------
    str
        A printable character, `space`, `up`, `down`, `left`, `right`, `home` or `end`; others are
        left out.
    """
    at = 0
    while at < len(text):
        sequence = _SEQUENCE.match(text, at)
        if sequence is not None:
            at = sequence.end()
            if name := _NAMES.get(sequence[2] or ""):
                yield name
            continue
        if text[at] == " ":
            yield "space"
        elif text[at].isprintable():
            yield text[at]
        at += 1


class Keyboard:
    """The terminal of a command; without one, nothing happens.

    Parameters
    ----------
    on_key : callable
        Called with each key's name; see `keys_of`.
    descriptor : int, optional
        The terminal; standard input by default.
    """

    def __init__(self, on_key: Callable[[str], None], descriptor: int | None = None) -> None:
        self._on_key = on_key
        self._descriptor = descriptor
        self._before: list[Any] | None = None

    def start(self) -> None:
        """Start reading keys; needs a running event loop."""
        try:
            fd = sys.stdin.fileno() if self._descriptor is None else self._descriptor
            # A background job would be stopped for touching the terminal.
            if not os.isatty(fd) or os.tcgetpgrp(fd) != os.getpgrp():
                return
            self._before = termios.tcgetattr(fd)
            tty.setcbreak(fd)
        except (OSError, ValueError, termios.error):
            return
        self._descriptor = fd
        asyncio.get_running_loop().add_reader(fd, self._read, fd)

    def close(self) -> None:
        """Restore the terminal."""
        if self._before is None or self._descriptor is None:
            return
        asyncio.get_running_loop().remove_reader(self._descriptor)
        # The window may have been closed.
        with contextlib.suppress(termios.error):
            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)
        self._before = None

    def _read(self, fd: int) -> None:
        try:
            data = os.read(fd, READ_BYTES)
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        for key in keys_of(data.decode(errors="ignore")):
            self._on_key(key)
