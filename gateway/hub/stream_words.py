"""Layout of the memory of a `FrameStream`, in which the compiled step counts frames."""

from typing import Final

ACCEPTED, NEWEST_US, LEADER, LAST, LOST = range(256, 261)
"""Words after the times of the 256 sequence numbers: accepted frames, when the newest was sent, and
the client that brought it; the last sequence number, and the number of those that never came."""
STREAM_WORDS: Final = 261
HALF: Final = 128
"""A sequence number that is further ahead is an older one, of a late or repeated frame."""
