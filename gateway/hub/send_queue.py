"""What waits for a slow link: bounded, the urgent first, numbered as it leaves.

Four queues. The answers a person waits for, and after them the attitude, are urgent; other
telemetry is usual; parameters, missions and files are bulk. An urgent frame goes first, but after
a few of them one of the others gets its turn, so that a parameter list is slow on a slow radio but
completes. When the bound is reached the oldest telemetry is dropped, usual before urgent, and
answers last: telemetry comes again, an answer does not. Bulk has a bound of its own, since all
parameters come at once. Where a link is slower than what is sent, old telemetry expires: it would
be as late as the queue is long.

Frames leave in another order than they came, and some are dropped; so our own frames are numbered
at the exit. Loss that a ground station shows is then only that of the link.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Final

from gateway.hub.endpoint import BITS_PER_BYTE
from gateway.hub.routing_table import MAX_ORIGINS, Origin
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import origin_of, restamp, sequence_of

ANSWER_IDS: Final = frozenset({0, 75, 76, 77, 253})
"""HEARTBEAT, commands and their answers, STATUSTEXT: the next one does not make up for one."""
URGENT_IDS: Final = frozenset({30, 31, 61, 69, 70})
"""The attitudes, manual control and overrides."""
BULK_IDS: Final = frozenset(
    {20, 21, 22, 23, 36, 110, 148, 300, 320, 321, 322, 323, 324, 395, 396, 397, 410}
    | set(range(37, 52)) - {42}
    | {73}
    | set(range(117, 123))
)
"""Parameters, mission transfers, files, logs, versions: asked for, and waited for."""

BULK_BYTES: Final = 16_384
"""Least room for bulk: the parameters of three aircraft."""
URGENT_RUN: Final = 4
"""Urgent frames in a row before one of another queue has its turn."""

SEQUENCE_MASK: Final = 0xFF
Waiting = tuple[bytes, int | None]
"""A frame and its step."""
_Queue = deque[tuple[bytes, int | None, int]]
"""Frames, their steps, and when they were pushed."""


class Numbering:
    """Renumber our own frames on a link that drops some and lets others overtake.

    Each frame keeps its step from the one before it in our own order; at the exit the steps of
    those that leave add up. So without drops every frame leaves as it came, gaps of a recording
    included, and with drops the numbers run on without a gap.
    Signed frames are signed again, since a frame that was overtaken has too early a time stamp.

    Parameters
    ----------
    is_own : callable
        Whether an origin is one of our vehicles; frames of others are never touched.
    seal : callable
        Numbers, and signs, each frame of ours that leaves.
    """

    def __init__(self, is_own: Callable[[Origin], bool], seal: Seal = restamp) -> None:
        self._is_own = is_own
        self._seal = seal
        self._came: dict[Origin, int] = {}
        self._left: dict[Origin, int] = {}

    def enter(self, frame: bytes) -> int | None:
        """Return a frame's step, to be handed to `leave`; None for a frame of others."""
        origin = origin_of(frame)
        if not self._is_own(origin):
            return None
        sequence = sequence_of(frame)
        before = self._came.get(origin, sequence - 1)
        if len(self._came) < MAX_ORIGINS or origin in self._came:
            self._came[origin] = sequence
        return sequence - before & SEQUENCE_MASK

    def leave(self, frame: bytes, step: int | None) -> bytes:
        """Return a frame as it is to be sent."""
        if step is None:
            return frame
        origin = origin_of(frame)
        wanted = self._left.get(origin, sequence_of(frame) - step) + step & SEQUENCE_MASK
        if len(self._left) < MAX_ORIGINS or origin in self._left:
            self._left[origin] = wanted
        return self._seal(frame, wanted)


class Outbox:
    """A bounded queue in front of one slow link.

    Parameters
    ----------
    max_bytes : int
        Most bytes that wait beside bulk; the newest frame is always taken.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.max_bulk_bytes = max(max_bytes, BULK_BYTES)
        self._sizes = [0, 0]
        """Bytes that wait beside bulk, and of bulk."""
        self._answers: _Queue = deque()
        self._urgent: _Queue = deque()
        self._usual: _Queue = deque()
        self._bulk: _Queue = deque()
        self._run = 0
        self._bulk_turn = False

    def __len__(self) -> int:
        return sum(map(len, (self._answers, self._urgent, self._usual, self._bulk)))

    @property
    def size(self) -> int:
        """Bytes that wait."""
        return sum(self._sizes)

    def push(self, frame: bytes, message_id: int, step: int | None = None, now_us: int = 0) -> int:
        """Take a frame in.

        Parameters
        ----------
        frame : bytes
            A complete frame.
        message_id : int
            Decides in which queue it waits.
        step : int, optional
            Returned with the frame; see `Numbering`.
        now_us : int, optional
            Gateway time; see `expire`.

        Returns
        -------
        int
            How many older frames were dropped for it.
        """
        size, dropped = len(frame), 0
        if message_id in BULK_IDS:
            queue = self._bulk
            while queue and self._sizes[1] + size > self.max_bulk_bytes:
                self._take(queue)
                dropped += 1
        else:
            queue = self._usual
            if message_id in URGENT_IDS:
                queue = self._urgent
            elif message_id in ANSWER_IDS:
                queue = self._answers
            while self._sizes[0] and self._sizes[0] + size > self.max_bytes:
                self._take(self._usual or self._urgent or self._answers)
                dropped += 1
        queue.append((frame, step, now_us))
        self._sizes[queue is self._bulk] += size
        return dropped

    def expire(self, before_us: int) -> int:
        """Drop the telemetry that was pushed before a time; return how many frames that were."""
        dropped = 0
        for queue in (self._usual, self._urgent):
            while queue and queue[0][2] < before_us:
                self._take(queue)
                dropped += 1
        return dropped

    def pop(self) -> Waiting | None:
        """Return the frame that leaves next with its step, or None if nothing waits."""
        urgent = self._answers or self._urgent
        others = bool(self._usual or self._bulk)
        if urgent and not (others and self._run >= URGENT_RUN):
            self._run += 1
            return self._take(urgent)
        if not others:
            return None
        self._run = 0
        self._bulk_turn = not self._bulk_turn
        first, second = self._usual, self._bulk
        if self._bulk_turn:
            first, second = second, first
        return self._take(first or second)

    def clear(self) -> int:
        """Forget all that waits; return how many frames that were."""
        count = len(self)
        for queue in (self._answers, self._urgent, self._usual, self._bulk):
            queue.clear()
        self._sizes = [0, 0]
        return count

    def _take(self, queue: "_Queue") -> Waiting:
        frame, step, _ = queue.popleft()
        self._sizes[queue is self._bulk] -= len(frame)
        return frame, step


class Packer:
    """Gather frames into datagrams.

    Parameters
    ----------
    max_bytes : int
        Largest datagram; a single longer frame still goes, alone.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._frames: list[bytes] = []
        self._size = 0

    def add(self, frame: bytes) -> list[bytes]:
        """Take a frame in; return the frames of the datagram that is full now, or none."""
        full: list[bytes] = []
        if self._size + len(frame) > self._max_bytes:
            full = self.flush()
        self._frames.append(frame)
        self._size += len(frame)
        return full

    def flush(self) -> list[bytes]:
        """Return what has been gathered."""
        frames, self._frames = self._frames, []
        self._size = 0
        return frames


class Pacer:
    """Keep the buffer of a serial line short, so that urgent frames need not wait behind it.

    A driver takes kilobytes at once, which at 57600 Bd is most of a second. The pacer computes
    when the line will have sent what it was given and lets the next frame in just before.

    Parameters
    ----------
    baud : int
        Line rate.
    ahead_us : int
        How much may lie in the driver's buffer.
    """

    def __init__(self, baud: int, ahead_us: int) -> None:
        self._baud = baud
        self._ahead_us = ahead_us
        self._free_us = 0

    def delay_us(self, now_us: int) -> int:
        """Return how long to wait until the next frame may be written; 0 is now."""
        return max(0, self._free_us - self._ahead_us - now_us)

    def wrote(self, size: int, now_us: int) -> None:
        """Note that bytes were given to the driver."""
        busy_us = math.ceil(size * BITS_PER_BYTE * US_PER_S / self._baud)
        self._free_us = max(self._free_us, now_us) + busy_us
