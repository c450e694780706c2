"""The tlog format: bytes to records, and records to bytes."""

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from gateway.recordings.recorded_clock import DAY_US, is_damaged
from gateway.recordings.tlog_scan import (
    COLUMNS,
    KNOWN_IDS,
    LARGEST_RECORD,
    SMALLEST_RECORD,
    TIME,
    ExtraArray,
    IntArray,
    lacks_end,
    scan,
)
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import CRC_EXTRA, ids_of
from gateway.wire.recorded_frames import Batch, Damage

STRIDE: Final = 256
"""Records per entry of the index: a seek scans at most this many, about 15 kB."""
SEEK_BYTES: Final = STRIDE * LARGEST_RECORD
UNRECORDED: Final = ids_of("HIGH_LATENCY2")
"""Messages for narrow links. Recorded next to the messages that they summarise, a ground
station would take them for another state of the vehicle."""


def _crc_extra_table() -> ExtraArray:
    """Return the messages' checksum seeds as an array by message id, -1 for unknown ids."""
    table = np.full(KNOWN_IDS, -1, np.int16)
    for message_id, extra in CRC_EXTRA.items():
        if message_id < KNOWN_IDS:
            table[message_id] = extra[0]
    return table


_EXTRA: Final = _crc_extra_table()


def encode_record(time_us: int, frame: bytes) -> bytes:
    """Build the bytes of one record."""
    return time_us.to_bytes(TIME_SIZE, "big") + frame


class TlogScanner:
    """Decode any chunks of a tlog into batches of records; never raises on data."""

    def __init__(self, offset: int = 0, *, strict: bool = False) -> None:
        self._offset = offset
        self._strict = strict
        self._rest = b""
        self._in_step = True
        self._last_us: int | None = None
        """Time of the newest record."""

    def feed(self, data: bytes, *, final: bool = False) -> Batch:
        """Process the next bytes of the file."""
        data = self._rest + data if self._rest else data
        room = len(data) // SMALLEST_RECORD + 1
        columns = np.empty((COLUMNS, room), np.int64)
        runs = np.empty((2, room + 1), np.int64)
        was_in_step = self._in_step
        end, count, damaged, self._in_step = scan(
            np.frombuffer(data, np.uint8), final, self._strict, self._in_step, _EXTRA, columns, runs
        )
        offset = self._offset
        self._rest = data[end:]
        self._offset += end
        found = columns[:, :count]
        mended = self._mend(found[TIME], data[end : end + TIME_SIZE]) if count else 0
        begins, ends = runs[:, :damaged].tolist()
        damage = [Damage(offset + b, e - b) for b, e in zip(begins, ends, strict=True)]
        unfinished = 0
        if final and damage and ends[-1] == len(data) and (begins[-1] or was_in_step):
            rest = np.frombuffer(data, np.uint8)[begins[-1] :]
            unfinished = damage.pop().size if lacks_end(rest) else 0
        starts, sizes, times, origins, message_ids = found
        return Batch(
            data, offset, starts, sizes, times, origins, message_ids, tuple(damage), mended,
            unfinished,
        )  # fmt: skip

    def feed_all(self, chunks: Iterable[bytes]) -> Iterator[Batch]:
        """Process the rest of the file."""
        yield from map(self.feed, chunks)
        yield self.feed(b"", final=True)

    def _mend(self, times: IntArray, following: bytes) -> int:
        """Replace damaged times, which no checksum detects, by that of the previous record."""
        # The first byte of a time is zero; otherwise the following bytes are not a time.
        is_known = self._in_step and len(following) == TIME_SIZE and following[0] == 0
        next_us = int.from_bytes(following, "big") if is_known else int(times[-1])
        last_us = int(times[0]) if self._last_us is None else self._last_us
        after = np.append(times[1:], next_us)
        before = np.insert(times[:-1], 0, last_us)
        if self._last_us is None and abs(int(after[0]) - last_us) > DAY_US:
            before[0] = after[0]
        if not is_known and abs(int(before[-1]) - next_us) > DAY_US:
            after[-1] = before[-1]
        mended = -2
        count = 0
        for i in np.flatnonzero(is_damaged(before, times, after)).tolist():
            # After a damaged record the next one only seems out of order.
            if i != mended + 1:
                times[i] = before[i]
                mended, count = i, count + 1
        self._last_us = int(times[-1])
        return count
