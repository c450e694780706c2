"""Layout of the memory of a `FrameStream`, in which the compiled step counts frames."""

from typing import Final

ACCEPTED, NEWEST_US, LEADER = range(256, 259)
"""Words after the times of the 256 sequence numbers: accepted frames, when the newest was sent, and
the client that brought it."""
STREAM_WORDS: Final = 259
