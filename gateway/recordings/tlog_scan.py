"""Find the records of a tlog in bytes, at memory speed.

Theory of operation. A tlog is a sequence of records: eight bytes of time, most significant first,
then one MAVLink frame, whose length byte gives the start of the next record. While the file is
intact, each record is confirmed by the header of the next one, and no checksum is needed:

| state       | condition                                           | action                     |
| ----------- | --------------------------------------------------- | -------------------------- |
| in step     | followed by the header of a record, or by the end   | kept                       |
| in step     | not so, but its checksum is valid or its id unknown | kept; damage follows       |
| in step     | neither                                             | damage starts: out of step |
| out of step | valid checksum, or unknown id and a header follows  | kept: in step again        |
| out of step | neither                                             | continue at the next byte  |

A header is a time before the year 4253 (its first byte is zero) followed by the first byte of a
frame. A strict scan verifies every checksum, also in step.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import address_of, array_at, compiled
from gateway.compiled.entry_point import EntryPoint
from gateway.wire.frame_scan import TIME_SIZE, crc_holds

ByteArray = NDArray[np.uint8]
IntArray = NDArray[np.int64]
ExtraArray = NDArray[np.int16]

HEADER_SIZE: Final = 9
"""Size of a record's time and the first byte of its frame, by which the next record is checked."""
SMALLEST_RECORD: Final = 16
LARGEST_RECORD: Final = 8 + 12 + 255 + 13

START, SIZE, TIME, ORIGIN, MESSAGE = range(5)
"""Rows of `records`: start and size of the frame, time in µs, system << 8 | component, message."""
COLUMNS: Final = 5
BEGIN, END = range(2)
"""Rows of `damage`."""

KNOWN_IDS: Final = 1 << 16
_YES: Final = 1
_NO: Final = 0
_WAIT: Final = -1

_FINAL, _STRICT, _IN_STEP = 1, 2, 4
_BYTE: Final = np.dtype(np.uint8)
_INT: Final = np.dtype(np.int64)
_EXTRA: Final = np.dtype(np.int16)


@compiled
def _is_header(data: ByteArray, at: int, final: bool) -> int:
    if at + HEADER_SIZE > data.shape[0]:
        return _NO if final else _WAIT
    first = data[at + TIME_SIZE]
    return _YES if data[at] == 0 and (first == 0xFD or first == 0xFE) else _NO


@compiled
def _frame_size(data: ByteArray, at: int) -> int:
    """Return a frame's size from its first three bytes; 0 for unknown flags."""
    if data[at] == 0xFE:
        return int(data[at + 1]) + 8
    flags = data[at + 2]
    if flags > 1:
        return 0
    return int(data[at + 1]) + 12 + 13 * int(flags)


def lacks_end(data: ByteArray) -> bool:
    """Return whether these bytes are the start of an incomplete record."""
    if len(data) < HEADER_SIZE:
        return len(data) > 0 and data[0] == 0
    if _is_header(data, 0, True) != _YES:
        return False
    return len(data) < TIME_SIZE + 3 or len(data) < TIME_SIZE + _frame_size(data, TIME_SIZE)


@compiled
def _message_id(data: ByteArray, at: int) -> int:
    if data[at] == 0xFE:
        return int(data[at + 5])
    return int(data[at + 7]) | int(data[at + 8]) << 8 | int(data[at + 9]) << 16


@compiled
def _checksum(data: ByteArray, at: int, extra: ExtraArray) -> int:
    """Return whether the checksum of a complete frame is valid: yes, no, or `_WAIT` if unknown."""
    message_id = _message_id(data, at)
    seed = int(extra[message_id]) if message_id < extra.shape[0] else -1
    if seed < 0:
        return _WAIT
    end = at + int(data[at + 1]) + (6 if data[at] == 0xFE else 10)
    return _YES if crc_holds(data, at + 1, end, seed) else _NO


@compiled
def _check_record(
    data: ByteArray, at: int, final: bool, strict: bool, in_step: bool, extra: ExtraArray
) -> int:
    """Return the frame size of the record at `at`; 0 if there is none, -1 if bytes are missing."""
    header = _is_header(data, at, final)
    if header != _YES:
        return header
    frame = at + TIME_SIZE
    if frame + 3 > data.shape[0]:
        return 0 if final else _WAIT
    size = _frame_size(data, frame)
    following = frame + size
    if size == 0:
        return 0
    if following > data.shape[0]:
        return 0 if final else _WAIT
    successor = _is_header(data, following, final)
    if successor == _WAIT:
        return _WAIT
    if in_step and not strict and (successor == _YES or following == data.shape[0]):
        return size
    checksum = _checksum(data, frame, extra)
    if checksum == _YES:
        return size
    return size if checksum == _WAIT and (successor == _YES or in_step) else 0


def scan(
    data: ByteArray,
    final: bool,
    strict: bool,
    in_step: bool,
    extra: ExtraArray,
    records: IntArray,
    damage: IntArray,
) -> tuple[int, int, int, bool]:
    """Find the records in bytes that start with a record (`in_step`), or anywhere.

    Fills `records`, shape (COLUMNS, m) with m at least `data.size // SMALLEST_RECORD + 1`, and
    `damage`, shape (2, m + 1), with start and end of each run of bytes that belong to no record.
    Returns the first byte that was not consumed, the numbers of columns filled, and `in_step`.
    """
    found = np.zeros(4, np.int64)
    arrays = (extra, records, damage, found)
    flags = final * _FINAL | strict * _STRICT | in_step * _IN_STEP
    addresses = [address_of(array) for array in (data, *arrays)]
    scan_at(len(data), records.shape[1], flags, *addresses)
    at, count, damaged, in_step_now = found.tolist()
    return (at, count, damaged, bool(in_step_now))


@EntryPoint
def scan_at(
    size: int,
    room: int,
    flags: int,
    data_at: int,
    extra_at: int,
    records_at: int,
    damage_at: int,
    found_at: int,
) -> None:
    """Do `scan` on arrays given by their addresses; the result is written as four numbers."""
    data = array_at(data_at, (size,), _BYTE)
    extra = array_at(extra_at, (KNOWN_IDS,), _EXTRA)
    records = array_at(records_at, (COLUMNS, room), _INT)
    damage = array_at(damage_at, (2, room + 1), _INT)
    found = array_at(found_at, (4,), _INT)
    final, strict = (flags & _FINAL) != 0, (flags & _STRICT) != 0
    at, count, damaged, in_step = _walk(
        data, final, strict, (flags & _IN_STEP) != 0, extra, records, damage
    )
    found[0], found[1], found[2], found[3] = at, count, damaged, in_step


@compiled
def _walk(
    data: ByteArray,
    final: bool,
    strict: bool,
    in_step: bool,
    extra: ExtraArray,
    records: IntArray,
    damage: IntArray,
) -> tuple[int, int, int, bool]:
    at = count = damaged = 0
    bad_from = -1
    while at < data.shape[0]:
        size = _check_record(data, at, final, strict, in_step, extra)
        if size == _WAIT:
            break
        if size == 0:
            bad_from = at if bad_from < 0 else bad_from
            in_step = False
            at += 1
            continue
        if bad_from >= 0:
            damage[BEGIN, damaged], damage[END, damaged] = bad_from, at
            damaged += 1
            bad_from = -1
        frame = at + TIME_SIZE
        time_us = 0
        for i in range(at, frame):
            time_us = time_us << 8 | int(data[i])
        origin = frame + (3 if data[frame] == 0xFE else 5)
        records[START, count], records[SIZE, count], records[TIME, count] = at, size, time_us
        records[ORIGIN, count] = int(data[origin]) << 8 | int(data[origin + 1])
        records[MESSAGE, count] = _message_id(data, frame)
        count += 1
        in_step = True
        at = frame + size
    if bad_from >= 0:
        damage[BEGIN, damaged], damage[END, damaged] = bad_from, at
        damaged += 1
    return (at, count, damaged, in_step)
