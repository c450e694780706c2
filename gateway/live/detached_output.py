"""Standard output and error that never make their writer wait.

A terminal that is stopped (Ctrl-S, a connection that hangs) and a pipe that nobody reads block who
writes to them. In a gateway that would be the event loop; so a thread of its own writes, and what
is too much meanwhile is dropped.
"""

import contextlib
import io
import logging
import os
import queue
import select
import sys
import threading
from collections.abc import Iterator
from typing import Final, TextIO

MAX_TEXTS: Final = 256
"""Lines of the log, or pictures of the live view, that wait: at most about a megabyte."""
LAST_WORDS_S: Final = 1.0
"""Longest that the end waits for what is still to be written."""


class DetachedStream(io.TextIOBase):
    """A text stream whose `write` returns at once; a thread does the writing.

    Parameters
    ----------
    stream : file object
        What it stands for; must have a file descriptor.
    """

    def __init__(self, stream: TextIO) -> None:
        stream.flush()
        self._stream = stream
        self._file = stream.fileno()
        self._is_terminal = stream.isatty()
        self._waiting: queue.Queue[bytes | None] = queue.Queue(MAX_TEXTS)
        self._thread = threading.Thread(target=self._write_all, name="output", daemon=True)
        self._thread.start()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """That of the stream."""
        return self._stream.encoding

    def fileno(self) -> int:
        """Return the stream's file descriptor."""
        return self._file

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return self._is_terminal

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, text: str) -> int:
        """Pass a text on; it is dropped if too many wait."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(text.encode(self.encoding, "backslashreplace"))
        return len(text)

    def finish(self) -> None:
        """Wait for what is still to be written, but not for long."""
        try:
            self._waiting.put_nowait(None)
        except queue.Full:
            return
        self._thread.join(LAST_WORDS_S)

    def _write_all(self) -> None:
        while (data := self._waiting.get()) is not None:
            while data:
                try:
                    data = data[os.write(self._file, data) :]
                except BlockingIOError:
                    select.select([], [self._file], [])
                except OSError:
                    # The terminal has gone, or the disk is full: nobody reads this one.
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
