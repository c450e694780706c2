"""Frames gathered into datagrams."""

from collections.abc import Callable


class Packer:
    """Gather frames into datagrams of at most `max_bytes`; a single longer frame goes alone.

    `send` is called with the frames of a datagram when it is full, and when `flush` is called.
    `flush_soon` gets `flush` with the first frame of each datagram, to call it later.
    """

    def __init__(
        self,
        max_bytes: int,
        send: Callable[[list[bytes]], None],
        flush_soon: Callable[[Callable[[], None]], None],
    ) -> None:
        self._max_bytes = max_bytes
        self._send = send
        self._flush_soon = flush_soon
        self._frames: list[bytes] = []
        self._size = 0
        self._is_flush_due = False

    def add(self, frame: bytes) -> None:
        """Add a frame."""
        if self._size + len(frame) > self._max_bytes:
            self._send_frames()
        self._frames.append(frame)
        self._size += len(frame)
        if not self._is_flush_due:
            self._is_flush_due = True
            self._flush_soon(self.flush)

    def flush(self) -> None:
        """Send the gathered frames."""
        self._is_flush_due = False
        self._send_frames()

    def _send_frames(self) -> None:
        frames, self._frames = self._frames, []
        self._size = 0
        if frames:
            self._send(frames)
