"""The accepted frames of one system and component, counted by Python and by the compiled step."""

from typing import Annotated, Any, Final

from gateway.compiled import compiled, layout_of, shared

HALF: Final = 128
"""A sequence number that is further ahead is an older one, of a late or repeated frame."""
NEIGHBOURS: Final = 8
"""Sequence numbers before and after a frame that show whether it is late."""


@compiled
def count_sequence(stream: Any, sequence: int) -> None:
    """Count an accepted frame of a stream, and those lost before it."""
    ahead = (sequence - stream.last) & 0xFF
    if stream.count == 0:
        stream.last = sequence
    elif 0 < ahead < HALF:
        stream.lost += ahead - 1
        stream.last = sequence
    stream.count += 1


@shared
class FrameStream:
    """The accepted frames of one system and component, from all clients."""

    sent_us: Annotated[Any, 256]
    """When the newest frame of each sequence number was sent, as estimated by the lag of its path;
    0 for none."""
    count: int
    newest_us: int
    """When the newest frame was sent."""
    leader: int
    """The client that brought it."""
    last: int
    """The last sequence number."""
    lost: int
    """Sequence numbers that never came."""

    def accept(self, sequence: int, client_id: int, sent_us: int) -> None:
        """Register a frame that is neither a copy nor late."""
        count_sequence(self, sequence)
        self.sent_us[sequence] = sent_us
        if sent_us >= self.newest_us:
            self.newest_us, self.leader = sent_us, client_id

    def newest_sequence(self) -> int:
        """Return the number of the newest frame; of several at one time, the last of their run."""
        sent_us = self.sent_us[:]
        newest_us = max(sent_us)
        ends = (n for n in range(256) if sent_us[n] == newest_us != sent_us[n + 1 & 0xFF])
        return next(ends, 0)

    def is_behind(self, sequence: int, limit_us: int) -> bool:
        """Return whether the frames after a number were accepted more than a limit ago.

        The number is behind the newest one if a following number was seen later than a preceding
        one; of a number ahead, the following ones were seen one cycle of the counter ago.
        """
        after = self._nearest(sequence, 1)
        return after > self._nearest(sequence, -1) and self.newest_us - after > limit_us

    def _nearest(self, sequence: int, step: int) -> int:
        near = range(sequence + step, sequence + step * (NEIGHBOURS + 1), step)
        return next(filter(None, (int(self.sent_us[number & 0xFF]) for number in near)), 0)


STREAM: Final = layout_of(FrameStream)
