"""Cut MAVLink 1 and 2 frames out of bytes without decoding them.

Theory of operation. A frame starts with 0xFD (version 2) or 0xFE (version 1) and a length byte.
Nothing is escaped, so both values also occur inside frames; only the checksum tells a real start
from a coincidence. At each candidate the splitter decides:

| it sees                                         | it does                                |
| ----------------------------------------------- | -------------------------------------- |
| the frame is not complete yet                   | waits; at a datagram's end, as below   |
| the checksum holds                              | yields the frame's own bytes           |
| an unknown message, then another start or an end | yields it: routers pass the unknown    |
| anything else, or a flag other than "signed"    | drops one byte and seeks the next start |

Dropped bytes in a row come out as one fault. The signature is not checked, only stepped over.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fastcrc.crc16 import mcrf4xx

from gateway.wire.mavlink_messages import CRC_EXTRA, NO_TARGET, TARGET_OFFSETS

START_V1: Final = 0xFE
START_V2: Final = 0xFD
SIGNED: Final = 0x01
"""The only incompatibility flag that is defined."""
OVERHEAD_V1: Final = 8
OVERHEAD_V2: Final = 12
SIGNATURE_SIZE: Final = 13
HEARTBEAT_TYPE_OFFSET: Final = 4
MAV_TYPE_GCS: Final = 6
TXBUF_OFFSET: Final = 6
"""Of RADIO_STATUS, behind its two counters and the two signal strengths."""
MAX_FALSE_STARTS: Final = 256
"""In one chunk; bytes with more are no MAVLink, and each costs a checksum of up to 255 bytes."""

_INCOMPLETE: Final = -1
_NO_FRAME: Final = 0
_STARTS: Final = re.compile(rb"[\xfd\xfe]")


class SplitFaultKind(StrEnum):
    """Why bytes were dropped."""

    GARBAGE = "garbage"
    """They do not begin like a frame."""
    CRC = "crc"
    """They begin like a frame, but the checksum (or the end) is wrong."""


@dataclass(frozen=True, slots=True)
class SplitFault:
    """A run of bytes that belongs to no frame."""

    kind: SplitFaultKind
    size: int


class MavlinkSplitter:
    """Turn chunks of a byte stream (serial, TCP) into frames and faults."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes | SplitFault]:
        """Take the next bytes of the stream.

        Parameters
        ----------
        data : bytes
            Any chunk, from one byte on.

        Returns
        -------
        list of bytes or SplitFault
            Every complete frame, byte for byte, and every run of dropped bytes. Never raises on
            data.
        """
        events, consumed = _split(self._rest + data, final=False)
        self._rest = (self._rest + data)[consumed:]
        return events

    def reset(self) -> None:
        """Forget a half-received frame, as after reopening the port."""
        self._rest = b""


def split_datagram(data: bytes) -> list[bytes | SplitFault]:
    """Cut one datagram into its frames; nothing carries over to the next.

    Parameters
    ----------
    data : bytes
        The whole datagram; empty gives nothing.

    Returns
    -------
    list of bytes or SplitFault
        Frames byte for byte, and runs of dropped bytes, in order.
    """
    return _split(data, final=True)[0]


def is_frame(data: bytes) -> bool:
    """Return whether bytes are exactly one unsigned version 2 frame of a known message.

    Nearly every datagram is one; this is the fast check for it.
    """
    if (
        len(data) < OVERHEAD_V2
        or data[0] != START_V2
        or data[2]
        or len(data) != data[1] + OVERHEAD_V2
    ):
        return False
    extra = CRC_EXTRA.get(data[7] | data[8] << 8 | data[9] << 16)
    if extra is None:
        return False
    crc: int = mcrf4xx(data[1:-2] + extra)
    return crc == data[-2] | data[-1] << 8


def key_of(frame: bytes) -> bytes:
    """Return the header bytes with system, component and message, as a dictionary key."""
    return frame[5:10] if frame[0] == START_V2 else frame[3:6]


def origin_of(frame: bytes) -> tuple[int, int]:
    """Return the system and component that sent a frame."""
    return (frame[5], frame[6]) if frame[0] == START_V2 else (frame[3], frame[4])


def message_id_of(frame: bytes) -> int:
    """Return the message id of a frame."""
    if frame[0] == START_V2:
        return frame[7] | frame[8] << 8 | frame[9] << 16
    return frame[5]


def is_station_heartbeat(frame: bytes) -> bool:
    """Return whether a HEARTBEAT says that its sender is a ground station.

    Version 2 cuts trailing zeros off the payload, so a type beyond its end is 0: generic.
    """
    begin = 10 if frame[0] == START_V2 else 6
    return frame[1] > HEARTBEAT_TYPE_OFFSET and frame[begin + HEARTBEAT_TYPE_OFFSET] == MAV_TYPE_GCS


def free_percent(frame: bytes) -> int:
    """Return how much of its buffer the sender of a RADIO_STATUS has free."""
    begin = 10 if frame[0] == START_V2 else 6
    return frame[begin + TXBUF_OFFSET] if frame[1] > TXBUF_OFFSET else 0


def is_signed(frame: bytes) -> bool:
    """Return whether a frame carries a MAVLink 2 signature."""
    return frame[0] == START_V2 and bool(frame[2] & SIGNED)


def sequence_of(frame: bytes) -> int:
    """Return the sequence number of a frame."""
    return frame[4] if frame[0] == START_V2 else frame[2]


def target_of(frame: bytes) -> tuple[int, int]:
    """Return the system and component that a frame addresses; 0 is everybody.

    Version 2 cuts trailing zeros off the payload, so a target beyond its end is 0.
    """
    offsets = TARGET_OFFSETS.get(message_id_of(frame))
    if offsets is None:
        return 0, 0
    begin = 10 if frame[0] == START_V2 else 6
    length = frame[1]
    system, component = (
        frame[begin + offset] if NO_TARGET < offset < length else 0 for offset in offsets
    )
    return system, component


def restamp(frame: bytes, sequence: int) -> bytes:
    """Return an unsigned frame with this sequence number and the checksum that fits.

    Parameters
    ----------
    frame : bytes
        A complete frame; a signed or an unknown one is returned as it is.
    sequence : int
        0 to 255.

    Returns
    -------
    bytes
        The frame to send instead.
    """
    at = 4 if frame[0] == START_V2 else 2
    if frame[at] == sequence:
        return frame
    extra = CRC_EXTRA.get(message_id_of(frame))
    if extra is None or is_signed(frame):
        return frame
    body = frame[1:at] + bytes((sequence,)) + frame[at + 1 : -2]
    return frame[:1] + body + mcrf4xx(body + extra).to_bytes(2, "little")


def _split(data: bytes, *, final: bool) -> tuple[list[bytes | SplitFault], int]:
    events: list[bytes | SplitFault] = []
    position = good = false_starts = 0
    while position < len(data):
        size = _measure(data, position)
        if size == _INCOMPLETE and not final:
            break
        if size > 0:
            _report(events, data, good, position)
            events.append(data[position : position + size])
            position = good = position + size
            continue
        false_starts += 1
        following = _STARTS.search(data, position + 1)
        position = following.start() if following and false_starts < MAX_FALSE_STARTS else len(data)
    _report(events, data, good, position)
    return events, position


def _report(events: list[bytes | SplitFault], data: bytes, begin: int, end: int) -> None:
    if end > begin:
        started = data[begin] in (START_V1, START_V2)
        kind = SplitFaultKind.CRC if started else SplitFaultKind.GARBAGE
        events.append(SplitFault(kind, end - begin))


def _measure(data: bytes, begin: int) -> int:
    """Return the size of the frame that begins here, or why there is none."""
    available = len(data) - begin
    start = data[begin]
    if start == START_V2:
        if available < 3:
            return _INCOMPLETE
        flags = data[begin + 2]
        if flags & ~SIGNED:
            return _NO_FRAME
        checked = data[begin + 1] + OVERHEAD_V2
        size = checked + SIGNATURE_SIZE * flags
    elif start == START_V1:
        if available < 2:
            return _INCOMPLETE
        size = checked = data[begin + 1] + OVERHEAD_V1
    else:
        return _NO_FRAME
    if available < size:
        return _INCOMPLETE
    return size if _is_genuine(data, begin, checked, size) else _NO_FRAME


def _is_genuine(data: bytes, begin: int, checked: int, size: int) -> bool:
    """Check the checksum, which ends `checked` bytes after the start; the signature follows."""
    if data[begin] == START_V2:
        message_id = data[begin + 7] | data[begin + 8] << 8 | data[begin + 9] << 16
    else:
        message_id = data[begin + 5]
    extra = CRC_EXTRA.get(message_id)
    if extra is None:
        end = begin + size
        return end == len(data) or data[end] in (START_V1, START_V2)
    end = begin + checked
    crc: int = mcrf4xx(data[begin + 1 : end - 2] + extra)
    return crc == data[end - 2] | data[end - 1] << 8
