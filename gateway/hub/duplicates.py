"""Copies and late frames of systems that are received on several paths.

Two paths to one system, or a link that leads back, bring the same bytes twice. All but the first
are dropped, whichever client brings them, or they would circulate in a loop for ever. A path that
is seconds behind, as a second LTE link may be, also brings frames that the first path has lost; to
show them would move the aircraft back, so those are dropped too.

Theory of operation. Accepted frames are remembered for `MEMORY_US` by a hash of their bytes,
sequence number included; a frame with a known hash is a copy. Two exceptions: a copy of a frame
from before its path existed passes, because it cannot be distinguished from a program that was
restarted and repeats its first frames from another port; and content that repeats, such as a
heartbeat's, has the same bytes again after 256 frames: on a path without delay it is new.

Each copy measures the lag of its path behind the first one. A frame that is not a copy was
sent about one lag before it arrived; if that is more than a limit before the newest frame of
its stream, or if its sequence number belongs before frames that old, it is late. (Sequence
numbers are registered even while there is one path, for when a second one appears.) The path
that brought the newest frame is always accepted, so a restarted system loses nothing.
"""

from collections.abc import Hashable
from typing import Final, Generic, TypeVar

from gateway.hub.frame_stream import FrameStream
from gateway.hub.routing_table import MEMORY_US, REPEAT_US, SystemPath
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame

MEMORY_OF_ONE: Final = 224
"""Frames of a component after which the same bytes may be a new frame: sequence numbers repeat
after 256 frames, lost ones included."""
MEMORY_FRAMES: Final = 32_768
"""Maximum per generation, some 200 bytes each: half a minute at 1000 frames a second, 13 MB."""
NEW: Final = -1
LATE: Final = 0
"""Results of `DuplicateFilter.check`; client ids are positive."""
LINKED_US: Final = 60 * US_PER_S
"""A pair ends after this time without a copy: it was chance, or one of the links has gone."""
Note = TypeVar("Note")


class FrameMemory(Generic[Note]):
    """Notes on recent frames in two generations, each of at most a time and a number of frames."""

    def __init__(self, span_us: int, most: int) -> None:
        self._span_us = span_us
        self._most = most
        self._recent: dict[Hashable, Note] = {}
        self._older: dict[Hashable, Note] = {}
        self._turned_us = 0

    def turn(self, now_us: int) -> None:
        """Start another generation if it is due."""
        if now_us - self._turned_us >= self._span_us or len(self._recent) >= self._most:
            self._older, self._recent = self._recent, {}
            self._turned_us = now_us

    def get(self, frame: Hashable) -> Note | None:
        """Return the note on a frame."""
        return self._recent.get(frame) or self._older.get(frame)

    def put(self, frame: Hashable, note: Note) -> None:
        """Register a frame with its note."""
        self._recent[frame] = note


class DuplicateFilter:
    """Recognise copies and late frames."""

    def __init__(self) -> None:
        self._memory: FrameMemory[tuple[int, int, int, int, bool]] = FrameMemory(
            MEMORY_US, MEMORY_FRAMES
        )
        """Times at which a frame was sent and received, its client, its number in the stream, and
        whether the same bytes were accepted before."""

    def check(
        self, frame: MavFrame, client_id: int, path: SystemPath, now_us: int, limit_us: int
    ) -> int:
        """Return `NEW`, `LATE`, or the id of the client that brought the same bytes first.

        A frame older than the newest of its stream by more than `limit_us` is late.
        """
        self._memory.turn(now_us)
        digest = hash(frame.data)
        known = self._memory.get(digest)
        stream = path.stream
        if known is not None:
            sent_us, received_us, first, count, is_repeated = known
            turned = stream.count - count >= MEMORY_OF_ONE
            if first == client_id:
                is_copy = now_us - received_us <= REPEAT_US and not turned
            else:
                is_prompt = client_id == stream.leader or path.is_prompt(now_us)
                is_copy = not (turned and (is_repeated or is_prompt))
            if is_copy and received_us >= path.since_us:
                if first != client_id:
                    path.lag_us, path.copied_us = max(0, now_us - sent_us), now_us
                return first
        sent_us = now_us - path.lag_us
        if client_id != stream.leader and self._is_late(frame, stream, sent_us, now_us, limit_us):
            return LATE
        stream.accept(frame.sequence, client_id, sent_us)
        self._memory.put(digest, (sent_us, now_us, client_id, stream.count, known is not None))
        return NEW

    @staticmethod
    def _is_late(
        frame: MavFrame, stream: FrameStream, sent_us: int, now_us: int, limit_us: int
    ) -> bool:
        if sent_us < stream.newest_us - limit_us:
            return True
        leader_lives = now_us - stream.newest_us <= limit_us
        return leader_lives and stream.is_behind(frame.sequence, limit_us)


class RedundantLinks:
    """Pairs of clients that are links to one peer, because both brought copies of a frame recently.

    Frames that we forward may return and look the same, so only frames that are not forwarded
    count. Both links of a pair get every answer, and also any stream that only one of them
    requested: then both carry the same sequence numbers, and the peer can recognise copies by their
    bytes too. Two ground stations that share an id and were started at the same moment look like
    such a pair: each gets the answers to the other's requests.
    """

    def __init__(self) -> None:
        self._seen_us: dict[tuple[int, int], int] = {}
        self._groups: dict[int, tuple[int, ...]] = {}

    def register(self, first: int, second: int, now_us: int) -> bool:
        """Register that a client brought a copy of another's frame; return if the pair is new."""
        pair = (first, second) if first < second else (second, first)
        is_new = pair not in self._seen_us
        self._seen_us[pair] = now_us
        if is_new:
            self._regroup()
        return is_new

    def group(self, client_id: int) -> tuple[int, ...]:
        """Return all links to a client's peer, the client included, lowest id first."""
        return self._groups.get(client_id, (client_id,))

    def expire(self, now_us: int) -> None:
        """Separate pairs that no longer bring copies."""
        self._part([pair for pair, us in self._seen_us.items() if now_us - us > LINKED_US])

    def remove(self, client_id: int) -> None:
        """Separate a client from all others."""
        self._part([pair for pair in self._seen_us if client_id in pair])

    def _part(self, pairs: list[tuple[int, int]]) -> None:
        for pair in pairs:
            del self._seen_us[pair]
        if pairs:
            self._regroup()

    def _regroup(self) -> None:
        """Join pairs that share a client."""
        groups: dict[int, set[int]] = {}
        for first, second in self._seen_us:
            joined = groups.get(first, {first}) | groups.get(second, {second})
            for client_id in joined:
                groups[client_id] = joined
        self._groups = {client_id: tuple(sorted(group)) for client_id, group in groups.items()}
