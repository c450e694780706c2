"""Summary of any recording: time, vehicles, rates, gaps, facts of the flights, damage."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from gateway.recordings.columns import BARO, GPS, MAG, NAV, RAW, SI, FloatArray, has_group
from gateway.recordings.file_format import NO_RECORDING, TABLE, TLOG
from gateway.recordings.files import FlightError, Progress, read_blocks
from gateway.recordings.flight_facts import FlightFacts, FlightTally, checksum
from gateway.recordings.recorded_clock import Gap, TimesSpan
from gateway.recordings.recording import RecordedFile
from gateway.recordings.table import TableBlock, TableFault, TableHeader, TableNote, TableReader
from gateway.recordings.tallies import MessageTally, RowTally, VehicleTally
from gateway.recordings.tlog_index import DAMAGED_TIME, TlogIndex
from gateway.units import US_PER_S, counted
from gateway.vehicle_state.senders import RecordedSender, Senders
from gateway.wire.mavlink_messages import MESSAGE_NAMES
from gateway.wire.recorded_frames import Batch

if TYPE_CHECKING:
    from gateway.recordings.recorded_table import ReadOptions

OTHERS: Final = {"baro": BARO, "gps": GPS, "state": NAV}
RATES: Final = ("imu", "mag", *OTHERS)
"""Kinds of records of a table whose rates are listed."""


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


def of_messages(
    senders: Senders,
    batches: Iterable[Batch],
    size: int,
    kind: str = TLOG,
    remarks: Iterable[str] = (),
) -> Summary:
    """Summarise MAVLink in a file of that size."""
    index, tally, span = TlogIndex(), MessageTally(senders), TimesSpan()
    counts: Counter[tuple[int, int]] = Counter()

    def counting() -> Iterator[Batch]:
        for batch in batches:
            index.add(batch)
            span.add_all(batch.time_us)
            keys = (batch.origins >> 8) << 24 | batch.message_ids
            for key, count in zip(*np.unique(keys, return_counts=True), strict=True):
                counts[int(key) >> 24, int(key) & 0xFFFFFF] += int(count)
            yield batch

    tally.add_all(counting())
    duration_s = span.length_us / US_PER_S
    systems: defaultdict[int, list[Rate]] = defaultdict(list)
    for (system_id, key), count in sorted(counts.items()):
        name = MESSAGE_NAMES.get(key, f"message {key}")
        systems[system_id].append(_rate(name, count, duration_s))
    mended = [DAMAGED_TIME.format(counted(index.mended, "record"))] if index.mended else []
    info = FileInfo(
        kind=kind,
        size=size,
        records=index.count,
        first_us=index.first_us,
        last_us=index.last_us,
        duration_s=duration_s,
        vehicles=tuple(
            _vehicle(senders.vehicle(system_id), rates, tally.vehicles.get(system_id))
            for system_id, rates in systems.items()
        ),
        gaps=tuple(span.gaps),
        damaged_bytes=index.damaged_bytes,
        damaged_runs=len(index.damage),
        unfinished_bytes=index.unfinished,
        remarks=(*remarks, *mended),
    )
    return Summary(info, tally.vehicles)


def _vehicle(sender: RecordedSender, rates: list[Rate], tally: VehicleTally | None) -> VehicleInfo:
    mav_type, autopilot = sender.heartbeat or (None, None)
    found = VehicleInfo(sender.origin >> 8, mav_type, autopilot, None, tuple(rates))
    if tally is None:
        return found
    return replace(
        found,
        positions=tally.positions,
        facts=tally.facts(),
        version=tally.firmware,
        settings=tally.settings_checksum,
    )


def of_rows(
    blocks: Iterable[TableBlock],
    header_of: Callable[[], TableHeader | None],
    size: int,
    kind: str = TABLE,
    remarks: Callable[[], Iterable[str]] = list,
) -> Summary:
    """Summarise rows in a file of that size; `header_of` is called once all are read."""
    tally, counts = RowTally(), Counter[str]()
    notes: list[TableNote] = []
    for block in blocks:
        for _, comment in block.comments:
            if isinstance(comment, TableNote):
                notes.append(comment)
            elif isinstance(comment, TableFault):
                what = "unfinished" if comment.is_cut else "damaged"
                counts[what] += comment.size
                counts["runs"] += not comment.is_cut
        counts.update(_counts_of(block.cells))
        tally.add(block)
    header, facts = header_of(), tally.facts()
    vehicle = VehicleInfo(
        system_id=header.vehicle_id if header else 1,
        mav_type=None,
        autopilot=None,
        positions=tally.positions,
        rates=tuple(_rate(name, counts[name], facts.duration_s) for name in RATES if counts[name]),
        facts=facts,
        version=(header and header.mavgate_version) or None,
        settings=_checksum(header),
    )
    info = FileInfo(
        kind=kind,
        size=size,
        records=counts["row"],
        first_us=tally.span.first_us,
        last_us=tally.span.last_us,
        duration_s=facts.duration_s,
        vehicles=(vehicle,),
        gaps=facts.gaps,
        damaged_bytes=counts["damaged"],
        damaged_runs=counts["runs"],
        unfinished_bytes=counts["unfinished"],
        header=header,
        notes=tuple(notes),
        remarks=tuple(remarks()),
    )
    return Summary(info, {vehicle.system_id: tally})


def _counts_of(cells: FloatArray) -> dict[str, int]:
    has_imu, has_mag = has_group(cells, SI), has_group(cells, MAG)
    found = {"row": len(cells), "imu": (has_imu | has_group(cells, RAW)).sum()}
    found["mag"] = (has_imu & has_mag).sum()
    found |= {name: has_group(cells, group).sum() for name, group in OTHERS.items()}
    return {name: int(count) for name, count in found.items()}


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
    path, size = recording.path, recording.path.stat().st_size
    if recording.is_mavlink:
        source = recording.mavlink
        batches = source.batches(progress)
        found = of_messages(source.senders, batches, size, remarks=source.remarks)
        if not found.info.records:
            raise FlightError(f"{path}: {NO_RECORDING}")
        return found
    if recording.kind == TABLE:
        reader = TableReader()
        return of_rows(read_blocks(path, reader, progress), lambda: reader.header, size)
    if options is None:
        raise FlightError(f"{path}: {NO_RECORDING}")
    return (_of_log if recording.is_log else _of_others)(recording, options(), size)


def _of_others(recording: RecordedFile, options: ReadOptions, size: int) -> Summary:
    # This imports all stages, as reading the rows does.
    from gateway.recordings.workshop.joining import shifted

    table, own = recording.rows(options), recording.is_own
    zero_us = 0 if own else table.header.unix_us_at_zero or 0
    blocks = (shifted(block, zero_us) for block in table.blocks)
    kind, remarks = recording.kind, table.remarks
    found = of_rows(blocks, lambda: table.header, size, kind, lambda: remarks)
    return found if own else replace(found, info=replace(found.info, header=None))


def _of_log(recording: RecordedFile, options: ReadOptions, size: int) -> Summary:
    """Summarise an autopilot's log by the MAVLink that is made of it."""
    from gateway.recordings.workshop.convert import FlightToWrite

    flight = FlightToWrite([recording], options)
    found = of_messages(flight.senders, flight.chosen(), size, recording.kind)
    lacks = filter(None, [log.lacks for log in flight.logs])
    return replace(found, info=replace(found.info, remarks=(*flight.remarks, *lacks)))
