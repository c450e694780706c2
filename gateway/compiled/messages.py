"""Send many datagrams, or a stretch of a stream, by one system call.

An *outbox* lists the parts to send by address and size, in memory of the caller. Each part is one
datagram. Linux 4.18 and later splits a message of several parts of one size into datagrams
(`UDP_SEGMENT`), which costs a fraction of sending each. The structures are those of 64-bit
machines.
"""

import socket
from typing import Any, Final

import numpy as np

from gateway.compiled import address_of, array_at, compiled
from gateway.compiled.system_calls import send_many, send_one

ROOM: Final = 64
"""Maximum parts of an outbox, and maximum datagrams of a message that the system splits."""
DATAGRAMS: Final = 0
SEGMENTS: Final = 1
STREAM: Final = 2
"""Modes of sending: each part as a datagram, parts of one size as one message, or as a stream."""

PARTS, GROUPS, LAST_SIZE, PARTS_AT, PLAIN_AT, GROUPS_AT, CONTROL_AT, WHOLE_AT = range(8)
"""Words of an outbox: the number of its parts, and of its groups of one size; the last number of
bytes of a stream that were sent; addresses of the parts, of headers for each part and for each
group, of the groups' control data, and of a header of all parts."""
OUTBOX_WORDS: Final = 8
HEADER_WORDS: Final = 8
FIRST_AT, COUNT, CONTROL, CONTROL_SIZE, FLAGS, LENGTH = 2, 3, 4, 5, 6, 7
"""Words of a `struct mmsghdr`: address and number of its parts, address and size of its control
data, flags of what was received; the bytes received or sent."""
CONTROL_WORDS: Final = 4
SEGMENT_SIZE, FIRST = 2, 3
"""Words of control data: the size of the datagrams; the first part of the group, which the system
ignores."""
SOL_UDP: Final = 17
UDP_SEGMENT: Final = 103
_CONTROL_BYTES: Final = 24
_CONTROL_LENGTH: Final = 18
"""Sizes of control data, a header of 16 bytes and a number of two: with and without padding."""
_INT: Final = np.dtype(np.int64)


class Outbox:
    """The memory of an outbox; `words` is passed by address and `parts` is to be filled."""

    def __init__(self) -> None:
        self.parts = np.zeros((ROOM, 2), np.int64)
        control = np.zeros((ROOM, CONTROL_WORDS), np.int64)
        control[:, 0], control[:, 1] = _CONTROL_LENGTH, SOL_UDP | UDP_SEGMENT << 32
        groups, whole = headers_of(self.parts), headers_of(self.parts[:1])
        groups[:, CONTROL] = address_of(control) + np.arange(ROOM) * control.strides[0]
        groups[:, CONTROL_SIZE] = _CONTROL_BYTES
        self._kept = (self.parts, headers_of(self.parts), groups, control, whole)
        self.words = np.zeros(OUTBOX_WORDS, np.int64)
        self.words[PARTS_AT:] = [address_of(each) for each in self._kept]


def headers_of(parts: Any) -> Any:
    """Return a header for each part; the caller must keep the parts alive."""
    headers = np.zeros((len(parts), HEADER_WORDS), np.int64)
    headers[:, FIRST_AT] = address_of(parts) + np.arange(len(parts)) * parts.strides[0]
    headers[:, COUNT] = 1
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
    parts = array_at(outbox[PARTS_AT], (ROOM, 2), _INT)
    headers = array_at(outbox[GROUPS_AT], (ROOM, HEADER_WORDS), _INT)
    control = array_at(outbox[CONTROL_AT], (ROOM, CONTROL_WORDS), _INT)
    first = count = 0
    while first < outbox[PARTS]:
        end = first + 1
        while end < outbox[PARTS] and parts[end, 1] == parts[first, 1]:
            end += 1
        headers[count, FIRST_AT] = outbox[PARTS_AT] + 16 * first
        headers[count, COUNT] = end - first
        control[count, SEGMENT_SIZE], control[count, FIRST] = parts[first, 1], first
        count += 1
        first = end
    outbox[GROUPS] = count


@compiled
def send_parts(outbox: Any, file: int, way: int) -> int:
    """Send all parts, which are grouped; return the number sent, or a negative error number.

    An error after some parts were sent is not reported. In a stream, the next part may have been
    sent up to `LAST_SIZE`.
    """
    if way == STREAM:
        return _send_stream(outbox, file)
    if outbox[PARTS] == 1:
        parts = array_at(outbox[PARTS_AT], (ROOM, 2), _INT)
        return min(send_one(file, parts[0, 0], parts[0, 1]), 1)
    first = 0
    if way == SEGMENTS:
        done = send_many(file, outbox[GROUPS_AT], outbox[GROUPS])
        if done == outbox[GROUPS]:
            return int(outbox[PARTS])
        control = array_at(outbox[CONTROL_AT], (ROOM, CONTROL_WORDS), _INT)
        first = control[max(done, 0), FIRST]
    done = send_many(file, outbox[PLAIN_AT] + 8 * HEADER_WORDS * first, outbox[PARTS] - first)
    return first + max(done, 0) if first else done


@compiled
def _send_stream(outbox: Any, file: int) -> int:
    parts = array_at(outbox[PARTS_AT], (ROOM, 2), _INT)
    header = array_at(outbox[WHOLE_AT], (HEADER_WORDS,), _INT)
    header[COUNT] = outbox[PARTS]
    done = send_many(file, outbox[WHOLE_AT], 1)
    size = header[LENGTH] if done == 1 else 0
    sent = 0
    while sent < outbox[PARTS] and size >= parts[sent, 1]:
        size -= parts[sent, 1]
        sent += 1
    outbox[LAST_SIZE] = size
    return sent
