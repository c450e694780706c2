"""Create tlogs from tlogs: joined or merged, cut, filtered, and edited frame by frame.

Each step processes the batches of the previous one, so the memory needed does not depend on the
size of the files. Parts that are not edited are copied byte for byte.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gateway.recordings.files import FlightError, Progress, TlogSource
from gateway.recordings.tlog import encode_record
from gateway.recordings.workshop.editing import FrameEdit
from gateway.recordings.workshop.merging import WINDOW_US, Alignment, Copies, batched, by_time
from gateway.recordings.workshop.selection import (
    ChosenState,
    FrameChoice,
    StateChoice,
    while_in_state,
    within,
)
from gateway.recordings.workshop.trimming import NOTHING_WITHIN, Limits
from gateway.units import US_PER_S, counted
from gateway.vehicle_state.senders import Senders
from gateway.wire.recorded_frames import Batch

NOTHING_LEFT: Final = "no record matches all of these options"


@dataclass(frozen=True, slots=True)
class TlogEdits:
    """The edits between the files that are read and the tlog that is written."""

    limits: Limits = (None, None)
    choice: FrameChoice = field(default_factory=FrameChoice)
    state: StateChoice | None = None
    """If given, keep only the time while a vehicle is in a state."""
    merge: bool | None = None
    """Leave out copies of frames that are in several files; default: if the files overlap."""
    frames: tuple[FrameEdit, ...] = ()
    """Edits of each frame, in their order."""

    @property
    def are_none(self) -> bool:
        """Whether the records are not edited, but perhaps cut."""
        return self == TlogEdits(self.limits, merge=self.merge)


class TlogEditor:
    """Apply edits to the records of some files; remarks are complete at the end."""

    def __init__(self, edits: TlogEdits, remark: Callable[[str], None]) -> None:
        self._edits, self._remark = edits, remark

    def joined(
        self, sources: Sequence[TlogSource], progress: Progress | None = None
    ) -> Iterator[Batch]:
        """Yield the records of all files in order of time; a merge leaves out copies."""
        if len(sources) == 1:
            yield from self._intact(sources[0], progress)
            return
        merge = self._edits.merge
        alignment = Alignment(is_one_flight=bool(merge))
        for source in sources:
            alignment.add(source.batches())
        if merge is None:
            is_joined = alignment.faults and not any(alignment.offsets)
            merge = not is_joined and alignment.overlap_us(alignment.shifts_us) > WINDOW_US
        if self._edits.merge is not False:
            for number, fault in alignment.faults.items():
                if alignment.offsets[number] is None:
                    text = f"is taken for another flight, as {fault}; its times are kept"
                    self._remark(f"{sources[number].path}: {text}")
        shifts_us = _after_1970(alignment) if merge else [0] * len(sources)
        ordered = [sources[number] for number in alignment.order(shifts_us)]
        if alignment.overlap_us(shifts_us) <= 0:
            for source in ordered:
                yield from self._intact(source, progress)
            return
        copies = Copies() if merge else None
        files = [self._intact(source, progress) for source in sources]
        yield from batched(by_time(files, shifts_us, copies))
        if copies is not None:
            self._remark_merge(sources, alignment, copies)

    def apply(self, batches: Iterable[Batch], senders: Senders) -> Iterator[bytes]:
        """Yield the bytes of the new tlog; raises FlightError if no record is left."""
        total = 0
        for batch in self.chosen(batches, senders):
            total += len(batch)
            yield self._edited(batch)
        if total == self._left_out():
            raise FlightError(NOTHING_LEFT)

    def chosen(
        self, batches: Iterable[Batch], senders: Senders, counted_id: int | None = None
    ) -> Iterator[Batch]:
        """Yield the selected records, not edited; raises FlightError if no record is left.

        The remark on their number counts those of one message if it is given.
        """
        edits, total, kept, of_message = self._edits, 0, 0, 0

        def all_records() -> Iterator[Batch]:
            nonlocal total
            for batch in batches:
                total += len(batch)
                yield batch

        cut: Iterable[Batch] = within(all_records(), edits.limits)
        state = None
        if edits.state is not None:
            state = ChosenState(senders, edits.state, edits.choice.systems)
            cut = while_in_state(cut, state)
        for batch in map(edits.choice.apply, cut):
            kept += len(batch)
            of_message += int(np.count_nonzero(batch.message_ids == counted_id))
            yield batch
        unknown = "" if state is None else state.unknown
        if not kept:
            if unknown:
                raise FlightError(unknown)
            is_cut = edits.limits != (None, None) and edits.are_none
            raise FlightError(NOTHING_WITHIN if is_cut else NOTHING_LEFT)
        if unknown:
            self._remark(unknown)
        if not edits.are_none:
            kept = kept - self._left_out() if counted_id is None else of_message
            self._remark(f"kept {kept} of {counted(total, 'record')}")

    def _left_out(self) -> int:
        return sum(edit.left_out.total() for edit in self._edits.frames)

    def _edited(self, batch: Batch) -> bytes:
        edits = self._edits.frames
        affected = [edit.affects(batch) for edit in edits]
        for edit in edits:
            batch = edit.retimed(batch)
        if not len(batch) or not np.any(affected):
            return batch.encoded()
        pieces = []
        is_affected = np.any(affected, axis=0).tolist()
        for record, may_change in zip(batch.records(), is_affected, strict=True):
            frame: bytes | None = record.frame
            for edit in edits if may_change else ():
                frame = None if frame is None else edit.edit(frame)
            if frame is not None:
                pieces.append(encode_record(record.time_us, frame))
        return b"".join(pieces)

    def _intact(self, source: TlogSource, progress: Progress | None) -> Iterator[Batch]:
        """Yield the records of a file, and report the bytes that belong to no record."""
        runs = size = end = 0
        # An edit computes the checksum again, so that damaged frames would look intact.
        for batch in source.batches(progress, strict=bool(self._edits.frames)):
            for damage in batch.damage:
                # A run may continue in the next batch.
                runs += damage.offset != end or not runs
                end = damage.offset + damage.size
                size += damage.size
            runs += batch.unfinished > 0
            size += batch.unfinished
            yield batch
        if size:
            self._remark(
                f"{source.path}: left out {counted(size, 'byte')} in {counted(runs, 'place')}, "
                "which contain no record"
            )

    def _remark_merge(
        self, sources: Sequence[TlogSource], alignment: Alignment, copies: Copies
    ) -> None:
        for number, offset in enumerate(alignment.offsets[1:], 1):
            source = sources[number]
            if offset is None and number in alignment.faults:
                continue
            if offset is None:
                self._remark(f"{source.path}: has too few copies to compare clocks; times are kept")
            else:
                self._remark(
                    f"{source.path}: shifted by {offset.offset_us / US_PER_S:+.3f} s to the clock "
                    f"of {sources[0].path}, by {counted(offset.copies, 'copied frame')}"
                )
        self._remark(f"left out {counted(copies.count, 'copied frame')}")


def _after_1970(alignment: Alignment) -> list[int]:
    """Return the shifts of a merge, increased if one would move a file before the year 1970."""
    shifts_us = alignment.shifts_us
    begins = zip(alignment.samples, shifts_us, strict=True)
    earliest_us = min((one.first_us or 0) + shift_us for one, shift_us in begins)
    return [shift_us - min(earliest_us, 0) for shift_us in shifts_us]
