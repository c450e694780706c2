"""The tlog format: bytes to records, records to bytes, an index for seeking, and its times.

Ground stations consider a tlog corrupt if its times are in the future or do not increase. So the
offset from the gateway clock to civil time is constant while a file is open, and a clock jump
requires a new file.
"""

from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from gateway.recordings.tlog_scan import (
    COLUMNS,
    KNOWN_IDS,
    LARGEST_RECORD,
    SMALLEST_RECORD,
    ExtraArray,
    IntArray,
    lacks_end,
    scan,
)
from gateway.units import US_PER_S
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import CRC_EXTRA, ids_of
from gateway.wire.recorded_frames import Batch, Damage
from gateway.wire.timesync import GpsTime

DAY_US: Final = 86_400 * US_PER_S
"""Records further apart are of different days: the time between them is not counted."""
ORDER_US: Final = 2 * US_PER_S
"""A time before that of the previous record, or after that of the next, by more is damaged."""

Times = TypeVar("Times", int, NDArray[np.int64])
STRIDE: Final = 256
"""Records per entry of the index: a seek scans at most this many, about 15 kB."""
SEEK_BYTES: Final = STRIDE * LARGEST_RECORD
BACK_US: Final = 60 * US_PER_S
"""Maximum backward step from reordering of two links' frames; more means a clock change."""
FIRST_CIVIL_US: Final = 946_684_800 * US_PER_S
"""The year 2000; an earlier time counts from the start of a clock."""
MAX_JUMPS: Final = 1000
UNRECORDED: Final = ids_of("HIGH_LATENCY2")
"""Messages for narrow links. Recorded next to the messages that they summarise, a ground
station would take them for another state of the vehicle."""
JUMP_US: Final = 2 * US_PER_S
"""Minimum error of the assumed civil time that requires a new file. The arrival of GPS time lags
by up to a second, and NTP slews smaller errors away."""
STEP_US: Final = 4
"""Minimum difference of two timestamps: readers use the low two bits as a link number."""
_LINK_BITS: Final = 3


def is_damaged(before_us: Times, time_us: Times, after_us: Times) -> bool | NDArray[np.bool_]:
    """Return whether a time is not between its neighbours, which are in order."""
    gap_us = after_us - before_us
    is_in_order = (gap_us >= -ORDER_US) & (gap_us <= DAY_US)
    is_outside = (time_us < before_us - ORDER_US) | (time_us > after_us + ORDER_US)
    return is_in_order & is_outside


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
        mended = self._mend(found[2], data[end : end + TIME_SIZE]) if count else 0
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


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A step of a recording's clock that the timeline removes."""

    offset_us: int
    """Time of the step since the first record."""
    step_us: int


class Timeline:
    """A continuous time for a tlog whose clock was set while it was written.

    A step of the clock between two records by more than a day, or back by more than a minute, is
    a jump, and is removed from the time. The date is that of the first section between jumps whose
    clock had a possible civil date; without one, that of the first section.
    """

    def __init__(self) -> None:
        self.jumps: list[ClockJump] = []
        self._begins: list[int] = []
        self._shifts_us: list[int] = []
        self._first_us = 0
        self._last_us: int | None = None
        self._date_shift_us: int | None = None

    def add(self, batch: Batch) -> None:
        """Add the recorded times of the next batch of the file."""
        if not len(batch):
            return
        times_us = batch.time_us
        if self._last_us is None:
            self._first_us = int(times_us[0])
            self._begin(batch, 0, 0)
            self._last_us = self._first_us
        steps_us = np.diff(times_us, prepend=self._last_us)
        for record in np.flatnonzero((steps_us > DAY_US) | (steps_us < -BACK_US)).tolist():
            if len(self.jumps) == MAX_JUMPS:
                break
            step_us, shift_us = int(steps_us[record]), self._shifts_us[-1]
            now_us = int(times_us[record]) - step_us + shift_us
            self.jumps.append(ClockJump(now_us - self._first_us, step_us))
            self._begin(batch, record, shift_us - step_us)
        self._last_us = int(times_us[-1])

    def _begin(self, batch: Batch, record: int, shift_us: int) -> None:
        self._begins.append(batch.offset + int(batch.starts[record]))
        self._shifts_us.append(shift_us)
        if self._date_shift_us is None and int(batch.time_us[record]) >= FIRST_CIVIL_US:
            self._date_shift_us = shift_us

    def apply(self, batch: Batch) -> Batch:
        """Return a batch of the same file with corrected times."""
        if not self.jumps or not len(batch):
            return batch
        shifts_us = np.array(self._shifts_us) - (self._date_shift_us or 0)
        at = np.searchsorted(self._begins, batch.starts + batch.offset, side="right") - 1
        corrected: IntArray = batch.time_us + shifts_us[np.maximum(at, 0)]
        return replace(batch, time_us=corrected)


class CivilClock:
    """The best estimate of civil time: from GPS if available, else from the machine's clock."""

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._from_gps = False
        self._gps = GpsTime()

    @property
    def offset_us(self) -> int | None:
        """Civil time at gateway time zero, µs since 1970; None before any time is known."""
        return self._offset_us

    def update_machine(self, unix_us: int, now_us: int) -> None:
        """Process the machine's civil time, which is used until GPS time is known."""
        if not self._from_gps:
            self._offset_us = unix_us - now_us

    def update_gps(self, vehicle_id: int, utc_us: int, time_us: int) -> None:
        """Process the time of an aircraft's fix and its time of arrival.

        If the machine's time agrees within `JUMP_US`, it is kept, as it is more precise.
        """
        offset_us = self._gps.update(vehicle_id, utc_us, time_us)
        if offset_us is None:
            return
        if self._offset_us is None or abs(offset_us - self._offset_us) > JUMP_US:
            self._offset_us = offset_us
            self._from_gps = True


class Stamper:
    """Timestamps of one file, which increase and have a constant offset to the gateway clock."""

    def __init__(self, offset_us: int) -> None:
        self.offset_us = offset_us
        self._last_us = 0

    def stamp(self, now_us: int) -> int:
        """Return the civil time of a moment, greater than all timestamps before."""
        wanted_us = max(now_us + self.offset_us, 0) & ~_LINK_BITS
        self._last_us = max(wanted_us, self._last_us + STEP_US)
        return self._last_us

    def stamp_several(self, now_us: int, count: int) -> int:
        """Return the first timestamp of `count` frames of one moment, `STEP_US` apart."""
        first_us = self.stamp(now_us)
        self._last_us += STEP_US * (count - 1)
        return first_us

    def has_jumped(self, clock: CivilClock) -> bool:
        """Return whether the clock now has a time that differs too much from this file's."""
        offset_us = clock.offset_us
        return offset_us is not None and abs(offset_us - self.offset_us) > JUMP_US
