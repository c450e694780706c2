"""Split bytes into MAVLink 1 and 2 frames without decoding them.

Theory of operation. A frame starts with 0xFD (version 2) or 0xFE (version 1) and a length byte.
There is no escaping, so both values also occur inside frames; only the checksum distinguishes a
real start from a coincidence. At each candidate:

| condition                                       | action                                 |
| ----------------------------------------------- | -------------------------------------- |
| the frame is not complete yet                   | waits; for datagrams see below         |
| the checksum is correct                         | returns the unchanged bytes            |
| an unknown message, then another start or an end | returns it, for routers to forward     |
| otherwise, or a flag other than "signed"        | drops a byte and seeks the next start  |

A serial bridge may cut frames anywhere between its datagrams. `DatagramSplitter` keeps the first
bytes of an unfinished frame, but continues to search after them: a frame that is found there is
returned at once and shows that those bytes were not a frame.

Dropped bytes in a row are reported as one fault: of the checksum (or the end) if they begin like a
frame, else of garbage. The signature is skipped, not checked. Each frame
is returned as a `MavFrame`, whose header is read once; routing and transports use its fields.
"""

import re
import struct
from collections.abc import Hashable
from typing import Final

from fastcrc.crc16 import mcrf4xx

from gateway.records import EVERYBODY
from gateway.records import PAYLOAD_V1 as PAYLOAD_V1
from gateway.records import PAYLOAD_V2 as PAYLOAD_V2
from gateway.records import START_V2 as START_V2
from gateway.records import MavFrame as MavFrame
from gateway.units import US_PER_S
from gateway.wire.framing import Fault, FaultKind
from gateway.wire.mavlink_messages import CRC_EXTRA, NO_TARGET, TARGET_OFFSETS, base_size

START_V1: Final = 0xFE
SIGNED: Final = 0x01
"""The only incompatibility flag that is defined."""
OVERHEAD_V1: Final = 8
OVERHEAD_V2: Final = 12
SEQUENCE_V1: Final = 2
SEQUENCE_V2: Final = 4
KEY_SIZE_V2: Final = 5
"""Size of `MavFrame.key` of a frame of version 2."""
SIGNATURE_SIZE: Final = 13
MAX_FALSE_STARTS: Final = 256
"""Maximum false starts in one chunk, each of which costs a checksum of up to 255 bytes; data with
more is not MAVLink."""
KEPT_US: Final = US_PER_S
"""Timeout of an unfinished frame between two datagrams: 280 bytes at 2800 Bd, and the delay of a
radio link."""
KEPT_PEERS: Final = 64
"""Maximum peers of one socket with unfinished frames; beyond, the oldest frame is dropped."""

_HEAD_V2: Final = struct.Struct("<BBBBBBBHB").unpack_from
"""Start, length, two bytes of flags, sequence, system, component, message id in three bytes."""
_INCOMPLETE: Final = -1
_NO_FRAME: Final = 0
_STARTS: Final = re.compile(rb"[\xfd\xfe]")


Event = MavFrame | Fault


class MavlinkSplitter:
    """Turn chunks of a byte stream (serial, TCP) into frames and faults."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Event]:
        """Process any chunk of the stream; return the frames and runs of dropped bytes that end.

        Frames are unchanged. Never raises on data.
        """
        data = self._rest + data
        events, unfinished = _split(data)
        self._rest = data[unfinished:]
        return events

    def take(self) -> bytes:
        """Return the bytes of an unfinished frame, and discard them."""
        rest, self._rest = self._rest, b""
        return rest

    def reset(self) -> None:
        """Discard a half-received frame, as after reopening the port."""
        self._rest = b""


class DatagramSplitter:
    """Turn the datagrams of some peers into frames and faults; a frame may span datagrams."""

    def __init__(self) -> None:
        self._rests: dict[Hashable, tuple[bytes, int]] = {}
        """The first bytes of an unfinished frame of a peer, and when they were received."""

    def __bool__(self) -> bool:
        """Return whether an unfinished frame is kept."""
        return bool(self._rests)

    def feed(self, data: bytes, now_us: int, peer: Hashable = None) -> list[Event]:
        """Process a peer's next datagram; return the frames and runs of dropped bytes that end."""
        rest, since_us = self._rests.pop(peer, (b"", now_us))
        late: list[Event] = []
        if now_us - since_us > KEPT_US:
            late, rest = [Fault(FaultKind.CRC, len(rest))], b""
        data = rest + data
        events, unfinished = _split(data, seeks_on=True)
        if unfinished < len(data):
            if len(self._rests) >= KEPT_PEERS:
                del self._rests[next(iter(self._rests))]
            self._rests[peer] = data[unfinished:], now_us
        return late + events

    def split_off(self, peer: Hashable) -> "DatagramSplitter":
        """Return another splitter that continues with the datagrams of one peer."""
        other = DatagramSplitter()
        if peer in self._rests:
            other._rests[None] = self._rests.pop(peer)
        return other


def split_datagram(data: bytes) -> list[Event]:
    """Split one datagram into frames and runs of dropped bytes, without state."""
    return _split(data, seeks_on=True, keeps=False)[0]


def read_datagram(data: bytes) -> MavFrame | None:
    """Return a datagram that is exactly one unsigned version 2 frame of a known message.

    Nearly every datagram is one; for any other the result is None, and `split_datagram` is needed.
    """
    if len(data) < OVERHEAD_V2:
        return None
    extra = CRC_EXTRA.get(data[7] | data[8] << 8 | data[9] << 16)
    is_whole = (
        extra is not None
        and data[0] == START_V2
        and data[1] + OVERHEAD_V2 == len(data)
        and not data[2]
        and mcrf4xx(data[1:-2] + extra) == data[-2] | data[-1] << 8
    )
    return frame_of(data) if is_whole else None


def frame_of(data: bytes) -> MavFrame:
    """Read the header of one complete frame of any version; its checksum is not checked."""
    if data[0] == START_V2:
        _, _, flags, _, sequence, system, component, low, high = _HEAD_V2(data)
        message_id = low | high << 16
        target = _target(message_id, data, PAYLOAD_V2)
        signed = bool(flags & SIGNED)
        return MavFrame(data, data[5:10], message_id, (system, component), target, sequence, signed)
    target = _target(data[5], data, PAYLOAD_V1)
    return MavFrame(data, data[3:6], data[5], (data[3], data[4]), target, data[2], False)


def _target(message_id: int, data: bytes, begin: int) -> tuple[int, int]:
    """Return the addressed system and component, 0 where version 2 has truncated zeros."""
    offsets = TARGET_OFFSETS.get(message_id)
    if offsets is None:
        return EVERYBODY
    length = data[1]
    system, component = (
        data[begin + offset] if NO_TARGET < offset < length else 0 for offset in offsets
    )
    return system, component


def origin_of(data: bytes) -> tuple[int, int]:
    """Return the system and component that sent a frame."""
    return (data[5], data[6]) if data[0] == START_V2 else (data[3], data[4])


def message_id_of(data: bytes, begin: int = 0) -> int:
    """Return the message id of a frame."""
    if data[begin] == START_V2:
        return data[begin + 7] | data[begin + 8] << 8 | data[begin + 9] << 16
    return data[begin + 5]


def to_mavlink1(frame: bytes) -> bytes | None:
    """Encode a frame of either version as MAVLink 1, without extension fields and signature [1]_.

    Returns None if MAVLink 1 cannot carry the message, or its definition is unknown.

    References
    ----------
    .. [1] https://mavlink.io/en/guide/serialization.html
    """
    if frame[0] != START_V2:
        return frame
    message_id = message_id_of(frame)
    size = base_size(message_id)
    if size is None:
        return None
    length = min(frame[1], len(frame) - OVERHEAD_V2)
    payload = frame[PAYLOAD_V2 : PAYLOAD_V2 + min(length, size)].ljust(size, b"\0")
    content = bytes((size, frame[4], frame[5], frame[6], message_id)) + payload
    crc = mcrf4xx(content + CRC_EXTRA[message_id])
    return bytes((START_V1,)) + content + crc.to_bytes(2, "little")


def _split(data: bytes, *, seeks_on: bool = False, keeps: bool = True) -> tuple[list[Event], int]:
    """Return frames and faults, and the begin of an unfinished frame, or the end of the data.

    With `seeks_on`, the bytes after an unfinished frame are searched for frames too. It is a fault
    unless the caller keeps it.
    """
    events: list[Event] = []
    position = end = false_starts = 0
    unfinished = len(data)
    while position < len(data):
        size = _measure(data, position, takes_unknown=unfinished == len(data))
        if size == _INCOMPLETE:
            unfinished = min(unfinished, position)
            if not seeks_on:
                break
        if size > 0:
            _report(events, data, end, position)
            events.append(frame_of(data[position : position + size]))
            position = end = position + size
            unfinished = len(data)
            continue
        false_starts += 1
        following = _STARTS.search(data, position + 1)
        position = following.start() if following and false_starts < MAX_FALSE_STARTS else len(data)
    _report(events, data, end, unfinished if keeps else len(data))
    return events, unfinished


def _report(events: list[Event], data: bytes, begin: int, end: int) -> None:
    if end > begin:
        started = data[begin] in (START_V1, START_V2)
        events.append(Fault(FaultKind.CRC if started else FaultKind.GARBAGE, end - begin))


def _measure(data: bytes, begin: int, *, takes_unknown: bool) -> int:
    """Return the size of the frame that begins here, or the reason why there is none."""
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
    return size if _is_genuine(data, begin, checked, size, takes_unknown) else _NO_FRAME


def _is_genuine(data: bytes, begin: int, checked: int, size: int, takes_unknown: bool) -> bool:
    """Check the checksum, which ends `checked` bytes after the start; the signature follows."""
    extra = CRC_EXTRA.get(message_id_of(data, begin))
    if extra is None:
        end = begin + size
        return takes_unknown and (end == len(data) or data[end] in (START_V1, START_V2))
    end = begin + checked
    crc: int = mcrf4xx(data[begin + 1 : end - 2] + extra)
    return crc == data[end - 2] | data[end - 1] << 8
