"""The short way for frames that come often and need no judgement.

Telemetry of a vehicle that is heard by one way only goes to the same links again and again. For
each kind of frame the hub keeps one express: the links' own write functions in a row, with nothing
counted on the way but once for all. Whenever anybody comes, goes or changes, all expresses are
given up, and the next frame of each kind is judged anew.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gateway.edges.hub_link import Link


class Express:
    """Who gets one kind of frame from one link.

    Parameters
    ----------
    source : Link
        Where the frames come from.
    message_id : int
        Of the frames.
    links : list of Link
        Those who take each of them.
    tap : callable, optional
        Sees each frame too.
    """

    __slots__ = ("_bytes", "_direct", "_frames", "_message_id", "_others", "_source", "_tap")

    def __init__(
        self,
        source: "Link",
        message_id: int,
        links: list["Link"],
        tap: Callable[[bytes], None] | None,
    ) -> None:
        self._source = source
        self._message_id = message_id
        self._tap = tap
        self._direct = [link for link in links if link.is_direct]
        self._others = [link for link in links if not link.is_direct]
        self._frames = self._bytes = 0

    def send(self, frame: bytes) -> None:
        """Count a frame as received and hand it to every link."""
        self._frames += 1
        self._bytes += len(frame)
        for link in self._direct:
            try:
                link.write(frame)
            except OSError as error:
                link.recover_uncounted(frame, error)
        for link in self._others:
            link.transmit(frame, self._message_id)
        if self._tap is not None:
            self._tap(frame)

    def settle(self) -> int:
        """Add what passed to the links' own counters; return how many frames that were."""
        frames, size = self._frames, self._bytes
        self._frames = self._bytes = 0
        self._source.counters.received += frames
        self._source.counters.bytes_received += size
        for link in self._direct:
            link.counters.sent += frames
            link.counters.bytes_sent += size
        return frames
