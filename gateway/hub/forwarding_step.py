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

from gateway.compiled import array_at, compiled, layout_of, record_at, shared
from gateway.compiled.entry_point import EntryPoint
from gateway.compiled.messages import HEADER, OUTBOX, PART, ROOM, group, send_parts
from gateway.compiled.system_calls import MSG_TRUNC, receive_many
from gateway.hub.frame_stream import STREAM, count_sequence
from gateway.wire.frame_scan import SEQUENCE, TIME_SIZE, frame_holds, frame_key, frame_size

MAX_DATAGRAM: Final = 4096
"""Maximum size of a datagram, longer ones are truncated: programs that join frames fill a network
packet, at most some 2000 bytes."""
READS: Final = ROOM
"""Maximum datagrams of a read, and maximum frames of a run."""
HAND_OVER, RUN_SENT, ERROR, UNREAD = 1, 2, 4, 8
ENTRIES: Final = 65_536
MAX_FRAME: Final = 280
MAX_RECORD: Final = TIME_SIZE + MAX_FRAME
"""Maximum sizes of a frame, and of one with its time, bytes."""
MAX_FAILED: Final = 4096
_INT: Final = np.dtype(np.int64)
_BYTE: Final = np.dtype(np.uint8)
_LOW_KEY: Final = (1 << 24) - 1
_FACTORS: Final = (0x9E3779, 0x85EBCB, 0xC2B2AF)
"""Odd factors of a hash, of 24 bits, so that no product exceeds 64 bits."""
_LEAST_DATAGRAM: Final = 32


@shared
class Work:
    """State of a step, and the addresses of the other memory."""

    status: int
    now_us: int
    most: int
    """Maximum bytes of a read."""
    is_observed: int
    """Whether Python gets each run."""
    count: int
    """Datagrams that were read."""
    at: int
    """The present one of them."""
    offset: int
    """Offset in it."""
    taken: int
    """Bytes that were processed."""
    read: int
    """Bytes that were read."""
    error_number: int
    frame: int
    """Size of the frame that is passed to Python, if it is one."""
    targets: int
    """Address of the targets of the run."""
    run_size: int
    failed: int
    """Number of clients that did not get the whole run."""
    time_us: int
    """Time of the run's first record."""
    time_step: int
    """Time between two records, us."""
    records_size: int
    buffer_at: int
    headers_at: int
    outbox_at: int
    table_at: int
    failed_at: int
    records_at: int
    routes_at: int
    newest_at: int
    """Address of the newest frame of each route."""


@shared
class ClientState:
    """State of a client in the step; its files are -1 if it has none."""

    id: int
    input: int
    """File to receive from."""
    output: int
    """File to send to."""
    way: int
    """Mode of sending."""
    is_forwardable: int
    """Whether its frames may be forwarded without Python."""
    largest: int
    """Size of its largest recent datagram."""
    cut: int
    """Datagrams that were longer than a read."""
    received: int
    """Frames that were forwarded."""
    received_size: int
    heard_us: int
    """Time of the last one."""


@shared
class RouteState:
    """A route: the seed of its checksum, its targets, its system, and what was forwarded."""

    seed: int
    targets_at: int
    stream_at: int
    heard_at: int
    """Address of the time when the system was received last."""
    frames: int
    frames_size: int
    newest_size: int
    newest_us: int


@shared
class TargetCounts:
    """Head of the memory of targets; the addresses of the clients follow."""

    clients: int
    has_others: int
    """Whether Python serves others."""
    sent: int
    """Frames sent to each."""
    sent_size: int


@shared
class Failure:
    """A client that did not get the whole run."""

    index: int
    """Among the targets."""
    sent: int
    """Frames sent."""
    number: int
    """Number of the error."""
    part: int
    """Bytes of the next frame that were sent."""


@shared
class Entry:
    """An entry of the table of routes."""

    client_id: int
    key: int
    route_at: int


WORK: Final = layout_of(Work)
CLIENT: Final = layout_of(ClientState)
ROUTE: Final = layout_of(RouteState)
TARGETS: Final = layout_of(TargetCounts)
FAILURE: Final = layout_of(Failure)
ENTRY: Final = layout_of(Entry)
_ROUTE_SIZE: Final = ROUTE.itemsize
_TARGETS_SIZE: Final = TARGETS.itemsize


@EntryPoint
def forward(work_at: int, client_at: int, reads: int) -> None:
    """Receive if `reads`, and forward up to the first bytes that need Python."""
    work = record_at(work_at, WORK)
    client = record_at(client_at, CLIENT)
    headers = array_at(work.headers_at, (READS,), HEADER)
    outbox = record_at(work.outbox_at, OUTBOX)
    work.status = work.failed = outbox.parts = 0
    if reads:
        _receive(work, client, headers)
    _walk(work, client, headers, outbox)
    if not work.status & RUN_SENT:
        _send_run(work, outbox)
    if work.at < work.count:
        work.status |= UNREAD


@compiled
def _receive(work: Any, client: Any, headers: Any) -> None:
    """Receive about as many datagrams as `most` bytes allow."""
    work.at = work.offset = work.count = work.taken = work.read = 0
    count = min(READS, max(1, (work.most + client.largest - 1) // client.largest))
    count = receive_many(client.input, work.headers_at, count)
    if count < 0:
        if count != -errno.EAGAIN:
            work.status, work.error_number = ERROR, -count
        return
    work.count = count
    # The size decreases slowly, so that a mixture of sizes is not underestimated.
    largest = max(_LEAST_DATAGRAM, client.largest - client.largest // 4)
    for k in range(count):
        work.read += headers[k].length
        largest = max(largest, headers[k].length)
        if headers[k].received_flags & MSG_TRUNC:
            client.cut += 1
    client.largest = largest


@compiled
def _walk(work: Any, client: Any, headers: Any, outbox: Any) -> None:
    """Gather runs and send all but the last, up to the first bytes that need Python."""
    data = array_at(work.buffer_at, (READS * MAX_DATAGRAM,), _BYTE)
    while work.at < work.count and work.taken < work.most:
        begin = work.at * MAX_DATAGRAM + work.offset
        end = work.at * MAX_DATAGRAM + headers[work.at].length
        while begin < end:
            size = frame_size(data, begin, end)
            found = _route_of(work, client, data, begin) if size and client.is_forwardable else 0
            if found == 0:
                work.frame = size
                work.status |= HAND_OVER
                return
            route = record_at(found, ROUTE)
            if not frame_holds(data, begin, route.seed):
                work.frame = 0
                work.status |= HAND_OVER
                return
            if outbox.parts == READS or route.targets_at != work.targets:
                _send_run(work, outbox)
                if work.status & RUN_SENT:
                    return
            _gather(work, client, outbox, route, data, begin, size)
            _keep(work, found, route, data, begin, size)
            begin += size
            work.offset += size
        work.taken += headers[work.at].length
        work.at += 1
        work.offset = 0


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
    table = array_at(work.table_at, (ENTRIES,), ENTRY)
    entry = entry_of(client.id, key)
    while table[entry].client_id:
        if table[entry].key == key and table[entry].client_id == client.id:
            return int(table[entry].route_at)
        entry = (entry + 1) % ENTRIES
    return 0


@compiled
def _keep(work: Any, route_at: int, route: Any, data: Any, begin: int, size: int) -> None:
    """Keep a frame as the newest of its route."""
    row = (route_at - work.routes_at) // _ROUTE_SIZE
    newest = array_at(work.newest_at + row * MAX_FRAME, (MAX_FRAME,), _BYTE)
    for i in range(size):
        newest[i] = data[begin + i]
    route.newest_size, route.newest_us = size, work.now_us


@compiled
def _gather(
    work: Any, client: Any, outbox: Any, route: Any, data: Any, begin: int, size: int
) -> None:
    """Add a frame to the run, and count it."""
    parts = array_at(outbox.parts_at, (READS,), PART)
    part = parts[outbox.parts]
    part.at, part.length = work.buffer_at + begin, size
    outbox.parts += 1
    work.targets = route.targets_at
    work.run_size += size
    stream = record_at(route.stream_at, STREAM)
    count_sequence(stream, int(data[begin + SEQUENCE]))
    stream.sent_us[data[begin + SEQUENCE]] = stream.newest_us = work.now_us
    stream.leader = client.id
    heard = array_at(route.heard_at, (1,), _INT)
    heard[0] = client.heard_us = work.now_us
    client.received += 1
    client.received_size += size
    route.frames += 1
    route.frames_size += size


@compiled
def _send_run(work: Any, outbox: Any) -> None:
    """Send the run to its clients, and discard it unless Python must process it further."""
    if outbox.parts == 0:
        return
    targets = record_at(work.targets, TARGETS)
    clients = array_at(work.targets + _TARGETS_SIZE, (targets.clients,), _INT)
    failed = array_at(work.failed_at, (MAX_FAILED,), FAILURE)
    group(outbox)
    for k in range(targets.clients):
        client = record_at(clients[k], CLIENT)
        outbox.last_size = 0
        sent = send_parts(outbox, client.output, client.way) if client.output >= 0 else 0
        if sent < outbox.parts:
            failure = failed[work.failed]
            failure.index, failure.sent = k, max(sent, 0)
            failure.number, failure.part = max(-sent, 0), outbox.last_size
            work.failed += 1
    targets.sent += outbox.parts
    targets.sent_size += work.run_size
    work.run_size = 0
    if work.failed or targets.has_others or work.is_observed:
        work.status |= RUN_SENT
    else:
        outbox.parts = 0


@EntryPoint
def record(work_at: int) -> None:
    """Write the frames of the run one after the other, each behind its time, as in a tlog."""
    work = record_at(work_at, WORK)
    outbox = record_at(work.outbox_at, OUTBOX)
    parts = array_at(outbox.parts_at, (READS,), PART)
    data = array_at(work.buffer_at, (READS * MAX_DATAGRAM,), _BYTE)
    records = array_at(work.records_at, (READS * MAX_RECORD,), _BYTE)
    end, time_us = 0, work.time_us
    for k in range(outbox.parts):
        for i in range(TIME_SIZE):
            records[end + i] = time_us >> 8 * (TIME_SIZE - 1 - i) & 0xFF
        end += TIME_SIZE
        begin = parts[k].at - work.buffer_at
        for i in range(parts[k].length):
            records[end + i] = data[begin + i]
        end += parts[k].length
        time_us += work.time_step
    work.records_size = end
