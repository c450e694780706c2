"""Summary of any recording: time, vehicles, rates, gaps, facts of the flights, damage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from gateway.recordings.columns import BARO, GPS, MAG, NAV, RAW, SI, FloatArray, has_group
from gateway.recordings.file_format import NO_RECORDING, TABLE
from gateway.recordings.files import FlightError, Progress, read_blocks
from gateway.recordings.flight_facts import FlightFacts, FlightTally, checksum
from gateway.recordings.recorded_clock import Gap, TimesSpan
from gateway.recordings.recording import RecordedFile
from gateway.recordings.table import TableBlock, TableFault, TableHeader, TableNote, TableReader
from gateway.recordings.tallies import MessageTally, RowTally
from gateway.recordings.tlog_index import DAMAGED_TIME, TlogIndex
from gateway.units import US_PER_S, counted
from gateway.vehicle_state.senders import Senders
from gateway.wire.mavlink_messages import MESSAGE_NAMES
from gateway.wire.recorded_frames import Batch

if TYPE_CHECKING:
    from gateway.recordings.recorded_table import ReadOptions


@dataclass(frozen=True, slots=True)
class Rate:
    """Count and rate of one kind of record."""

    name: str
    count: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class VehicleInfo:
    """Summary of one system of a recording."""

    system_id: int
    mav_type: int | None
    autopilot: int | None
    positions: str | None
    """Source of the positions: a MAVLink message, or states or fixes of a table."""
    rates: tuple[Rate, ...]
    facts: FlightFacts | None = None
    """None for a ground station."""
    version: str | None = None
    """Version of mavgate, or of the autopilot's firmware."""
    settings: str | None = None
    """Checksum of settings and calibration, or of the parameters."""


@dataclass(frozen=True, slots=True)
class FileInfo:
    """Summary of a recording."""

    kind: str
    size: int
    records: int
    first_us: int | None
    """µs since 1970 for MAVLink and logs, on the gateway clock for a table."""
    last_us: int | None
    duration_s: float
    """Time from the first record to the last, without jumps of the clock by days."""
    vehicles: tuple[VehicleInfo, ...]
    gaps: tuple[Gap, ...]
    damaged_bytes: int
    damaged_runs: int
    unfinished_bytes: int = 0
    """Bytes of an incomplete last record or line: it is being written, or was cut off."""
    header: TableHeader | None = None
    notes: tuple[TableNote, ...] = ()
    remarks: tuple[str, ...] = ()
    """Remarks of the reader for the user."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a file, with the positions of its vehicles by system id."""

    info: FileInfo
    tallies: Mapping[int, FlightTally] = field(default_factory=dict)


class TlogSummary:
    """Summarise MAVLink, batch by batch."""

    def __init__(self, senders: Senders) -> None:
        self._index, self._senders = TlogIndex(), senders
        self._tally = MessageTally(senders)
        self._counts: Counter[tuple[int, int]] = Counter()
        self._span = TimesSpan()

    def add(self, batch: Batch) -> None:
        """Add the next batch of the file."""
        self._index.add(batch)
        if not len(batch):
            return
        self._span.add_all(batch.time_us)
        keys, counts = np.unique((batch.origins >> 8) << 24 | batch.message_ids, return_counts=True)
        for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
            self._counts[key >> 24, key & 0xFFFFFF] += count
        self._tally.add(batch)

    def result(self, size: int) -> Summary:
        """Return the summary of a file of that size."""
        index = self._index
        self._tally.flush()
        duration_s = self._span.length_us / US_PER_S
        info = FileInfo(
            kind="tlog",
            size=size,
            records=index.count,
            first_us=index.first_us,
            last_us=index.last_us,
            duration_s=duration_s,
            vehicles=tuple(
                self._vehicle(system_id, duration_s)
                for system_id in sorted({system_id for system_id, _ in self._counts})
            ),
            gaps=tuple(self._span.gaps),
            damaged_bytes=index.damaged_bytes,
            damaged_runs=len(index.damage),
            unfinished_bytes=index.unfinished,
            remarks=(DAMAGED_TIME.format(counted(index.mended, "record")),) if index.mended else (),
        )
        return Summary(info, self._tally.vehicles)

    def _vehicle(self, system_id: int, duration_s: float) -> VehicleInfo:
        mav_type, autopilot = self._senders.vehicle(system_id).heartbeat or (None, None)
        counts = {key: n for (system, key), n in self._counts.items() if system == system_id}
        rates = tuple(
            _rate(MESSAGE_NAMES.get(key, f"message {key}"), counts[key], duration_s)
            for key in sorted(counts)
        )
        found = VehicleInfo(system_id, mav_type, autopilot, None, rates)
        tally = self._tally.vehicles.get(system_id)
        if tally is None:
            return found
        return replace(
            found,
            positions=tally.positions,
            facts=tally.facts(),
            version=tally.firmware,
            settings=tally.settings_checksum,
        )


class TableSummary:
    """Summarise a table, or rows that were read from another format, block by block."""

    def __init__(self) -> None:
        self._header: TableHeader | None = None
        self._notes: list[TableNote] = []
        self._counts: Counter[str] = Counter()
        self._damaged_bytes = self._unfinished_bytes = 0
        self._tally = RowTally()

    def add(self, block: TableBlock, header: TableHeader | None) -> None:
        """Add the next block of the file."""
        self._header = header
        for _, comment in block.comments:
            if isinstance(comment, TableNote):
                self._notes.append(comment)
            elif isinstance(comment, TableFault) and comment.is_cut:
                self._unfinished_bytes += comment.size
            elif isinstance(comment, TableFault):
                self._counts["damage"] += 1
                self._damaged_bytes += comment.size
        if len(block):
            self._count_rows(block.cells)
        self._tally.add(block)

    def result(self, size: int) -> Summary:
        """Return the summary of a file of that size."""
        span, header = self._tally.span, self._header
        facts = self._tally.facts()
        vehicle = VehicleInfo(
            system_id=header.vehicle_id if header else 1,
            mav_type=None,
            autopilot=None,
            positions=self._tally.positions,
            rates=tuple(
                _rate(name, self._counts[name], facts.duration_s)
                for name in ("imu", "mag", "baro", "gps", "state")
                if self._counts[name]
            ),
            facts=facts,
            version=(header and header.mavgate_version) or None,
            settings=_checksum(header),
        )
        info = FileInfo(
            kind="table",
            size=size,
            records=self._counts["row"],
            first_us=span.first_us,
            last_us=span.last_us,
            duration_s=facts.duration_s,
            vehicles=(vehicle,),
            gaps=facts.gaps,
            damaged_bytes=self._damaged_bytes,
            damaged_runs=self._counts["damage"],
            unfinished_bytes=self._unfinished_bytes,
            header=header,
            notes=tuple(self._notes),
        )
        return Summary(info, {vehicle.system_id: self._tally})

    def _count_rows(self, cells: FloatArray) -> None:
        counts = self._counts
        has_imu, has_mag = has_group(cells, SI), has_group(cells, MAG)
        counts["row"] += len(cells)
        counts["imu"] += int((has_imu | has_group(cells, RAW)).sum())
        counts["mag"] += int((has_imu & has_mag).sum())
        for name, group in (("baro", BARO), ("gps", GPS), ("state", NAV)):
            counts[name] += int(has_group(cells, group).sum())


def _rate(name: str, count: int, duration_s: float) -> Rate:
    return Rate(name, count, round(count / duration_s, 3) if duration_s > 0 else 0.0)


def _checksum(header: TableHeader | None) -> str | None:
    if header is None or not header.settings:
        return None
    # Sorted, so that the order of the sections has no effect.
    return checksum(msgspec.json.encode([header.settings, header.calibration], order="sorted"))


def read_summary(
    recording: RecordedFile,
    progress: Progress | None = None,
    options: Callable[[], ReadOptions] | None = None,
) -> Summary:
    """Summarise a recording of any format, in one pass; FlightError for any other file.

    `options` is called for other programs' files only, which are refused without it.
    """
    file, size = recording.path, recording.path.stat().st_size
    if recording.is_mavlink:
        source = recording.mavlink
        found = _of_messages(source.senders, source.batches(progress), size)
        if not found.info.records:
            raise FlightError(f"{file}: {NO_RECORDING}")
        return _with(found, recording, (*source.remarks, *found.info.remarks))
    if recording.kind != TABLE:
        if options is None:
            raise FlightError(f"{file}: {NO_RECORDING}")
        return (_of_log if recording.is_log else _of_rows)(recording, options())
    table, reader = TableSummary(), TableReader()
    for block in read_blocks(file, reader, progress):
        table.add(block, reader.header)
    return table.result(size)


def _of_messages(senders: Senders, batches: Iterable[Batch], size: int) -> Summary:
    summary = TlogSummary(senders)
    for batch in batches:
        summary.add(batch)
    return summary.result(size)


def _with(found: Summary, recording: RecordedFile, remarks: Iterable[str]) -> Summary:
    return replace(found, info=replace(found.info, kind=recording.kind, remarks=tuple(remarks)))


def _of_rows(recording: RecordedFile, options: ReadOptions) -> Summary:
    # This imports all stages, as reading the rows does.
    from gateway.recordings.workshop.joining import shifted

    recorded, table = recording.rows(options), TableSummary()
    own = recording.is_own
    zero_us = 0 if own else recorded.header.unix_us_at_zero or 0
    for block in recorded.blocks:
        table.add(shifted(block, zero_us), recorded.header)
    found = table.result(recording.path.stat().st_size)
    found = replace(found, info=replace(found.info, header=found.info.header if own else None))
    return _with(found, recording, recorded.remarks)


def _of_log(recording: RecordedFile, options: ReadOptions) -> Summary:
    """Summarise an autopilot's log by the MAVLink that is made of it."""
    from gateway.recordings.workshop.convert import FlightToWrite

    flight = FlightToWrite([recording], options)
    batches = flight.chosen()
    found = _of_messages(flight.senders, batches, recording.path.stat().st_size)
    lacks = filter(None, [log.lacks for log in flight.logs])
    return _with(found, recording, [*flight.remarks, *lacks])
