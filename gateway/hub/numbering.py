"""Sequence numbers of our own frames where some are dropped and others overtake."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from gateway.hub.routing_table import MAX_ORIGINS, Origin
from gateway.wire.mavlink_splitter import MavFrame

SEQUENCE_MASK: Final = 0xFF


class Waiting(NamedTuple):
    """A frame that waits to be sent."""

    frame: MavFrame
    step: int | None
    """Its step, as `Numbering.enter` has returned it."""
    since_us: int
    client_id: int | None = None
    """The client that it answers, if any."""


@dataclass(slots=True)
class _Last:
    """The last number of an origin that entered, and the last with which a frame left."""

    entered: int
    left: int | None = None


class Numbering:
    """Renumber our own frames where some are dropped and others overtake.

    Each frame keeps its step from the frame before it in our own order; when frames leave, their
    steps add up. So without drops every frame leaves with its own number, gaps of a recording
    included, and with drops the numbers continue without a gap. Frames of others, for whose origin
    `is_own` returns False, are never changed.
    """

    def __init__(self, is_own: Callable[[Origin], bool] | None = None) -> None:
        self._is_own = is_own
        self._last: dict[Origin, _Last] = {}

    def enter(self, frame: MavFrame) -> int | None:
        """Return a frame's step, to be passed to `leave`; None for a frame of others."""
        origin, sequence = frame.origin, frame.sequence
        if self._is_own is not None and not self._is_own(origin):
            return None
        last = self._last.get(origin)
        if last is None:
            if len(self._last) < MAX_ORIGINS:
                self._last[origin] = _Last(sequence)
            return 1
        before, last.entered = last.entered, sequence
        return sequence - before & SEQUENCE_MASK

    def leave(self, frame: MavFrame, step: int) -> int:
        """Return the sequence number with which a frame is sent."""
        last = self._last.get(frame.origin)
        if last is None:
            return frame.sequence
        before = last.left
        wanted = last.left = frame.sequence if before is None else before + step & SEQUENCE_MASK
        return wanted
