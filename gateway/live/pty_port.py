"""A pseudo-terminal that behaves like the receiver's serial port, at the true rate.

A program that opens `path` reads the same as from a USB adapter: bytes at their times, and none
from before (except the few kilobytes in the kernel, which opening flushes).
"""

import asyncio
import os
import tty
from collections.abc import Iterator
from typing import Final

from gateway.simulator.timed_frame import TimedFrame

MAX_LATE_S: Final = 1.0
"""A later frame is dropped, as a receiver drops unread data: sending it would delay the loop even
more, and pausing the clocks of the nodes would look like a restart of them."""
SUSPENDED_S: Final = 60.0
"""After a longer delay, as of a suspended machine, the frames continue without drops."""
CATCH_UP_S: Final = 2.0
"""Frames that stay late for longer are generated too slowly: all of them would be dropped."""
DROPS_AT_ONCE: Final = 64
"""Frames dropped in the time of writing one: they cost little more than their generation."""

NAME: Final = "pseudo-terminal of the simulated receiver (/dev/ptmx)"
MAX_BATCH: Final = 4
"""Maximum frames written before the loop's other work gets its turn; some are generated first."""


class PtyPort:
    """Play timed frames on a pseudo-terminal; never blocks, never grows."""

    def __init__(self, frames: Iterator[TimedFrame]) -> None:
        """Open the terminal; raises OSError if the machine has none left."""
        self.written = 0
        """Frames written completely."""
        self.dropped = 0
        """Frames dropped because the terminal is full, or because they were late."""
        self.ended = asyncio.Event()
        """Set after the last frame, and by closing."""
        self._frames = frames
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            # Its own text names nothing: "No such device", or "out of pty devices".
            raise OSError(error.errno, error.strerror, NAME) from error
        # Generated before `start`, since the first frame takes as long as many of the others.
        self._next = next(frames, None)
        self._rest = b""
        self._start_s = 0.0
        self._late_since_s: float | None = None
        self._timer: asyncio.Handle | None = None
        # Our own end of the slave stays open, so a reader that leaves causes no hang-up.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        """The device to open instead of a serial port."""

    def start(self) -> None:
        """Start: the frames' time zero is now. Needs a running event loop."""
        self._start_s = asyncio.get_running_loop().time()
        self._advance()

    def close(self) -> None:
        """Stop and remove the terminal; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1
        self.ended.set()

    def _advance(self) -> None:
        loop = asyncio.get_running_loop()
        self._timer = None
        budget = MAX_BATCH * DROPS_AT_ONCE
        while budget > 0:
            if self._next is None:
                self._next = next(self._frames, None)
            if self._next is None:
                self.ended.set()
                return
            due_s = self._start_s + self._next.time_s
            late_s = loop.time() - due_s
            if late_s < 0.0:
                self._timer = loop.call_at(due_s, self._advance)
                return
            if late_s <= MAX_LATE_S:
                self._late_since_s = None
            elif self._is_dropped(late_s):
                self.dropped += 1
                budget -= MAX_BATCH
                self._next = None
                continue
            else:
                self._start_s += late_s
            self._write(self._next.data)
            budget -= DROPS_AT_ONCE
            self._next = None
        self._timer = loop.call_soon(self._advance)

    def _is_dropped(self, late_s: float) -> bool:
        """Return whether to drop a late frame to catch up, instead of shifting the time."""
        now_s = asyncio.get_running_loop().time()
        if self._late_since_s is None:
            self._late_since_s = now_s
        if late_s <= SUSPENDED_S and now_s - self._late_since_s <= CATCH_UP_S:
            return True
        self._late_since_s = None
        return False

    def _write(self, data: bytes) -> None:
        """Write one frame, keep its unwritten end for the next call, or drop it."""
        if self._rest:
            self._rest = self._rest[self._put(self._rest) :]
        if self._rest:
            self.dropped += 1
            return
        count = self._put(data)
        if count:
            self.written += 1
            self._rest = data[count:]
        else:
            self.dropped += 1

    def _put(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
