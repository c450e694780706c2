"""Send many datagrams, or a stretch of a stream, by one system call.

An *outbox* lists the parts to send by address and size, in memory of the caller. Each part is one
datagram. Linux 4.18 and later splits a message of several parts of one size into datagrams
(`UDP_SEGMENT`), which costs a fraction of sending each. The structures are those of 64-bit
machines.
"""

import socket
from typing import Any, Final

import numpy as np

from gateway.compiled import address_of, array_at, compiled, layout_of, record_at, shared
from gateway.compiled.system_calls import send_many, send_one

ROOM: Final = 64
"""Maximum parts of an outbox, and maximum datagrams of a message that the system splits."""
DATAGRAMS: Final = 0
SEGMENTS: Final = 1
STREAM: Final = 2
"""Modes of sending: each part as a datagram, parts of one size as one message, or as a stream."""
SOL_UDP: Final = 17
UDP_SEGMENT: Final = 103
_CONTROL_BYTES: Final = 24
_CONTROL_LENGTH: Final = 18
"""Sizes of control data, a header of 16 bytes and a number of two: with and without padding."""


@shared
class MessagePart:
    """A `struct iovec`."""

    at: int
    length: int


@shared
class MessageHeader:
    """A `struct mmsghdr`."""

    name_at: int
    name_size: int
    parts_at: int
    parts: int
    control_at: int
    control_size: int
    received_flags: int
    length: int
    """Bytes that were received or sent."""


@shared
class Control:
    """A `struct cmsghdr` and its data."""

    length: int
    level_and_type: int
    segment_size: int
    """Size of the datagrams."""
    first: int
    """First part of the group, which the system ignores."""


@shared
class OutboxState:
    """Parts to send, and the structures that the system calls need for them."""

    parts: int
    groups: int
    """Groups of successive parts of one size."""
    last_size: int
    """Bytes of a stream that were sent last."""
    parts_at: int
    plain_at: int
    """Address of a header for each part."""
    groups_at: int
    """Address of a header for each group."""
    control_at: int
    whole_at: int
    """Address of a header of all parts."""


PART: Final = layout_of(MessagePart)
HEADER: Final = layout_of(MessageHeader)
CONTROL: Final = layout_of(Control)
OUTBOX: Final = layout_of(OutboxState)
HEADER_SIZE: Final = HEADER.itemsize
PART_SIZE: Final = PART.itemsize


class Outbox:
    """The memory of an outbox."""

    def __init__(self) -> None:
        self.parts = np.zeros(ROOM, PART)
        control = np.zeros(ROOM, CONTROL)
        control["length"], control["level_and_type"] = _CONTROL_LENGTH, SOL_UDP | UDP_SEGMENT << 32
        groups, whole = headers_of(self.parts), headers_of(self.parts[:1])
        groups["control_at"] = address_of(control) + np.arange(ROOM) * CONTROL.itemsize
        groups["control_size"] = _CONTROL_BYTES
        self._kept = (self.parts, headers_of(self.parts), groups, control, whole)
        self.state: Any = OutboxState(0, 0, 0, *map(address_of, self._kept))  # type: ignore[call-arg]


def headers_of(parts: Any) -> Any:
    """Return a header for each part; the caller must keep the parts alive."""
    headers = np.zeros(len(parts), HEADER)
    headers["parts_at"] = address_of(parts) + np.arange(len(parts)) * PART.itemsize
    headers["parts"] = 1
    return headers


def way_to_send(sock: socket.socket) -> int:
    """Return `SEGMENTS` if the system splits messages of a datagram socket, else `DATAGRAMS`."""
    try:
        is_known = sock.getsockopt(SOL_UDP, UDP_SEGMENT) == 0
    except OSError:
        return DATAGRAMS
    return SEGMENTS if is_known and sock.family != socket.AF_UNIX else DATAGRAMS


@compiled
def group(outbox: Any) -> None:
    """Join successive parts of one size into groups."""
    parts = array_at(outbox.parts_at, (ROOM,), PART)
    headers = array_at(outbox.groups_at, (ROOM,), HEADER)
    control = array_at(outbox.control_at, (ROOM,), CONTROL)
    first = count = 0
    while first < outbox.parts:
        end = first + 1
        while end < outbox.parts and parts[end].length == parts[first].length:
            end += 1
        headers[count].parts_at = outbox.parts_at + PART_SIZE * first
        headers[count].parts = end - first
        control[count].segment_size, control[count].first = parts[first].length, first
        count += 1
        first = end
    outbox.groups = count


@compiled
def send_parts(outbox: Any, file: int, way: int) -> int:
    """Send all parts, which are grouped; return the number sent, or a negative error number.

    An error after some parts were sent is not reported. In a stream, the next part may have been
    sent up to `last_size`.
    """
    if way == STREAM:
        return _send_stream(outbox, file)
    if outbox.parts == 1:
        part = record_at(outbox.parts_at, PART)
        return min(send_one(file, part.at, part.length), 1)
    first = 0
    if way == SEGMENTS:
        done = send_many(file, outbox.groups_at, outbox.groups)
        if done == outbox.groups:
            return int(outbox.parts)
        first = array_at(outbox.control_at, (ROOM,), CONTROL)[max(done, 0)].first
    done = send_many(file, outbox.plain_at + HEADER_SIZE * first, outbox.parts - first)
    return first + max(done, 0) if first else done


@compiled
def _send_stream(outbox: Any, file: int) -> int:
    parts = array_at(outbox.parts_at, (ROOM,), PART)
    header = record_at(outbox.whole_at, HEADER)
    header.parts = outbox.parts
    size = header.length if send_many(file, outbox.whole_at, 1) == 1 else 0
    sent = 0
    while sent < outbox.parts and size >= parts[sent].length:
        size -= parts[sent].length
        sent += 1
    outbox.last_size = size
    return sent
