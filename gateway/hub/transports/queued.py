"""Base of transports that take less than is sent: frames wait in a bounded queue."""

from gateway.hub.send_queue import Numbering, Outbox
from gateway.hub.transports.base import Client
from gateway.wire.mavlink_splitter import MavlinkSplitter


class QueuedClient(Client):
    """A peer behind a byte stream that may be slow or stalled."""

    _partial = b""
    """What the system has not taken of the frames that left the queue."""

    def __post_init__(self) -> None:
        """Start with nothing that waits."""
        super().__post_init__()
        self._outbox = Outbox(self.queue_bytes)
        self._numbering = Numbering(self.context.is_own, self.context.seal)
        self._splitter = MavlinkSplitter()

    @property
    def queue_bytes(self) -> int:
        """The most that waits."""
        return self.context.settings.queue_bytes

    @property
    def queued(self) -> int:
        """Frames that wait."""
        return len(self._outbox)

    def _push(self, frame: bytes, message_id: int, step: int | None) -> None:
        """Let a frame wait that is counted as sent."""
        self._drop(self._outbox.push(frame, message_id, step, self.context.now_us()))

    def _drop(self, frames: int) -> None:
        self.counters.dropped += frames
        self.counters.sent -= frames

    def _drop_all(self) -> None:
        self._partial = b""
        self._drop(self._outbox.clear())
