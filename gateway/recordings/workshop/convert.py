"""Write flights as files: one writer per format, chosen by the suffix of the file's name."""

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from io import RawIOBase
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any, Final
from weakref import finalize

from pymavlink.dialects.v20 import all as mavlink

from gateway.answers.log_answers import LogAnswers
from gateway.recordings.autopilot_record import AutopilotLog, RecordTranslator
from gateway.recordings.file_format import NO_RECORDING, TABLE, import_format
from gateway.recordings.files import FlightError
from gateway.recordings.formats import message_csv
from gateway.recordings.formats.maps import (
    DRAWN_IDS,
    VehicleTrack,
    to_geojson,
    to_gpx,
    to_kml,
    tracks_of_messages,
    tracks_of_table,
)
from gateway.recordings.reading import check_vehicle
from gateway.recordings.recorded_clock import Stamper
from gateway.recordings.recorded_fusion import RecordedFusion
from gateway.recordings.recorded_table import ReadOptions, RecordedTable, aircraft_of
from gateway.recordings.recording import RecordedFile, estimates_of
from gateway.recordings.table import encode_block, encode_head
from gateway.recordings.tlog import encode_record
from gateway.recordings.tlog_source import TlogSource, open_tlog
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.recordings.workshop.editing import NOTHING_LEFT, TlogEdits
from gateway.recordings.workshop.extracts import RecordedPlan
from gateway.recordings.workshop.joining import joined_rows, trimmed
from gateway.recordings.workshop.merging import batched, intact, joined
from gateway.vehicle_state.senders import Senders
from gateway.wire.recorded_frames import Batch, RecordedFrame

NO_EDITS: Final = TlogEdits()
NO_AUTOPILOT: Final = mavlink.MAV_AUTOPILOT_INVALID
NOT_FUSED: Final = "raw samples, settings and the exact digits of states"
NOT_IN_TABLE: Final = "all except samples, fixes and states of one vehicle"
NOT_DRAWN: Final = (
    "samples, velocities and settings",
    "all MAVLink messages except positions, attitude and texts",
)


@dataclass(frozen=True, slots=True)
class Fusing:
    """Whether and how the estimator is run again on a flight."""

    wanted: bool = False
    both: bool = False
    """Keep the estimates of the autopilot, too."""
    smooth: bool = False
    estimator: str | None = None
    """Instead of that of the settings, as the latency."""
    latency_s: float | None = None


AS_RECORDED: Final = Fusing()


class FlightToWrite:
    """Recordings that are written as one file: as MAVLink or as rows, depending on the format.

    MAVLink is made of tables and of autopilots' logs in a temporary file, since its senders must be
    known before its frames are used. Raises OSError if a file cannot be read.
    """

    plan: RecordedPlan
    """Parameters and plans of the vehicle in the records that `answered` has yielded."""
    first_us = 0
    """Time of the first of these records."""

    def __init__(
        self,
        recordings: Sequence[RecordedFile],
        options: ReadOptions,
        edits: TlogEdits = NO_EDITS,
        fusing: Fusing = AS_RECORDED,
        *,
        title: str = "flight",
    ) -> None:
        self.recordings = recordings
        self.options, self.title = options, title
        self._edits, self._fusing = edits, fusing
        if any(one.kind != recordings[0].kind for one in recordings):
            each = ", ".join(f"{one.path}: {one.kind}" for one in recordings)
            raise FlightError(f"the files differ in format; give files of one format ({each})")
        self.is_mavlink = recordings[0].is_mavlink
        """Whether the files contain MAVLink; the rows are then derived from it."""
        self._estimates = estimates_of(recordings, fuse=fusing.wanted, both=fusing.both)
        self.has_messages = self.is_mavlink or self._estimates != "fused"
        """Whether the files contain messages of vehicles, in MAVLink or an autopilot's log."""
        self._as_recorded = not fusing.wanted and recordings[0].is_own
        self.fusions: list[RecordedFusion] = []
        """The fusions made to write the file."""
        self._tables: list[RecordedTable] = []
        self.logs: list[AutopilotLog] = []
        """The logs of autopilots among the files, once they are read."""
        self._remarks: list[str] = []
        if recordings[0].kind == TABLE and options.system_id is not None:
            by_vehicle = self._by_vehicle()
            check_vehicle(self.files, options.system_id, by_vehicle)
            self.recordings = by_vehicle[options.system_id]

    @property
    def files(self) -> list[Path]:
        """The files that are read."""
        return [recording.path for recording in self.recordings]

    @property
    def message_id(self) -> int | None:
        """The message of which a format with one type of message is written; None for the rows."""
        return next(iter(self._edits.choice.messages), None)

    @cached_property
    def senders(self) -> Senders:
        """Senders of the MAVLink."""
        found = Senders()
        for source in self._sources:
            found.merge(source.senders)
        return found

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield the selected MAVLink: as recorded, or as the gateway would send it."""
        return (record for batch in self.chosen() for record in batch.records())

    def tlog(self) -> Iterator[bytes]:
        """Yield the selected MAVLink as a tlog, with the edits applied."""
        edits, total = self._edits, 0
        sources = self._sources if self.is_mavlink else []
        for edit in edits.frames:
            edit.prepare(sources, edits.choice)
        batches = self._recorded() if self.is_mavlink else batched(self._sent())
        senders = self.senders if self.is_mavlink else Senders()
        for batch in edits.chosen(batches, senders, self.remark):
            total += len(batch)
            yield edits.edited(batch)
        if total == edits.left_out:
            raise FlightError(NOTHING_LEFT)

    def chosen(self, counted_id: int | None = None) -> Iterator[Batch]:
        """Yield the selected MAVLink, of all messages, not edited.

        The remark on the number of kept records counts those of one message if it is given.
        """
        choice = replace(self._edits.choice, messages=frozenset())
        edits = replace(self._edits, choice=choice)
        return edits.chosen(self._recorded(), self.senders, self.remark, counted_id)

    def _recorded(self) -> Iterator[Batch]:
        progress = self.options.progress if self.is_mavlink else None
        # An edit computes the checksum again, so that damaged frames would look intact.
        strict = bool(self._edits.frames)
        read = partial(intact, remark=self.remark, progress=progress, strict=strict)
        return joined(self._sources, read, self._edits.merge, self.remark)

    @cached_property
    def _sources(self) -> list[TlogSource]:
        """The files opened as MAVLink, once."""
        if not self.is_mavlink:
            folder = Path(mkdtemp(prefix="mavgate-"))
            finalize(self, rmtree, folder, ignore_errors=True)
            with (folder / "made.tlog").open("wb") as file:
                file.writelines(encode_record(one.time_us, one.frame) for one in self._sent())
            return [open_tlog(folder / "made.tlog")]
        sources = [recording.mavlink for recording in self.recordings]
        for source in sources:
            # A part that had just been created when the power failed may be empty.
            if not source.senders.origins and ".tlog" not in source.path.suffixes:
                raise FlightError(f"{source.path}: {NO_RECORDING}")
            self._remarks += [f"{source.path}: {text}" for text in source.remarks]
        systems = {origin >> 8 for source in sources for origin in source.senders.origins}
        if not systems:
            raise FlightError(f"{', '.join(map(str, self.files))}: {NO_RECORDING}")
        # A tlog may also contain only the frames of a ground station.
        if self.options.system_id not in systems:
            vehicles = {one for source in sources for one in source.senders.systems()}
            check_vehicle(self.files, self.options.system_id, sorted(vehicles))
        return sources

    @cached_property
    def vehicle_id(self) -> int:
        """The vehicle that `options` select, or the only one with an autopilot.

        Raises FlightError if there is none, or several to choose from.
        """
        path = self.recordings[0].path
        if not self.has_messages:
            raise FlightError(f"{path}: is neither MAVLink nor the log of an autopilot")
        systems = self.senders.systems()
        if self.is_mavlink and self.options.system_id is not None:
            return self.options.system_id
        beats = {one: self.senders.vehicle(one).heartbeat for one in systems}
        found = [one for one, beat in beats.items() if beat and beat[1] != NO_AUTOPILOT] or systems
        if not found:
            raise FlightError(f"{path}: contains no vehicle")
        if len(found) > 1:
            listed = ", ".join(map(str, found))
            raise FlightError(f"{path}: several vehicles; choose one with --system: {listed}")
        return found[0]

    def answered(self) -> Iterator[Batch]:
        """Yield the records as `chosen`, and set `plan` and `first_us`."""
        vehicle_id, answers, is_first = self.vehicle_id, LogAnswers(), True
        self.plan = RecordedPlan(answers, self.senders.vehicle(vehicle_id))
        for batch in self.chosen():
            if len(batch) and is_first:
                self.first_us, is_first = int(batch.time_us[0]), False
            answers.add(batch, self.senders)
            yield batch

    def messages_of_vehicle(self, wanted: Iterable[int]) -> Iterator[VehicleMessage]:
        """Yield positions, texts and wanted messages of the vehicle, by `answered`."""
        vehicle_id = self.vehicle_id  # first, as the senders of a table are those of its fusion
        reader = VehicleReader(self.senders, wanted, vehicle_id, with_attitude=False)
        return reader.messages(self.answered())

    def vehicle_messages(
        self, wanted: Iterable[int] = (), system_id: int | None = None
    ) -> Iterator[VehicleMessage]:
        """Yield the vehicles' positions, attitudes and texts, and other messages given by id."""
        return VehicleReader(self.senders, wanted, system_id).messages(self.chosen())

    def table(self) -> RecordedTable:
        """Return the rows: as recorded, or fused again from the start and then cut."""
        if self._as_recorded:
            table = joined_rows(self.recordings, self.options)
            self._tables.append(table)
        else:
            table = self.fused().table()
        return trimmed(table, self._edits.limits)

    def by_aircraft(self) -> "list[FlightToWrite]":
        """Split tables by aircraft."""
        if len(self.recordings) == 1:
            return [self]
        parts = []
        for _, recordings in sorted(self._by_vehicle().items()):
            part = copy(self)
            part.recordings = recordings
            parts.append(part)
        return parts

    def _by_vehicle(self) -> dict[int, list[RecordedFile]]:
        found: dict[int, list[RecordedFile]] = {}
        quiet = replace(self.options, progress=None)
        for recording in self.recordings:
            found.setdefault(recording.rows(quiet).header.vehicle_id, []).append(recording)
        return found

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user; complete once all is written."""
        read: list[AutopilotLog | RecordedTable] = [*self.logs, *self._tables]
        found = [*read, *self.fusions]
        return [*self._remarks, *(remark for source in found for remark in source.remarks)]

    @property
    def defaults(self) -> dict[str, float]:
        """Default values of parameters, stated by the logs of autopilots, by name."""
        return {name: value for log in self.logs for name, value in log.defaults.items()}

    def lacks(self, ending: str) -> str:
        """Describe the content that a format cannot hold, once all is written; empty if none."""
        if ending == ".tlog" and self.logs:
            return "; ".join(filter(None, (log.lacks for log in self.logs)))
        if ending != ".tlog" and self.message_id is not None:
            return ""
        lacks = LACKS[ending]
        return lacks.of_tlogs if self.has_messages else lacks.of_tables

    def remark(self, text: str) -> None:
        """Add a remark for the user."""
        self._remarks.append(text)

    def fused(self) -> RecordedFusion:
        """Fuse these files again."""
        how = self._fusing
        fusion = RecordedFusion(
            self.recordings, self.options,
            smooth=how.smooth, estimator=how.estimator, latency_s=how.latency_s,
        )  # fmt: skip
        self.fusions.append(fusion)
        return fusion

    def estimates(self) -> Iterator[RecordTranslator | RecordedFusion]:
        """Open the sources of the MAVLink that is made of the files.

        For logs of autopilots these are their own estimates, those of mavgate, or both.
        """
        if self._estimates != "fused":
            for recording in self.recordings:
                self.logs.append(recording.log(self.options))
                yield RecordTranslator(self.logs[-1])
        if self._estimates == "both":
            second = self.logs[0].beside_id
            self.options = replace(self.options, system_id=second, progress=None)
        if self._estimates != "own":
            for part in self.by_aircraft():
                yield part.fused()

    def _sent(self) -> Iterator[RecordedFrame]:
        """Yield the frames that the gateway would send for all aircraft, in order of time."""
        streams, stamper = [one.frames() for one in self.estimates()], Stamper(0)
        for record in heapq.merge(*streams, key=lambda record: record.time_us):
            yield RecordedFrame(stamper.stamp(record.time_us), record.frame)


Write = Callable[[FlightToWrite], Iterable[bytes]]

WRITERS: Final[dict[str, Write]] = {}
"""Writers by file suffix."""


@dataclass(frozen=True, slots=True)
class Lacks:
    """Text on the content that a format cannot hold."""

    of_tables: str = ""
    of_tlogs: str = ""


LACKS: Final[dict[str, Lacks]] = {}
"""Content that a format cannot hold, by file suffix."""


def add_writer(ending: str, write: Write, lacks: Lacks = Lacks()) -> None:
    """Add a format that `mavgate convert` can write."""
    if ending in WRITERS:
        raise ValueError(f"files that end in {ending} are written already")
    WRITERS[ending], LACKS[ending] = write, lacks


def _write_csv(flight: FlightToWrite) -> Iterator[bytes]:
    if flight.message_id is None:
        return _write_table(flight)
    return message_csv.write(flight.chosen(flight.message_id), flight.message_id)


def _write_table(flight: FlightToWrite) -> Iterator[bytes]:
    table = flight.table()
    yield encode_head(table.header).encode()
    yield from map(encode_block, table.blocks)


def _drawn(draw: Callable[[str, list[VehicleTrack]], Iterator[str]]) -> Write:
    return lambda flight: (piece.encode() for piece in draw(flight.title, _vehicles(flight)))


def _vehicles(flight: FlightToWrite) -> list[VehicleTrack]:
    if flight.has_messages:
        found = tracks_of_messages(flight.vehicle_messages(DRAWN_IDS, flight.options.system_id))
    else:
        tables = (one.table() for one in flight.by_aircraft())
        found = [
            track
            for table in tables
            for track in tracks_of_table(table, aircraft_of(table, flight.options))
        ]
    if not found:
        files = ", ".join(map(str, flight.files))
        raise FlightError(f"{files}: nothing to draw, since the flight has no position")
    return found


def _packaged(module: str, name: str) -> Write:
    """Return a writer whose dependencies are imported at its first use."""

    def write(flight: FlightToWrite) -> Iterable[bytes]:
        pieces: Iterable[bytes] = import_format(module, name).write(flight)
        return pieces

    return write


add_writer(".tlog", FlightToWrite.tlog, Lacks(of_tables=NOT_FUSED))
add_writer(".csv", _write_csv, Lacks(of_tlogs=NOT_IN_TABLE))
add_writer(".kml", _drawn(to_kml), Lacks(*NOT_DRAWN))
add_writer(".gpx", _drawn(to_gpx), Lacks(*NOT_DRAWN))
add_writer(".geojson", _drawn(to_geojson), Lacks(*NOT_DRAWN))
add_writer(".mcap", _packaged("mcap", "MCAP"), Lacks(of_tables=NOT_FUSED))
add_writer(".parquet", _packaged("parquet", "Parquet"), Lacks(of_tlogs=NOT_IN_TABLE))


class Pieces(RawIOBase):
    """A file in memory, without seek, from which the bytes written so far can be taken."""

    def __init__(self) -> None:
        self._written: list[bytes] = []
        self._size = 0

    def writable(self) -> bool:
        """Return that it can be written."""
        return True

    def write(self, data: Any) -> int:
        """Write more of the file."""
        self._written.append(bytes(data))
        self._size += len(self._written[-1])
        return len(self._written[-1])

    def tell(self) -> int:
        """Return the number of bytes written in total."""
        return self._size

    def take(self) -> bytes:
        """Return the bytes that were written since the last call."""
        data = b"".join(self._written)
        self._written.clear()
        return data
