"""The fast path for frequent frames that always go to the same clients.

Telemetry of a vehicle that is heard by only one path goes to the same clients again and again. For
each kind of frame the hub keeps one express: a list of the clients' write functions, with one
common count. Whenever a client comes, goes or changes, all expresses are discarded, and the next
frame of each kind is routed again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(slots=True)
class ClientCounters:
    """Counters of one client since it appeared."""

    sent: int = 0
    dropped: int = 0
    unheard: int = 0
    """Sent to a port on which nobody listens."""
    bytes_sent: int = 0
    received: int = 0
    bytes_received: int = 0
    bytes_garbage: int = 0


class Outlet(Protocol):
    """What an express needs of a client."""

    @property
    def counters(self) -> ClientCounters:
        """Its counters."""

    @property
    def write(self) -> Callable[[bytes], object]:
        """Sends one frame at once or raises OSError; only of a client that is direct."""

    @property
    def is_direct(self) -> bool:
        """Whether a frame may be passed to `write` directly."""

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Handle a failed `write` whose frame will still be counted as sent."""

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame now or queue it; never block, never raise."""


class Express:
    """The clients that get one kind of frame from one client.

    Parameters
    ----------
    source : Outlet
        Where the frames come from.
    message_id : int
        Of the frames.
    clients : sequence of Outlet
        The clients that take each of them.
    tap : callable, optional
        Sees each frame too.
    """

    __slots__ = ("_bytes", "_direct", "_frames", "_message_id", "_others", "_source", "_tap")

    def __init__(
        self,
        source: Outlet,
        message_id: int,
        clients: Sequence[Outlet],
        tap: Callable[[bytes], None] | None,
    ) -> None:
        self._source = source
        self._message_id = message_id
        self._tap = tap
        self._direct = [client for client in clients if client.is_direct]
        self._others = [client for client in clients if not client.is_direct]
        self._frames = self._bytes = 0

    def send(self, frame: bytes) -> None:
        """Count a frame as received and hand it to every client."""
        self._frames += 1
        self._bytes += len(frame)
        for client in self._direct:
            try:
                client.write(frame)
            except OSError as error:
                client.recover_uncounted(frame, error)
        for client in self._others:
            client.transmit(frame, self._message_id)
        if self._tap is not None:
            self._tap(frame)

    def settle(self) -> tuple[int, int]:
        """Add the common count to the clients' counters; return how many frames and bytes."""
        frames, size = self._frames, self._bytes
        self._frames = self._bytes = 0
        self._source.counters.received += frames
        self._source.counters.bytes_received += size
        for client in self._direct:
            client.counters.sent += frames
            client.counters.bytes_sent += size
        return frames, size


class GuardedExpress(Express):
    """An express for a system that is heard by several paths: copies are dropped here.

    Parameters
    ----------
    source, message_id, clients, tap
        As of an express.
    is_copy : callable
        Notes a frame and returns whether it has come before.
    """

    __slots__ = ("_is_copy",)

    def __init__(
        self,
        source: Outlet,
        message_id: int,
        clients: Sequence[Outlet],
        tap: Callable[[bytes], None] | None,
        is_copy: Callable[[bytes], bool],
    ) -> None:
        super().__init__(source, message_id, clients, tap)
        self._is_copy = is_copy

    def send(self, frame: bytes) -> None:
        """Count a frame as received; hand it to every client unless it is a copy."""
        if self._is_copy(frame):
            self._source.counters.received += 1
            self._source.counters.bytes_received += len(frame)
        else:
            super().send(frame)
