"""Texts in MAVLink: UTF-8, and texts joined from several STATUSTEXT."""

import re
from dataclasses import dataclass, field
from typing import Final

from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.mavlink_splitter import origin_of
from gateway.wire.recorded_frames import payload_of

STATUSTEXT_ID: Final = MESSAGE_IDS["STATUSTEXT"]
TEXT_BYTES: Final = 50
"""Bytes of a chunk; a shorter chunk is the last one of a text."""
_SIZE: Final = 54
"""Bytes of the payload: severity, text, id (two bytes), number of the chunk."""
TIMEOUT_US: Final = 3 * US_PER_S
"""Timeout after which the next chunk is considered lost."""
MAX_OPEN: Final = 100
"""Maximum number of incomplete texts, so that a flood of them cannot fill the memory."""
ELLIPSIS: Final = "\N{HORIZONTAL ELLIPSIS}"
_CUT: Final = re.compile(f"\N{REPLACEMENT CHARACTER}*{ELLIPSIS}\N{REPLACEMENT CHARACTER}*")


def text_of(data: bytes) -> str:
    """Decode a character field as UTF-8, up to its first zero."""
    return data.split(b"\0", 1)[0].decode("utf-8", "replace")


@dataclass(frozen=True, slots=True)
class JoinedText:
    """A text as its sender wrote it; an ellipsis replaces lost chunks."""

    time_us: int
    """When its first chunk arrived."""
    origin: int
    """Sender: system << 8 | component."""
    severity: int
    """MAV_SEVERITY: 0 emergency to 7 debug."""
    text: str


@dataclass(slots=True)
class _OpenText:
    time_us: int
    newest_us: int
    severity: int
    chunks: dict[int, bytes] = field(default_factory=dict)
    is_done: bool = False
    """Whether the text was returned; copies of its chunks by another link are ignored."""

    @property
    def is_whole(self) -> bool:
        """Whether all chunks up to the last have arrived."""
        last = max(self.chunks)
        return len(self.chunks) == last + 1 and len(self.chunks[last]) < TEXT_BYTES

    def text(self) -> str:
        joined, expected = "", 0
        data = b""
        for number, chunk in sorted(self.chunks.items()):
            if number != expected:
                joined, data = joined + data.decode(errors="replace") + ELLIPSIS, b""
            data, expected = data + chunk, number + 1
        # A single full chunk may be a complete text of this length, which does not end in a blank.
        if len(chunk) == TEXT_BYTES and (expected > 1 or chunk.endswith(b" ")):
            return _CUT.sub(ELLIPSIS, joined + data.decode(errors="replace").rstrip() + ELLIPSIS)
        return _CUT.sub(ELLIPSIS, joined + data.decode(errors="replace"))


class TextJoiner:
    """Join the chunks of the texts of all senders."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], _OpenText] = {}
        """Incomplete texts by sender and id."""

    def feed(self, frame: bytes, time_us: int) -> list[JoinedText]:
        """Process a STATUSTEXT, and return the texts that are complete now, or timed out."""
        found = self.poll(time_us)
        payload = payload_of(frame, _SIZE)
        text = payload[1 : 1 + TEXT_BYTES].split(b"\0", 1)[0]
        number, chunk = int.from_bytes(payload[51:53], "little"), payload[53]
        system, component = origin_of(frame)
        origin = system << 8 | component
        if not number:
            return [*found, JoinedText(time_us, origin, payload[0], text_of(text))]
        key = (origin, number)
        joined = self._open.get(key)
        if joined is not None and joined.chunks.get(chunk, text) != text:
            # The sender has reused the id.
            found += self._end(key)
            joined = None
        if joined is None:
            joined = self._open[key] = _OpenText(time_us, time_us, payload[0])
        joined.chunks[chunk], joined.newest_us = text, time_us
        if not joined.is_done and joined.is_whole:
            joined.is_done = True
            found.append(JoinedText(joined.time_us, origin, joined.severity, joined.text()))
        if len(self._open) > MAX_OPEN:
            found += self._end(next(iter(self._open)))
        return found

    def poll(self, time_us: int) -> list[JoinedText]:
        """Return the texts whose next chunk has timed out."""
        if not self._open:
            return []
        late = [k for k, one in self._open.items() if not 0 <= time_us - one.newest_us < TIMEOUT_US]
        return [text for key in late for text in self._end(key)]

    def flush(self) -> list[JoinedText]:
        """Return all incomplete texts."""
        return [text for key in list(self._open) for text in self._end(key)]

    def _end(self, key: tuple[int, int]) -> list[JoinedText]:
        ended = self._open.pop(key)
        if ended.is_done:
            return []
        return [JoinedText(ended.time_us, key[0], ended.severity, ended.text())]
