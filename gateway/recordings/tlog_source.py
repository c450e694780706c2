"""Read any recorded MAVLink as a tlog.

| layout | bytes before each frame           | times                                   |
| ------ | --------------------------------- | --------------------------------------- |
| tlog   | 8: the time                       | as recorded, without jumps of the clock |
| padded | 16: the time and eight zeros      | as for tlog                             |
| bare   | 0: a capture of a link            | from the messages, see `FrameClock`     |
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Final

from gateway.recordings.file_format import first_bytes
from gateway.recordings.files import Progress, read_chunks
from gateway.recordings.recorded_clock import DAY_S, LINE_BPS, FrameClock, Timeline
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.units import US_PER_S, counted
from gateway.vehicle_state.senders import Senders
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.framing import Fault
from gateway.wire.mavlink_splitter import MavlinkSplitter
from gateway.wire.recorded_frames import Batch

PIECE: Final = 1 << 12
SHOWN_JUMPS: Final = 3


class Layout(IntEnum):
    """Number of bytes before each frame."""

    BARE = 0
    TLOG = TIME_SIZE
    PADDED = 2 * TIME_SIZE


@dataclass(frozen=True, slots=True)
class TlogSource:
    """A file of recorded MAVLink with its recognised layout and its clock."""

    path: Path
    layout: Layout
    timeline: Timeline
    senders: Senders
    remarks: tuple[str, ...] = ()
    """Remarks for the user on its times."""
    civil_us_at_zero: int = 0
    by_size: bool = False
    """Whether frames of a capture without times are spaced by their transmission time."""

    def chunks(self, progress: Progress | None = None, limit: int | None = None) -> Iterator[bytes]:
        """Read the file as the bytes of a tlog; see `read_chunks`."""
        data = read_chunks(self.path, progress, limit)
        if self.layout is Layout.TLOG:
            return data
        if self.layout is Layout.PADDED:
            return _stamped(data)
        return self._timed(data)

    def batches(self, progress: Progress | None = None, *, strict: bool = False) -> Iterator[Batch]:
        """Read the file batch by batch, at corrected times; see `TlogScanner`."""
        scanner = TlogScanner(strict=strict)
        return map(self.timeline.apply, scanner.feed_all(self.chunks(progress)))

    def _timed(self, data: Iterator[bytes]) -> Iterator[bytes]:
        clock = FrameClock(by_size=self.by_size)
        for pieces in _frames(data):
            yield b"".join(
                encode_record(self.civil_us_at_zero + clock.time_us(frame), frame)
                for *_, frame in pieces
            )


def open_tlog(path: Path) -> TlogSource:
    """Recognise the layout of a file, and read all its times once; raises OSError."""
    layout = file_layout(first_bytes(path))
    if layout is Layout.BARE:
        return _open_bare(path)
    timeline, senders = Timeline(), Senders()
    for batch in TlogSource(path, layout, Timeline(), senders).batches():
        timeline.add(batch)
        senders.add(batch)
    padded = ("has eight extra zero bytes in each record; left out",)
    remarks = padded if layout is Layout.PADDED else ()
    return TlogSource(path, layout, timeline, senders, (*remarks, *_jumps_in_words(timeline)))


def file_layout(head: bytes) -> Layout:
    """Recognise the layout by the bytes between the first frames; a tlog if that is ambiguous."""
    gaps: Counter[int] = Counter()
    splitter, gap, met = MavlinkSplitter(), 0, False
    # In pieces, which bounds the work for bytes with many false starts of frames.
    for begin in range(0, len(head), PIECE):
        for event in splitter.feed(head[begin : begin + PIECE]):
            if isinstance(event, Fault):
                gap += event.size
            else:
                gaps[gap] += met
                gap, met = 0, True
    return max((Layout.TLOG, Layout.PADDED, Layout.BARE), key=lambda layout: gaps[int(layout)])


def _open_bare(path: Path) -> TlogSource:
    clock, left_out = FrameClock(), 0
    for pieces in _frames(read_chunks(path)):
        for size, _, frame in pieces:
            left_out += size
            clock.time_us(frame)
    how = "its times are those in its messages"
    if not clock.is_timed:
        how = f"no message contains a time, so frames are spaced as on a link of {LINE_BPS} baud"
    remarks = [f"is a capture without time stamps; {how}"]
    if left_out:
        remarks.append(f"left out {counted(left_out, 'byte')} between frames")
    zero_us = clock.civil_us_at_zero or 0
    source = TlogSource(
        path, Layout.BARE, Timeline(), Senders(), tuple(remarks), zero_us,
        by_size=not clock.is_timed,
    )  # fmt: skip
    for batch in source.batches():
        source.senders.add(batch)
    return source


def _frames(data: Iterator[bytes]) -> Iterator[list[tuple[int, bytes, bytes]]]:
    """Yield the frames of each chunk, each with the number and the last of the skipped bytes."""
    splitter, rest, lead, left_out = MavlinkSplitter(), b"", b"", 0
    for chunk in data:
        for begin in range(0, len(chunk), PIECE):
            piece = chunk[begin : begin + PIECE]
            rest, at = rest + piece, 0
            found: list[tuple[int, bytes, bytes]] = []
            for event in splitter.feed(piece):
                size = event.size if isinstance(event, Fault) else len(event.data)
                if isinstance(event, Fault):
                    left_out += size
                    lead = (lead + rest[at : at + size])[-2 * TIME_SIZE :]
                else:
                    found.append((left_out, lead, event.data))
                    lead, left_out = b"", 0
                at += size
            rest = rest[at:]
            yield found


def _stamped(data: Iterator[bytes]) -> Iterator[bytes]:
    """Remove the eight zeros of each record, which are before or after its time."""
    for pieces in _frames(data):
        records = []
        for _, lead, frame in pieces:
            first, second = lead[-2 * TIME_SIZE : -TIME_SIZE], lead[-TIME_SIZE:]
            time = second if not any(first) else first
            records.append(time.rjust(TIME_SIZE, b"\0") + frame)
        yield b"".join(records)


def _jumps_in_words(timeline: Timeline) -> Iterator[str]:
    for jump in timeline.jumps[:SHOWN_JUMPS]:
        step_s = jump.step_us / US_PER_S
        days = abs(step_s) / DAY_S
        size = f"{days:.1f} days" if days >= 1 else f"{abs(step_s):.0f} s"
        direction = "forward" if step_s > 0 else "back"
        yield (
            f"its clock jumped {direction} by {size} at {jump.offset_us / US_PER_S:.1f} s; "
            "its times continue without the jump"
        )
    if (more := len(timeline.jumps) - SHOWN_JUMPS) > 0:
        yield f"and {counted(more, 'more jump')} of its clock"
