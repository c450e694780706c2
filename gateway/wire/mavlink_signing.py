"""Signatures of the frames that leave.

A frame is signed where it leaves, because only there its sequence number and its order are known:
on the way it may be renumbered, be overtaken, or be kept for a newcomer, and a receiver drops a
frame whose time stamp is earlier than that of the frame before it.

References
----------
.. [1] https://mavlink.io/en/guide/message_signing.html
"""

import hashlib
from collections.abc import Callable
from typing import Final

from fastcrc.crc16 import mcrf4xx

from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_splitter import SIGNATURE_SIZE, SIGNED, START_V2, is_signed, message_id_of

LINK_ID: Final = bytes(1)
STAMP_BYTES: Final = 6
HASH_BYTES: Final = 6

Seal = Callable[[bytes, int], bytes]
"""Gives a frame of ours its sequence number as it leaves, and a signature if its vehicle signs;
`restamp` is one for vehicles that do not."""


class Signer:
    """Number and sign frames; each time stamp is later than the one before."""

    def __init__(self) -> None:
        self._stamp = 0

    def sign(self, frame: bytes, sequence: int, key: bytes, stamp: int) -> bytes:
        """Return a frame with this sequence number and a new signature.

        Parameters
        ----------
        frame : bytes
            A complete frame of MAVLink 2, signed or not. One of version 1 or of an unknown
            message is returned as it is.
        sequence : int
            0 to 255.
        key : bytes
            32 bytes.
        stamp : int
            Time of this moment in units of 10 us since 2015.

        Returns
        -------
        bytes
            The frame to send instead.
        """
        extra = CRC_EXTRA.get(message_id_of(frame))
        if extra is None or frame[0] != START_V2:
            return frame
        self._stamp = max(self._stamp + 1, stamp)
        end = -2 - SIGNATURE_SIZE * is_signed(frame)
        body = bytes((frame[1], SIGNED, frame[3], sequence)) + frame[5:end]
        crc = mcrf4xx(extra, mcrf4xx(body)).to_bytes(2, "little")
        signed = frame[:1] + body + crc + LINK_ID + self._stamp.to_bytes(STAMP_BYTES, "little")
        return signed + hashlib.sha256(key + signed).digest()[:HASH_BYTES]
