"""Join or merge tlogs: by time, and without the copies that several receivers recorded.

Theory of operation. Two programs that record the same link write the same frames, each at the time
of its own clock. A frame whose bytes occur exactly once in each file is a copy. The difference of
its two times is the offset of the clocks plus the difference of the delays. Most copies have nearly
the same difference, so the densest second of all differences is found, and its median is the
offset. A sample of the frames suffices: those whose last two bytes, part of a checksum or a
signature, are divisible by a power of two that grows with the file.

Two flights may contain equal frames as well: the texts of a start, for example. So files are of one
flight only if there are copies during a fair share of the time that both cover, and if the clocks
agree, except where the user states that it is one flight: a clock may be set to another time zone.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from operator import itemgetter
from typing import Final

import numpy as np

from gateway.recordings.files import Progress
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.recordings.tlog_source import TlogSource
from gateway.units import US_PER_S, counted
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.recorded_frames import Batch, IntArray, RecordedFrame

Remark = Callable[[str], None]
"""Adds a remark for the user."""
MAX_SAMPLE: Final = 50_000
"""Maximum number of frames in the sample of a file, about 10 MB."""
WINDOW_US: Final = US_PER_S
"""Maximum time between copies of a frame, once the clocks are aligned."""
LEAST_COPIES: Final = 10
"""Fewer equal frames may be a coincidence: parameters are the same in every flight."""
FAIR_SHARE: Final = 0.25
"""Least share of the common time with copies in files of one flight; a link may lose most."""
MAX_OFFSET_US: Final = 1800 * US_PER_S
"""Greatest offset of clocks that are set to the same time, if not well."""
FRAMES_PER_BIN: Final = 4
"""Frames of the sample in each interval of the common time, in which a copy is expected."""
MAX_PENDING: Final = 100_000
"""Maximum number of frames held to find copies; a file may give all its frames the same time."""
PIECE: Final = 4096
"""Records per batch, about 250 kB."""


class FrameSample:
    """A sample of a file's frames with their times, and the file's range of times."""

    def __init__(self) -> None:
        self.first_us: int | None = None
        self.last_us: int | None = None
        self.step = 1
        """The sample contains frames whose last two bytes are divisible by this."""
        self.frames: dict[bytes, int | None] = {}
        """Time of each frame; None if the frame occurs more than once."""

    def add(self, batch: Batch) -> None:
        """Add the next batch of the file."""
        if not len(batch):
            return
        least, greatest = int(batch.time_us.min()), int(batch.time_us.max())
        self.first_us = least if self.first_us is None else min(self.first_us, least)
        self.last_us = greatest if self.last_us is None else max(self.last_us, greatest)
        data = np.frombuffer(batch.data, np.uint8).astype(np.int64)
        ends = batch.starts + TIME_SIZE + batch.sizes
        keys = data[ends - 2] | data[ends - 1] << 8
        for record in batch.records(np.flatnonzero(keys % self.step == 0)):
            known = record.frame in self.frames
            self.frames[record.frame] = None if known else record.time_us
        while len(self.frames) > MAX_SAMPLE:
            self.step *= 2
            self.frames = {
                frame: time_us
                for frame, time_us in self.frames.items()
                if int.from_bytes(frame[-2:], "little") % self.step == 0
            }


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The offset between the clocks of two files."""

    offset_us: int
    """Offset to add to the times of the file, µs."""
    copies: int
    """Number of frames of the sample that are in both files."""
    share: float = 1.0
    """Share of the time that both files cover in which there are copies."""


def clock_offset(sample: FrameSample, reference: FrameSample) -> ClockOffset | None:
    """Estimate the offset of a file's clock; None if too few frames are copies."""
    both = [
        (there_us, there_us - here_us)
        for frame, here_us in sample.frames.items()
        if here_us is not None and (there_us := reference.frames.get(frame)) is not None
    ]
    if len(both) < LEAST_COPIES:
        return None
    times, differences = np.array(both)[np.argsort([each[1] for each in both])].T
    counts = np.searchsorted(differences, differences + WINDOW_US, "right")
    counts -= np.arange(len(differences))
    best = int(np.argmax(counts))
    count = int(counts[best])
    if count < LEAST_COPIES:
        return None
    offset_us = int(np.median(differences[best : best + count]))
    share = _share(times[best : best + count], offset_us, sample, reference)
    return ClockOffset(offset_us, count, share)


def _share(
    copied_us: IntArray, offset_us: int, sample: FrameSample, reference: FrameSample
) -> float:
    """Return the share of the common time with copies; both times are on the reference's clock."""
    begin_us = max((sample.first_us or 0) + offset_us, reference.first_us or 0)
    end_us = min((sample.last_us or 0) + offset_us, reference.last_us or 0)
    frames = min(
        sum(begin_us <= (time_us or 0) + shift_us <= end_us for time_us in one.frames.values())
        for one, shift_us in ((sample, offset_us), (reference, 0))
    )
    bins = max(min((end_us - begin_us) // US_PER_S, frames // FRAMES_PER_BIN), 1)
    found, _ = np.histogram(copied_us, bins, (begin_us, max(end_us, begin_us + 1)))
    return float(np.count_nonzero(found)) / bins


@dataclass(slots=True)
class Alignment:
    """The relation of the clocks of one flight's files."""

    is_one_flight: bool = False
    """Whether the user states that it is one flight, whatever the clocks."""
    faults: dict[int, str] = field(default_factory=dict)
    """Why a file with equal frames is not taken as a part of the same flight, by its number."""
    samples: list[FrameSample] = field(default_factory=list)
    offsets: list[ClockOffset | None] = field(default_factory=list)
    """Offset of each file to the first one; None if no frame is copied in another file."""

    def add(self, batches: Iterable[Batch]) -> None:
        """Add the next file."""
        sample = FrameSample()
        for batch in batches:
            sample.add(batch)
        found: list[ClockOffset] = []
        for earlier, known in zip(self.samples, self.offsets, strict=True):
            if (offset := clock_offset(sample, earlier)) is None:
                continue
            if fault := self._fault_of(offset):
                self.faults[len(self.samples)] = fault
                continue
            base_us = known.offset_us if known else 0
            found.append(replace(offset, offset_us=offset.offset_us + base_us))
        self.samples.append(sample)
        self.offsets.append(max(found, key=lambda each: each.copies, default=None))

    def _fault_of(self, offset: ClockOffset) -> str:
        if offset.share < FAIR_SHARE:
            equal = counted(offset.copies, "equal frame")
            return f"its {equal} are in {offset.share:.0%} of the time only"
        if self.is_one_flight or abs(offset.offset_us) <= MAX_OFFSET_US:
            return ""
        shift_s = offset.offset_us / US_PER_S
        return f"the clocks differ by {shift_s:+.0f} s; if it is one flight, give --merge"

    @property
    def shifts_us(self) -> list[int]:
        """Return the offset to add to the times of each file."""
        return [0 if offset is None else offset.offset_us for offset in self.offsets]

    @property
    def shifts_after_1970_us(self) -> list[int]:
        """Return the shifts, increased if one would move a file before the year 1970."""
        begins = zip(self.samples, self.shifts_us, strict=True)
        earliest_us = min((one.first_us or 0) + shift_us for one, shift_us in begins)
        return [shift_us - min(earliest_us, 0) for shift_us in self.shifts_us]

    def report_faults(self, sources: Sequence[TlogSource], remark: Remark) -> None:
        """Report the files that are taken for other flights."""
        for number, fault in self.faults.items():
            if self.offsets[number] is None:
                text = f"is taken for another flight, as {fault}; its times are kept"
                remark(f"{sources[number].path}: {text}")

    def report_offsets(self, sources: Sequence[TlogSource], remark: Remark) -> None:
        """Report the shift of each file after the first one."""
        for number, offset in enumerate(self.offsets[1:], 1):
            path = sources[number].path
            if offset is not None:
                remark(
                    f"{path}: shifted by {offset.offset_us / US_PER_S:+.3f} s to the clock "
                    f"of {sources[0].path}, by {counted(offset.copies, 'copied frame')}"
                )
            elif number not in self.faults:
                remark(f"{path}: has too few copies to compare clocks; times are kept")

    def order(self, shifts_us: Sequence[int]) -> list[int]:
        """Return the files' numbers by start time; files without records come last."""
        begins = [
            (sample.first_us is None, (sample.first_us or 0) + shift_us, number)
            for number, (sample, shift_us) in enumerate(zip(self.samples, shifts_us, strict=True))
        ]
        return [number for *_, number in sorted(begins)]

    def overlap_us(self, shifts_us: Sequence[int]) -> int:
        """Return the longest time that is covered by two files."""
        longest_us, end_us = 0, -(1 << 62)
        for number in self.order(shifts_us):
            sample, shift_us = self.samples[number], shifts_us[number]
            if sample.first_us is None or sample.last_us is None:
                continue
            last_us = sample.last_us + shift_us
            longest_us = max(longest_us, min(end_us, last_us) - sample.first_us - shift_us)
            end_us = max(end_us, last_us)
        return longest_us


class Copies:
    """Recognise frames that another file has contained already."""

    def __init__(self) -> None:
        self.count = 0
        """Copies found."""
        self._pending: dict[bytes, list[tuple[int, set[int]]]] = {}
        """Times of each frame, each with the files that contain the frame at that time."""
        self._order: deque[tuple[int, bytes]] = deque()

    def is_copy(self, time_us: int, file: int, frame: bytes) -> bool:
        """Process the next frame of a file, in the order of aligned times."""
        while self._order and (
            len(self._order) >= MAX_PENDING or time_us - self._order[0][0] > 2 * WINDOW_US
        ):
            _, oldest = self._order.popleft()
            del self._pending[oldest][0]
            if not self._pending[oldest]:
                del self._pending[oldest]
        entries = self._pending.setdefault(frame, [])
        for at_us, files in entries:
            if file not in files and abs(time_us - at_us) <= WINDOW_US:
                files.add(file)
                self.count += 1
                return True
        entries.append((time_us, {file}))
        self._order.append((time_us, frame))
        return False


def intact(
    source: TlogSource, remark: Remark, progress: Progress | None = None, *, strict: bool = False
) -> Iterator[Batch]:
    """Yield the records of a file, and report the bytes that belong to no record."""
    runs = size = end = 0
    for batch in source.batches(progress, strict=strict):
        for damage in batch.damage:
            # A run may continue in the next batch.
            runs += damage.offset != end or not runs
            end = damage.offset + damage.size
            size += damage.size
        runs += batch.unfinished > 0
        size += batch.unfinished
        yield batch
    if size:
        remark(
            f"{source.path}: left out {counted(size, 'byte')} in {counted(runs, 'place')}, "
            "which contain no record"
        )


def joined(
    sources: Sequence[TlogSource],
    read: Callable[[TlogSource], Iterator[Batch]],
    merge: bool | None,
    remark: Remark,
) -> Iterator[Batch]:
    """Yield the records of all files in order of time; a merge leaves out copies.

    By default files are merged if they overlap. `read` returns the records of a file.
    """
    if len(sources) == 1:
        yield from read(sources[0])
        return
    alignment = Alignment(is_one_flight=bool(merge))
    for source in sources:
        alignment.add(source.batches())
    if merge is not False:
        alignment.report_faults(sources, remark)
    if merge is None:
        is_joined = alignment.faults and not any(alignment.offsets)
        merge = not is_joined and alignment.overlap_us(alignment.shifts_us) > WINDOW_US
    shifts_us = alignment.shifts_after_1970_us if merge else [0] * len(sources)
    if alignment.overlap_us(shifts_us) <= 0:
        for number in alignment.order(shifts_us):
            yield from read(sources[number])
        return
    copies = Copies() if merge else None
    yield from batched(by_time([*map(read, sources)], shifts_us, copies))
    if copies is not None:
        alignment.report_offsets(sources, remark)
        remark(f"left out {counted(copies.count, 'copied frame')}")


def by_time(
    files: Sequence[Iterable[Batch]], shifts_us: Sequence[int], copies: Copies | None = None
) -> Iterator[RecordedFrame]:
    """Yield the records of all files in order of shifted time; `copies` removes copies."""

    def shifted(number: int) -> Iterator[tuple[int, int, bytes]]:
        for batch in files[number]:
            for record in batch.records():
                yield record.time_us + shifts_us[number], number, record.frame

    streams = [shifted(number) for number in range(len(files))]
    for time_us, number, frame in heapq.merge(*streams, key=itemgetter(0)):
        if copies is None or not copies.is_copy(time_us, number, frame):
            yield RecordedFrame(time_us, frame)


def batched(records: Iterable[RecordedFrame]) -> Iterator[Batch]:
    """Put records into batches."""
    encoded = (encode_record(record.time_us, record.frame) for record in records)
    return TlogScanner().feed_all(iter(lambda: b"".join(islice(encoded, PIECE)), b""))
