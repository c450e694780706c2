"""One compiled step that forwards the frames of a read: check, look up, send.

Theory of operation. The step receives datagrams into a buffer (or uses a chunk of a stream in it),
processes the frames in order, and gathers those with a known route into a run. A run ends where the
next frame goes to other clients; it is sent to each of its clients by one system call. The step
ends at the first bytes that need Python: Python handles them, advances, and calls the step again,
so that all frames stay in order. These bytes are:

| bytes                                                               | status      |
| ------------------------------------------------------------------- | ----------- |
| not a MAVLink 2 frame with a route in the table and a good checksum | `HAND_OVER` |
| a run that is observed, has other clients, or was not sent to all   | `RUN_SENT`  |
| an error of the socket                                              | `ERROR`     |
| datagrams after one of these, or beyond the byte limit of a read    | `UNREAD`    |

Counters are kept where they are needed: of the source, of its system, of the targets, and of the
route. All memory belongs to `forwarding.Forwarding`.
"""

import errno
from typing import Any, Final

import numpy as np

from gateway.compiled import array_at, compiled
from gateway.compiled.entry_point import EntryPoint
from gateway.compiled.messages import (
    FLAGS,
    HEADER_WORDS,
    LAST_SIZE,
    LENGTH,
    OUTBOX_WORDS,
    PARTS,
    PARTS_AT,
    ROOM,
    group,
    send_parts,
)
from gateway.compiled.system_calls import MSG_TRUNC, receive_many
from gateway.hub.stream_words import ACCEPTED, HALF, LAST, LEADER, LOST, NEWEST_US, STREAM_WORDS
from gateway.wire.frame_scan import SEQUENCE, TIME_SIZE, frame_holds, frame_key, frame_size

MAX_DATAGRAM: Final = 4096
"""Maximum size of a datagram, longer ones are truncated: programs that join frames fill a network
packet, at most some 2000 bytes."""
READS: Final = ROOM
"""Maximum datagrams of a read, and maximum frames of a run."""
HAND_OVER, RUN_SENT, ERROR, UNREAD = 1, 2, 4, 8

STATUS, NOW_US, MOST, IS_OBSERVED, COUNT, AT, OFFSET, TAKEN, READ, ERROR_NUMBER = range(10)
"""Words of the state of a step: its result and the time; maximum bytes of a read, and whether
Python gets each run; the number of datagrams, the present one and the offset in it; bytes
processed and read; the number of an error."""
FRAME, TARGETS, RUN_SIZE, FAILED, TIME_US, TIME_STEP, RECORDS_SIZE = range(10, 17)
"""Size of the frame that is passed to Python, if it is one; the address of the targets of the run,
its bytes, and the number of failed targets; the time of its first record, and between two, and the
bytes of all."""
BUFFER_AT, HEADERS_AT, OUTBOX_AT, TABLE_AT, FAILED_AT = range(17, 22)
RECORDS_AT, ROUTES_AT, NEWEST_AT = range(22, 25)
"""Addresses of the other memory; `NEWEST_AT` is that of the newest frame of each route."""
WORDS: Final = 25
CLIENT_ID, INPUT, OUTPUT, WAY, IS_PLAIN, LARGEST, CUT, RECEIVED, RECEIVED_SIZE, HEARD_US = range(10)
"""Words of a client: its id; the files to receive from and to send to, or -1, and the mode of
sending; whether its frames may be forwarded without Python; the size of its largest recent
datagram; datagrams that were cut, frames and bytes that were forwarded, time of the last one."""
CLIENT_WORDS: Final = 10
SEED, TARGETS_OF, STREAM_AT, HEARD_AT, FRAMES, SIZE, NEWEST_SIZE, ROUTE_US = range(8)
"""Words of a route: seed of the checksum, addresses of its targets, of the stream of its system and
of the time when the system was received last; numbers of frames and bytes; size and time of the
newest frame."""
ROUTE_WORDS: Final = 8
TARGET_COUNT, HAS_OTHERS, SENT, SENT_SIZE, FIRST_TARGET = range(5)
"""Words of targets: number of clients, whether Python serves others, frames and bytes sent to each,
address of the first."""
KEY_CLIENT, KEY, ROUTE_AT = range(3)
"""Words of an entry of the table."""
ENTRIES: Final = 65_536
MAX_FRAME: Final = 280
MAX_RECORD: Final = TIME_SIZE + MAX_FRAME
"""Maximum sizes of a frame, and of one with its time, bytes."""
FAILED_WORDS: Final = 4
"""Words of a failed client: index among the targets, number of frames sent, number of the error,
and bytes of the next frame that were sent."""
MAX_FAILED: Final = 4096

_INT: Final = np.dtype(np.int64)
_BYTE: Final = np.dtype(np.uint8)
_LOW_KEY: Final = (1 << 24) - 1
_FACTORS: Final = (0x9E3779, 0x85EBCB, 0xC2B2AF)
"""Odd factors of a hash, of 24 bits, so that no product exceeds 64 bits."""
_LEAST_DATAGRAM: Final = 32


@EntryPoint
def forward(work_at: int, client_at: int, reads: int) -> None:
    """Receive if `reads`, and forward up to the first bytes that need Python."""
    work = array_at(work_at, (WORDS,), _INT)
    client = array_at(client_at, (CLIENT_WORDS,), _INT)
    headers = array_at(work[HEADERS_AT], (READS, HEADER_WORDS), _INT)
    outbox = array_at(work[OUTBOX_AT], (OUTBOX_WORDS,), _INT)
    work[STATUS] = work[FAILED] = outbox[PARTS] = 0
    if reads:
        _receive(work, client, headers)
    _walk(work, client, headers, outbox)
    if not work[STATUS] & RUN_SENT:
        _send_run(work, outbox)
    if work[AT] < work[COUNT]:
        work[STATUS] |= UNREAD


@compiled
def _receive(work: Any, client: Any, headers: Any) -> None:
    """Receive about as many datagrams as `MOST` allows."""
    work[AT] = work[OFFSET] = work[COUNT] = work[TAKEN] = work[READ] = 0
    count = min(READS, max(1, (work[MOST] + client[LARGEST] - 1) // client[LARGEST]))
    count = receive_many(client[INPUT], work[HEADERS_AT], count)
    if count < 0:
        if count != -errno.EAGAIN:
            work[STATUS], work[ERROR_NUMBER] = ERROR, -count
        return
    work[COUNT] = count
    # The size decreases slowly, so that a mixture of sizes is not underestimated.
    largest = max(_LEAST_DATAGRAM, client[LARGEST] - client[LARGEST] // 4)
    for k in range(count):
        work[READ] += headers[k, LENGTH]
        largest = max(largest, headers[k, LENGTH])
        if headers[k, FLAGS] & MSG_TRUNC:
            client[CUT] += 1
    client[LARGEST] = largest


@compiled
def _walk(work: Any, client: Any, headers: Any, outbox: Any) -> None:
    """Gather runs and send all but the last, up to the first bytes that need Python."""
    data = array_at(work[BUFFER_AT], (READS * MAX_DATAGRAM,), _BYTE)
    while work[AT] < work[COUNT] and work[TAKEN] < work[MOST]:
        begin = work[AT] * MAX_DATAGRAM + work[OFFSET]
        end = work[AT] * MAX_DATAGRAM + headers[work[AT], LENGTH]
        while begin < end:
            size = frame_size(data, begin, end)
            found = _route_of(work, client, data, begin) if size and client[IS_PLAIN] else 0
            if found == 0:
                work[FRAME] = size
                work[STATUS] |= HAND_OVER
                return
            route = array_at(found, (ROUTE_WORDS,), _INT)
            if not frame_holds(data, begin, route[SEED]):
                work[FRAME] = 0
                work[STATUS] |= HAND_OVER
                return
            if outbox[PARTS] == READS or route[TARGETS_OF] != work[TARGETS]:
                _send_run(work, outbox)
                if work[STATUS] & RUN_SENT:
                    return
            _gather(work, client, outbox, route, data, begin, size)
            _keep(work, found, route, data, begin, size)
            begin += size
            work[OFFSET] += size
        work[TAKEN] += headers[work[AT], LENGTH]
        work[AT] += 1
        work[OFFSET] = 0


@compiled
def entry_of(client_id: int, key: int) -> int:
    """Return the index in the table at which the search for a route begins."""
    low, high = (key & _LOW_KEY) * _FACTORS[0], (key >> 24) * _FACTORS[1]
    number = low ^ high ^ client_id * _FACTORS[2]
    return (number >> 24 ^ number >> 8) % ENTRIES


@compiled
def _route_of(work: Any, client: Any, data: Any, begin: int) -> int:
    """Return the address of the route of a frame, or 0."""
    key = frame_key(data, begin)
    table = array_at(work[TABLE_AT], (ENTRIES, 3), _INT)
    entry = entry_of(client[CLIENT_ID], key)
    while table[entry, KEY_CLIENT]:
        if table[entry, KEY] == key and table[entry, KEY_CLIENT] == client[CLIENT_ID]:
            return int(table[entry, ROUTE_AT])
        entry = (entry + 1) % ENTRIES
    return 0


@compiled
def count_sequence(stream: Any, sequence: int) -> None:
    """Count an accepted frame of a stream, and those lost before it."""
    ahead = (sequence - stream[LAST]) & 0xFF
    if stream[ACCEPTED] == 0:
        stream[LAST] = sequence
    elif 0 < ahead < HALF:
        stream[LOST] += ahead - 1
        stream[LAST] = sequence
    stream[ACCEPTED] += 1


@compiled
def _keep(work: Any, route_at: int, route: Any, data: Any, begin: int, size: int) -> None:
    """Keep a frame as the newest of its route."""
    row = (route_at - work[ROUTES_AT]) // (8 * ROUTE_WORDS)
    newest = array_at(work[NEWEST_AT] + row * MAX_FRAME, (MAX_FRAME,), _BYTE)
    for i in range(size):
        newest[i] = data[begin + i]
    route[NEWEST_SIZE], route[ROUTE_US] = size, work[NOW_US]


@compiled
def _gather(
    work: Any, client: Any, outbox: Any, route: Any, data: Any, begin: int, size: int
) -> None:
    """Add a frame to the run, and count it."""
    parts = array_at(outbox[PARTS_AT], (READS, 2), _INT)
    parts[outbox[PARTS], 0], parts[outbox[PARTS], 1] = work[BUFFER_AT] + begin, size
    outbox[PARTS] += 1
    work[TARGETS] = route[TARGETS_OF]
    work[RUN_SIZE] += size
    stream = array_at(route[STREAM_AT], (STREAM_WORDS,), _INT)
    count_sequence(stream, int(data[begin + SEQUENCE]))
    stream[data[begin + SEQUENCE]] = stream[NEWEST_US] = work[NOW_US]
    stream[LEADER] = client[CLIENT_ID]
    heard = array_at(route[HEARD_AT], (1,), _INT)
    heard[0] = client[HEARD_US] = work[NOW_US]
    client[RECEIVED] += 1
    client[RECEIVED_SIZE] += size
    route[FRAMES] += 1
    route[SIZE] += size


@compiled
def _send_run(work: Any, outbox: Any) -> None:
    """Send the run to its clients, and discard it unless Python must process it further."""
    if outbox[PARTS] == 0:
        return
    count = array_at(work[TARGETS], (1,), _INT)[TARGET_COUNT]
    targets = array_at(work[TARGETS], (FIRST_TARGET + count,), _INT)
    failed = array_at(work[FAILED_AT], (MAX_FAILED, FAILED_WORDS), _INT)
    group(outbox)
    for k in range(count):
        client = array_at(targets[FIRST_TARGET + k], (CLIENT_WORDS,), _INT)
        outbox[LAST_SIZE] = 0
        sent = send_parts(outbox, client[OUTPUT], client[WAY]) if client[OUTPUT] >= 0 else 0
        if sent < outbox[PARTS]:
            row = work[FAILED]
            failed[row, 0], failed[row, 1] = k, max(sent, 0)
            failed[row, 2], failed[row, 3] = max(-sent, 0), outbox[LAST_SIZE]
            work[FAILED] += 1
    targets[SENT] += outbox[PARTS]
    targets[SENT_SIZE] += work[RUN_SIZE]
    work[RUN_SIZE] = 0
    if work[FAILED] or targets[HAS_OTHERS] or work[IS_OBSERVED]:
        work[STATUS] |= RUN_SENT
    else:
        outbox[PARTS] = 0


@EntryPoint
def record(work_at: int) -> None:
    """Write the frames of the run one after the other, each behind its time, as in a tlog."""
    work = array_at(work_at, (WORDS,), _INT)
    outbox = array_at(work[OUTBOX_AT], (OUTBOX_WORDS,), _INT)
    parts = array_at(outbox[PARTS_AT], (READS, 2), _INT)
    data = array_at(work[BUFFER_AT], (READS * MAX_DATAGRAM,), _BYTE)
    records = array_at(work[RECORDS_AT], (READS * MAX_RECORD,), _BYTE)
    end, time_us = 0, work[TIME_US]
    for k in range(outbox[PARTS]):
        for i in range(TIME_SIZE):
            records[end + i] = time_us >> 8 * (TIME_SIZE - 1 - i) & 0xFF
        end += TIME_SIZE
        begin = parts[k, 0] - work[BUFFER_AT]
        for i in range(parts[k, 1]):
            records[end + i] = data[begin + i]
        end += parts[k, 1]
        time_us += work[TIME_STEP]
    work[RECORDS_SIZE] = end
