"""A process and its terminal: its end, keys, and output that never blocks.

A parent process gives a child a pipe as standard input and keeps the other end open: the kernel
closes that end even if the parent is killed. A terminal that is stopped (Ctrl-S, a hanging
connection) and a pipe that is not read block a writing process, which in a gateway would be the
event loop; so a thread writes, and while it is blocked, output beyond a bound is dropped.
"""

import asyncio
import contextlib
import io
import logging
import os
import queue
import re
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from typing import Any, Final, TextIO

READ_BYTES: Final = 1024
"""Bytes of one read of standard input, whose content is ignored."""
MAX_TEXTS: Final = 256
"""Maximum waiting texts, lines of the log or live views: at most about a megabyte."""
FLUSH_TIMEOUT_S: Final = 1.0
"""Longest wait at the end for pending output."""
KEY_BYTES: Final = 64
_KEY: Final = re.compile(r"\x1b(?:[\[O][0-9;]*([A-Za-z~]))?|(.)", re.DOTALL)
_NAMES: Final = {"A": "up", "B": "down", "C": "right", "D": "left", "H": "home", "F": "end"}


def on_parent_gone(end: Callable[[], None]) -> None:
    """Call back on the running event loop, once, when standard input ends."""
    loop, source = asyncio.get_running_loop(), sys.stdin.fileno()

    def read() -> None:
        if not os.read(source, READ_BYTES):
            loop.remove_reader(source)
            end()

    loop.add_reader(source, read)


def on_end_signals(end: Callable[[], None]) -> None:
    """Call back on the running event loop on SIGINT, SIGTERM, and SIGHUP (terminal closed).

    SIGHUP stays ignored if it is ignored at the start, as by `nohup`.
    """
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            loop.add_signal_handler(number, end)


def own_command(*words: str) -> list[str]:
    """Return the command line that starts mavgate as a child process.

    `-P` keeps the current folder off the child's module path: a `msgspec.py` among unpacked
    recordings would be imported instead of the library.
    """
    return [sys.executable, "-P", "-m", "gateway.cli", *words]


class DetachedStream(io.TextIOBase):
    """A text stream whose `write` returns at once; a thread writes to another stream's file."""

    def __init__(self, stream: TextIO) -> None:
        stream.flush()
        self._stream = stream
        self._file = stream.fileno()
        self._waiting: queue.Queue[bytes | None] = queue.Queue(MAX_TEXTS)
        self._thread = threading.Thread(target=self._write_all, name="output", daemon=True)
        self._thread.start()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Encoding of the stream."""
        return self._stream.encoding

    def fileno(self) -> int:
        """Return the stream's file descriptor."""
        return self._file

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return self._stream.isatty()

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, text: str) -> int:
        """Pass a text on; it is dropped if too many wait."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(text.encode(self.encoding, "backslashreplace"))
        return len(text)

    def finish(self) -> None:
        """Wait for pending output, with a timeout."""
        try:
            self._waiting.put_nowait(None)
        except queue.Full:
            return
        self._thread.join(FLUSH_TIMEOUT_S)

    def _write_all(self) -> None:
        while (data := self._waiting.get()) is not None:
            while data:
                try:
                    data = data[os.write(self._file, data) :]
                except BlockingIOError:
                    select.select([], [self._file], [])
                except OSError:
                    # The terminal has gone, or the disk is full: the text is lost.
                    break


@contextlib.contextmanager
def detached_output() -> Iterator[None]:
    """Detach standard output, standard error and the log's handlers from the event loop."""
    before = sys.stdout, sys.stderr
    detached = {stream: DetachedStream(stream) for stream in before if _has_file(stream)}
    sys.stdout, sys.stderr = (detached.get(stream, stream) for stream in before)
    handlers = [
        handler
        for handler in logging.getLogger().handlers
        if isinstance(handler, logging.StreamHandler) and handler.stream is before[1]
    ]
    for handler in handlers:
        handler.setStream(sys.stderr)
    try:
        yield
    finally:
        for handler in handlers:
            handler.setStream(before[1])
        sys.stdout, sys.stderr = before
        for stream in detached.values():
            stream.finish()


def _has_file(stream: TextIO) -> bool:
    try:
        stream.fileno()
    except (OSError, ValueError):
        return False
    return True


def keys_of(text: str) -> Iterator[str]:
    """Yield the keys that a terminal sent: printable characters, `space`, `up`, `home` and such."""
    for sequence, letter in _KEY.findall(text):
        if letter == " ":
            yield "space"
        elif letter.isprintable() and letter:
            yield letter
        elif sequence in _NAMES:
            yield _NAMES[sequence]


class Keyboard:
    """The terminal of a command; without one, nothing happens."""

    def __init__(self, on_key: Callable[[str], None], descriptor: int | None = None) -> None:
        """Call back with each key's name; the terminal is standard input by default."""
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
            data = os.read(fd, KEY_BYTES)
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        for key in keys_of(data.decode(errors="ignore")):
            self._on_key(key)
