"""The serial line: zero-delimited COBS frames closed by a CRC-16.

Theory of operation. The receiver sends `COBS(content + crc) 0x00`. COBS removes every zero from
the content, so a zero on the line can only be a frame's end: after any damage the next zero brings
the decoder back into step, and no length field can mislead it. Of a frame beyond the bound, which
ends as one `TOO_LONG` fault, only the number of its bytes is kept.

The first frame after opening a port is usually cut; it comes out as one fault and nothing more.
"""

import binascii
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from cobs import cobs

CRC_START: Final = 0xFFFF
CRC_SIZE: Final = 2
DELIMITER: Final = b"\x00"

MAX_CONTENT: Final = 72
"""Longest content: the receiver's status frame."""
MAX_ENCODED: Final = MAX_CONTENT + CRC_SIZE + 1
"""COBS adds one byte to anything up to 254 bytes."""


class FaultKind(StrEnum):
    """Reasons for which bytes of the line are dropped."""

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
    """Bytes that were dropped, and why."""

    kind: str
    """A `FaultKind` on the receiver's line; decoders of other sources have kinds of their own."""
    size: int
    detail: str = ""
    """For people; empty where the kind is all that is known."""


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
        """The frame that is not complete yet; one byte more than the bound if it is too long."""
        self._skipped = 0
        """Bytes of it that were dropped, because it is too long."""

    def feed(self, data: bytes) -> list[bytes | Fault]:
        """Decode any chunk of the line, and return the contents of the frames that it completes.

        They are without CRC, and in order with every fault. Never raises on data.
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
    """Return the content of one frame if it is whole."""
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
