"""The newest signing time stamp of every stream, kept over restarts and passphrase changes.

Without it a recorded command could be replayed after a restart of the gateway. The stored stamps
are ahead of the received ones by `RESERVE_TICKS`, so that a busy stream is written only every few
seconds: after a crash a stream is accepted again once its stamps have passed the reserve, a few
seconds after the restart.
"""

import hashlib
from collections.abc import Mapping
from typing import Final

TICKS_PER_S: Final = 100_000
RESERVE_TICKS: Final = 5 * TICKS_PER_S
MAX_KEYS: Final = 16
MAX_STREAMS: Final = 256
"""Only holders of the key make streams, so this is never reached by strangers."""

Stream = tuple[int, int, int]
"""Link, system, component."""
Stamps = dict[str, dict[str, int]]
"""By the mark of the key, then by the stream as `link.system.component`."""


def mark_of(key: bytes) -> str:
    """Return an identifier of a key that does not reveal it."""
    return hashlib.sha256(b"mavgate key" + key).hexdigest()[:16]


class StampBook:
    """The time stamps that one vehicle has accepted.

    Parameters
    ----------
    kept : mapping, optional
        What `to_keep` returned in an earlier run.
    """

    def __init__(self, kept: Mapping[str, Mapping[str, int]] | None = None) -> None:
        self._newest = {
            mark: {_stream(text): stamp for text, stamp in streams.items()}
            for mark, streams in (kept or {}).items()
        }
        self._kept = {mark: dict(streams) for mark, streams in self._newest.items()}
        self.is_due = False
        """Whether `to_keep` has something that must be written."""

    def newest(self, mark: str, stream: Stream) -> int | None:
        """Return the newest stamp of a stream under a key; None if it was never heard."""
        return self._newest.get(mark, {}).get(stream)

    def has_room(self, mark: str) -> bool:
        """Return whether one more stream can be followed under a key."""
        return len(self._newest.get(mark, {})) < MAX_STREAMS

    def note(self, mark: str, stream: Stream, stamp: int) -> None:
        """Note an accepted stamp."""
        streams = self._newest.pop(mark, {})
        # The key that was used last comes last.
        self._newest[mark] = streams
        streams[stream] = stamp
        for forgotten in list(self._newest)[:-MAX_KEYS]:
            del self._newest[forgotten]
            self._kept.pop(forgotten, None)
        if stamp > self._kept.get(mark, {}).get(stream, -1):
            self._kept.setdefault(mark, {})[stream] = stamp + RESERVE_TICKS
            self.is_due = True

    def to_keep(self) -> Stamps:
        """Return what to write now, so that no frame accepted so far is accepted again."""
        self.is_due = False
        return _texts(self._kept)

    def exact(self) -> Stamps:
        """Return the stamps without the reserve, for a clean shutdown."""
        return _texts(self._newest)


def _texts(found: Mapping[str, Mapping[Stream, int]]) -> Stamps:
    return {
        mark: {".".join(map(str, stream)): stamp for stream, stamp in streams.items()}
        for mark, streams in found.items()
    }


def _stream(text: str) -> Stream:
    link, system, component = (int(part) for part in text.split("."))
    return link, system, component
