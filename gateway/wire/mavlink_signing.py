"""Sequence numbers and signatures of frames, applied where a frame is encoded for a link.

A frame is signed where it is sent, because only there its sequence number and its order are known:
before, it may be renumbered, be overtaken, or be kept for a new client, and a receiver drops a
frame whose signing timestamp is earlier than that of the frame before it.

References
----------
.. [1] https://mavlink.io/en/guide/message_signing.html
"""

import hashlib
from typing import Final, Protocol

from fastcrc.crc16 import mcrf4xx

from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_splitter import (
    SIGNATURE_SIZE,
    SIGNED,
    START_V2,
    MavFrame,
    frame_of,
    renumbered,
)

LINK_ID: Final = bytes(1)
TIMESTAMP_BYTES: Final = 6
HASH_BYTES: Final = 6


class Clock(Protocol):
    """Time for signing timestamps."""

    def timestamp(self, now_us: int) -> int:
        """Return gateway time in units of 10 us since 2015."""


class FrameSigner:
    """Number our own frames, and sign those of systems that have a key, which needs a clock."""

    def __init__(self, clock: Clock | None = None) -> None:
        self.keys: dict[int, bytes] = {}
        """Signing keys of 32 bytes, by system id; set by the stage that owns the vehicles."""
        self._clock = clock
        self._newest = 0
        """Each timestamp is later than the one before."""

    def sequence_and_sign(self, frame: MavFrame, sequence: int, now_us: int) -> MavFrame:
        """Return a frame with this sequence number, signed again if its system has a key.

        A frame of an unknown message is returned as it is; one of version 1 is numbered and never
        signed.
        """
        key = self.keys.get(frame.origin[0]) if self.keys else None
        if key is None or self._clock is None:
            return renumbered(frame, sequence)
        self._newest = max(self._newest + 1, self._clock.timestamp(now_us))
        return frame_of(sign(frame.data, sequence, key, self._newest))


def sign(data: bytes, sequence: int, key: bytes, timestamp: int) -> bytes:
    """Return a frame of MAVLink 2 with this sequence number and a new signature.

    One of version 1 or of an unknown message is returned as it is. The key has 32 bytes; the
    timestamp is in units of 10 us since 2015.
    """
    frame = frame_of(data)
    extra = CRC_EXTRA.get(frame.message_id)
    if extra is None or data[0] != START_V2:
        return data
    end = -2 - SIGNATURE_SIZE * frame.signed
    body = bytes((data[1], SIGNED, data[3], sequence)) + data[5:end]
    crc = mcrf4xx(extra, mcrf4xx(body)).to_bytes(2, "little")
    signed = data[:1] + body + crc + LINK_ID + timestamp.to_bytes(TIMESTAMP_BYTES, "little")
    return signed + signature_hash(key, signed)


def signature_hash(key: bytes, data: bytes) -> bytes:
    """Return the hash that ends a signed frame, of all bytes before it."""
    return hashlib.sha256(key + data).digest()[:HASH_BYTES]
