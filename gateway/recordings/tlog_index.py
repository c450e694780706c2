"""Index of a tlog: offsets to read from for a time, its senders, its damage."""

from array import array
from bisect import bisect_left
from typing import Final

import numpy as np

from gateway.recordings.recorded_clock import Timeline
from gateway.recordings.tlog import STRIDE
from gateway.units import counted
from gateway.vehicle_state.senders import Senders
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.recorded_frames import Batch, Damage

DAMAGED: Final = "damaged: {} in {}; `mavgate recover` leaves them out"
DAMAGED_TIME: Final = "{} with a damaged time, replaced by that of the record before"
INCOMPLETE: Final = "the last {} is incomplete ({}): it is still being written, or was cut off"
MAX_DAMAGE_RUNS: Final = 1000
"""Runs that are listed, so that a file damaged throughout cannot fill the memory."""


class TlogIndex:
    """Index of a file: offsets to read from for a time, and a summary.

    There is one entry per `STRIDE` records, so the index has about a thousandth of the size of the
    file. Timestamps of other programs' files may step back; the index searches by the greatest time
    so far, which never decreases.
    """

    def __init__(self, timeline: Timeline | None = None) -> None:
        self.timeline = timeline or Timeline()
        """Corrects the times of batches that are read again."""
        self.count = 0
        """Number of records."""
        self.size = 0
        """Number of bytes processed, including damage."""
        self.first_us: int | None = None
        self.last_us: int | None = None
        """Greatest time."""
        self.senders = Senders()
        self.damage: list[Damage] = []
        """The first `MAX_DAMAGE_RUNS` runs of damaged bytes."""
        self.damaged_bytes = 0
        self.mended = 0
        """Number of records whose time was damaged."""
        self.unfinished = 0
        """Bytes of an incomplete last record."""
        self._offsets = array("q")
        self._times = array("q")

    def add(self, batch: Batch) -> None:
        """Add the next batch of the file."""
        for run in batch.damage:
            self._add_damage(run)
        self.mended += batch.mended
        self.unfinished += batch.unfinished
        if not len(batch):
            return
        self.senders.add(batch)
        if self.first_us is None or self.last_us is None:
            self.first_us = self.last_us = int(batch.time_us[0])
        greatest = np.maximum.accumulate(np.maximum(batch.time_us, self.last_us))
        first = -self.count % STRIDE
        self._offsets.frombytes((batch.starts[first::STRIDE] + batch.offset).tobytes())
        self._times.frombytes(greatest[first::STRIDE].tobytes())
        self.count += len(batch)
        self.last_us = int(greatest[-1])
        end = int(batch.starts[-1]) + TIME_SIZE + int(batch.sizes[-1])
        self.size = max(self.size, batch.offset + end)

    @property
    def remarks(self) -> list[str]:
        """Describe the damage."""
        found = []
        if self.damaged_bytes:
            size, runs = counted(self.damaged_bytes, "byte"), counted(len(self.damage), "place")
            found.append(DAMAGED.format(size, runs))
        if self.mended:
            found.append(DAMAGED_TIME.format(counted(self.mended, "record")))
        if self.unfinished:
            found.append(INCOMPLETE.format("record", counted(self.unfinished, "byte")))
        return found

    def offset_before(self, time_us: int, records: int = 0) -> int:
        """Return an offset before the first record that is not earlier than a time."""
        if not self._offsets:
            return 0
        entry = bisect_left(self._times, time_us) - 1 - -(-records // STRIDE)
        return self._offsets[max(entry, 0)]

    def _add_damage(self, run: Damage) -> None:
        self.damaged_bytes += run.size
        self.size = max(self.size, run.offset + run.size)
        last = self.damage[-1] if self.damage else None
        if last is not None and last.offset + last.size == run.offset:
            # A run across two batches arrives in two pieces.
            self.damage[-1] = Damage(last.offset, last.size + run.size)
        elif len(self.damage) < MAX_DAMAGE_RUNS:
            self.damage.append(run)
