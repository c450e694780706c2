"""Open recordings for the player, with the times and ids of their vehicles."""

import logging
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from gateway.answers.log_answers import LogAnswers
from gateway.recordings.file_format import NO_RECORDING
from gateway.recordings.files import (
    MAX_UNPACKED,
    FlightError,
    Progress,
    is_packed,
    open_descriptor,
    temporary_copy,
)
from gateway.recordings.index import parts_together
from gateway.recordings.play import Source, Track
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recordings
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.recordings.tlog_index import TlogIndex
from gateway.recordings.tlog_source import Layout, open_tlog
from gateway.recordings.workshop.convert import FlightToWrite, Fusing
from gateway.vehicle_state.senders import FIRST_GROUND_STATION
from gateway.wire.recorded_frames import RecordedFrame

log = logging.getLogger(__name__)

READ_SIZE: Final = 1 << 20
PIECE: Final = 8
"""Frames generated per step, which takes one or two milliseconds."""


class TlogFile(Source):
    """A tlog on disk: its index, and random access.

    It is read, not memory-mapped: if a file shrinks, or a USB stick is pulled out, a process that
    has mapped it is killed.
    """

    def __init__(
        self,
        path: Path,
        progress: Progress | None = None,
        answers: LogAnswers | None = None,
        unpacked_limit: int = MAX_UNPACKED,
    ) -> None:
        self.path = path
        source = open_tlog(path)
        if source.layout is Layout.TLOG and not is_packed(path):
            self._file = open_descriptor(path)
        else:
            # Only an uncompressed tlog allows random access.
            with temporary_copy(path, source.chunks(None, unpacked_limit)) as copy:
                self._file = os.dup(copy.fileno())
        self.index = TlogIndex(source.timeline)
        self._size = sys.maxsize
        for batch in map(source.timeline.apply, TlogScanner().feed_all(self._all(progress))):
            self.index.add(batch)
            if answers is not None:
                answers.add(batch, self.index.senders)
        self.remarks = [*source.remarks, *self.index.remarks]
        """Remarks for the user on its times and its damage."""

    def _all(self, progress: Progress | None) -> Iterator[bytes]:
        """Read the whole file; records written later are not indexed, and not played."""
        offset = 0
        while data := self.read(offset, READ_SIZE):
            yield data
            offset += len(data)
            if progress is not None:
                progress(len(data))
        self._size = offset

    def read(self, offset: int, size: int) -> bytes:
        """Read up to `size` bytes; see `Source`."""
        try:
            return os.pread(self._file, max(0, min(size, self._size - offset)), offset)
        except OSError:
            return b""

    def close(self) -> None:
        """Close the file, which ends its tracks."""
        os.close(self._file)


class FusedTlog(Source):
    """Frames that are generated on demand, and stored on disk for seeking back."""

    def __init__(
        self,
        frames: Iterator[RecordedFrame],
        last_us: int | None = None,
        answers: LogAnswers | None = None,
    ) -> None:
        self._frames = frames
        self._last_us = last_us
        self._answers = answers
        self._file = tempfile.TemporaryFile(prefix="mavgate-play-")  # noqa: SIM115
        self._scanner = TlogScanner()
        self._size = 0
        self._ended = False
        self.index = TlogIndex()
        """Index of the frames generated so far."""
        while not self.index.count and self._make():
            pass

    @property
    def last_us(self) -> int:
        """Time of the end, or of the last frame generated so far, whichever is later."""
        return max(self._last_us or 0, super().last_us)

    def read(self, offset: int, size: int) -> bytes:
        """Read up to `size` bytes; frames that do not exist yet are generated."""
        while offset >= self._size and self._make():
            pass
        return os.pread(self._file.fileno(), size, offset)

    def prepare(self, until_us: int) -> bool:
        """Generate a few of the frames up to a time; see `Source`."""
        return (self.index.last_us or 0) >= until_us or not self._make()

    def close(self) -> None:
        """Delete the generated frames."""
        with suppress(OSError):
            # Closing repeats the write that failed on a full disk.
            self._file.close()

    def _make(self) -> bool:
        """Generate some frames; return whether there were any left."""
        if self._ended:
            return False
        made = b"".join(encode_record(r.time_us, r.frame) for r in islice(self._frames, PIECE))
        self._ended = not made
        try:
            self._file.write(made)
            self._file.flush()
        except OSError as error:
            log.warning("The rest cannot be played: %s: %s", tempfile.gettempdir(), error.strerror)
            self._ended = True
        batch = self._scanner.feed(made, final=self._ended)
        self.index.add(batch)
        if self._answers is not None:
            self._answers.add(batch, self.index.senders)
        self._size += len(made)
        return not self._ended


@dataclass(slots=True)
class OpenFlight:
    """One open recording of one or several parts."""

    sources: list[Source] = field(default_factory=list)
    answers: LogAnswers = field(default_factory=LogAnswers)
    remarks: list[str] = field(default_factory=list)
    """Remarks for the user."""

    @property
    def first_us(self) -> int:
        """Civil time of its start."""
        return min(source.index.first_us or 0 for source in self.sources)

    @property
    def last_us(self) -> int:
        """Civil time of its end, as far as it is known."""
        return max(source.last_us for source in self.sources)

    @property
    def vehicles(self) -> list[int]:
        """System ids of all senders except ground stations."""
        systems = (source.index.senders.systems() for source in self.sources)
        return sorted(set().union(*systems))


@dataclass(frozen=True, slots=True)
class PlayedFlight:
    """A recording in playback, with its shift in time and its system ids."""

    tracks: tuple[Track, ...]
    answers: LogAnswers
    shift_us: int
    """Shift from the recording's time to the player's."""
    system_ids: dict[int, int]
    """Played system id of each recorded vehicle."""


def open_flights(
    files: Sequence[Path],
    options: ReadOptions,
    opened: ExitStack,
    *,
    fuse: bool = False,
    both: bool = False,
) -> list[OpenFlight]:
    """Index the tlogs, and begin to read or fuse other files; parts of a recording together.

    For an autopilot's own log, its own estimates are played; with `fuse`, those of mavgate; with
    `both`, its own and those of mavgate.

    Raises FlightError if a file contains nothing to play; OSError if a file cannot be read.
    """
    flights = []
    for parts in parts_together(files):
        flight, recordings = OpenFlight(), open_recordings(parts)
        if recordings[0].is_mavlink:
            for file in parts:
                tlog = TlogFile(file, options.progress, flight.answers, options.unpacked_limit)
                opened.callback(tlog.close)
                flight.sources.append(tlog)
                flight.remarks += [f"{file}: {remark}" for remark in tlog.remarks]
        else:
            made = FlightToWrite(recordings, options, fusing=Fusing(wanted=fuse, both=both))
            for one in made.estimates():
                for frame in one.introduction():
                    flight.answers.add_frame(frame, 0)
                end_us = recordings[-1].end_us(options)
                fused = FusedTlog(one.frames(), end_us, flight.answers)
                opened.callback(fused.close)
                flight.sources.append(fused)
                flight.remarks += one.remarks
        for source, file in zip(flight.sources, parts, strict=False):
            if not source.index.count:
                raise FlightError(f"{file}: {NO_RECORDING}")
        flights.append(flight)
    return flights


def lay_out(
    flights: Sequence[OpenFlight], wanted_ids: Sequence[int] = (), *, with_commands: bool
) -> list[PlayedFlight]:
    """Assign each vehicle its own system id; start recordings of different days together."""
    begin_us, end_us = flights[0].first_us, flights[0].last_us
    used: set[int] = set()
    played = []
    for number, flight in enumerate(flights):
        together = flight.first_us <= end_us and begin_us <= flight.last_us
        shift_us = 0 if together else begin_us - flight.first_us
        system_ids: dict[int, int] = {}
        for index, system_id in enumerate(flight.vehicles):
            wanted = wanted_ids[number] + index if number < len(wanted_ids) else system_id
            while wanted in used or wanted >= FIRST_GROUND_STATION:
                wanted = wanted % (FIRST_GROUND_STATION - 1) + 1
            used.add(wanted)
            system_ids[system_id] = wanted
        changed = {old: new for old, new in system_ids.items() if old != new}
        tracks = tuple(
            Track(source, shift_us=shift_us, system_ids=changed, with_commands=with_commands)
            for source in flight.sources
        )
        played.append(PlayedFlight(tracks, flight.answers, shift_us, system_ids))
    return played
