"""The serial line: zero-delimited COBS frames closed by a CRC-16.

Theory of operation. The receiver sends `COBS(content + crc) 0x00`. COBS removes every zero from
the content, so a zero on the line can only be a frame's end: after any damage the decoder is
synchronised again at the next zero, and no length field can mislead it. A frame beyond the maximum
length is not stored but only counted; it gives one `TOO_LONG` fault.

The first frame after opening a port is usually incomplete, which gives one fault.
"""

import binascii
from dataclasses import dataclass
from enum import StrEnum
from functools import reduce
from operator import xor
from typing import Final

from cobs import cobs

CRC_START: Final = 0xFFFF
CRC_SIZE: Final = 2
DELIMITER: Final = b"\x00"

MAX_CONTENT: Final = 72
"""Longest content, bytes: that of the receiver's status frame."""
MAX_ENCODED: Final = MAX_CONTENT + CRC_SIZE + 1
"""Longest encoded frame: COBS adds one byte to up to 254 bytes."""


class FaultKind(StrEnum):
    """Reasons for which bytes of the line are dropped."""

    GARBAGE = "garbage"
    """The bytes do not begin like a frame."""
    COBS = "cobs"
    CRC = "crc"
    TOO_LONG = "too_long"
    TOO_SHORT = "too_short"
    VERSION = "version"
    KIND = "kind"
    PAYLOAD = "payload"
    VALUE = "value"


@dataclass(frozen=True, slots=True)
class Fault:
    """Bytes that were dropped, with the reason."""

    kind: str
    """A `FaultKind` on the receiver's line; decoders of other sources have other kinds."""
    size: int
    detail: str = ""
    """Text for users; empty if only the kind is known."""


def xor_of(data: bytes) -> int:
    """Return the exclusive or of all bytes: the checksum of NMEA 0183 and LTM."""
    return reduce(xor, data, 0)


def crc16(content: bytes) -> int:
    """Compute CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, no reflection.

    avr-libc's `_crc_xmodem_update`, started with 0xFFFF, gives the same value.
    """
    return binascii.crc_hqx(content, CRC_START)


def encode_frame(content: bytes) -> bytes:
    """Build one frame: COBS-encoded content and CRC (little-endian), then a zero.

    Raises ValueError if the content is too long for a receiver to accept.
    """
    if len(content) > MAX_CONTENT:
        raise ValueError(f"content of {len(content)} bytes; at most {MAX_CONTENT} fit a frame")
    stuffed: bytes = cobs.encode(content + crc16(content).to_bytes(CRC_SIZE, "little"))
    return stuffed + DELIMITER


class FrameDecoder:
    """Turn any chunks of bytes into the checked contents of frames, and faults."""

    def __init__(self) -> None:
        self._partial = b""
        """The incomplete frame; one byte more than the maximum length if it is too long."""
        self._skipped = 0
        """Number of its bytes that were dropped because it is too long."""

    def feed(self, data: bytes) -> list[bytes | Fault]:
        """Decode any chunk of the line, and return the contents of the frames that it completes.

        They have no CRC, and faults are in order between them. Never raises on data.
        """
        pieces = (self._partial + data).split(DELIMITER)
        rest = self._partial = pieces.pop()
        events: list[bytes | Fault] = []
        for piece in pieces:
            if len(piece) > MAX_ENCODED:
                events.append(Fault(FaultKind.TOO_LONG, len(piece) + self._skipped))
                self._skipped = 0
            elif piece:
                events.append(_open(piece))
        if len(rest) > MAX_ENCODED:
            self._skipped += len(rest) - MAX_ENCODED - 1
            self._partial = rest[: MAX_ENCODED + 1]
        return events

    def reset(self) -> None:
        """Discard a half-received frame, as after reopening the port."""
        self._partial = b""
        self._skipped = 0


def _open(stuffed: bytes) -> bytes | Fault:
    """Return the content of one frame, or its fault."""
    try:
        checked: bytes = cobs.decode(stuffed)
    except cobs.DecodeError:
        return Fault(FaultKind.COBS, len(stuffed))
    if len(checked) <= CRC_SIZE:
        return Fault(FaultKind.TOO_SHORT, len(stuffed))
    content = checked[:-CRC_SIZE]
    if binascii.crc_hqx(content, CRC_START) != checked[-2] | checked[-1] << 8:
        return Fault(FaultKind.CRC, len(stuffed))
    return content
