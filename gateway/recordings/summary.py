"""Summary of any recording: time, vehicles, rates, gaps, distance, damage."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from gateway.recordings.columns import (
    BARO,
    FIX_LAT,
    FIX_LON,
    GPS,
    MAG,
    NAV,
    NAV_LAT,
    NAV_LON,
    RAW,
    SI,
    FloatArray,
    has_fix,
    has_group,
    has_position,
)
from gateway.recordings.files import (
    NO_RECORDING,
    TABLE,
    TLOG,
    FlightError,
    Progress,
    format_of,
    open_tlog,
    read_blocks,
)
from gateway.recordings.table import TableBlock, TableFault, TableHeader, TableNote, TableReader
from gateway.recordings.tlog import DAY_US
from gateway.recordings.tlog_index import TlogIndex
from gateway.recordings.vehicle_reader import VehicleReader
from gateway.units import DEG_PER_DEGE7, US_PER_S, counted
from gateway.vehicle_state.positions import GroundDistance
from gateway.vehicle_state.senders import Senders
from gateway.wire.mavlink_messages import MESSAGE_NAMES
from gateway.wire.recorded_frames import Batch, IntArray

if TYPE_CHECKING:
    from gateway.recordings.recorded_table import ReadOptions


GAP_US: Final = 2 * US_PER_S
"""Minimum pause that is a gap: every vehicle sends a heartbeat once a second."""
MAX_GAPS: Final = 1000
DAMAGED_TIME: Final = "{} with a damaged time, replaced by that of the record before"


@dataclass(frozen=True, slots=True)
class Gap:
    """A gap in the data."""

    time_us: int
    """Start of the gap, in the recording's own time."""
    duration_s: float


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
    distance_m: float | None
    """Distance over ground; None without a position."""
    positions: str | None
    """Source of the positions: a MAVLink message, or states or fixes of a table."""
    rates: tuple[Rate, ...]


@dataclass(frozen=True, slots=True)
class FileInfo:
    """Summary of a recording."""

    kind: str
    size: int
    records: int
    first_us: int | None
    """µs since 1970 for a tlog, on the gateway clock for a table."""
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


@dataclass(slots=True)
class TimesSpan:
    """Sum up the duration of records; a clock jump of more than a day adds nothing."""

    first_us: int | None = None
    gaps: list[Gap] = field(default_factory=list)
    """The first `MAX_GAPS` between records of `add_all`."""
    last_us: int | None = None
    """Greatest time."""
    _begin_us: int = 0
    """Start of the part since the last clock jump."""
    _newest_us: int = 0
    _last_us: int = 0
    _before_us: int = 0
    """Total length of the parts before it."""

    @property
    def length_us(self) -> int:
        """Duration from the first record to the last, without clock jumps."""
        return self._before_us + self._newest_us - self._begin_us

    def add(self, time_us: int) -> None:
        """Add the time of the next record."""
        if self.first_us is None:
            self.first_us = self._begin_us = self._newest_us = time_us
        elif abs(time_us - self._last_us) > DAY_US:
            self._before_us = self.length_us
            self._begin_us = self._newest_us = time_us
        elif time_us > self._newest_us:
            self._newest_us = time_us
        self._last_us = time_us

    def add_all(self, times_us: IntArray) -> None:
        """Add the times of the next records, at least one."""
        before_us = times_us[0] if self.first_us is None else self._last_us
        steps_us = np.diff(times_us, prepend=before_us)
        for i in np.flatnonzero(steps_us > GAP_US)[: MAX_GAPS - len(self.gaps)].tolist():
            step_us = int(steps_us[i])
            self.gaps.append(Gap(int(times_us[i]) - step_us, step_us / US_PER_S))
        for between in np.split(times_us, np.flatnonzero(np.abs(steps_us) > DAY_US)):
            if len(between):
                self.add(int(between[0]))
                self._newest_us = max(self._newest_us, int(between.max()))
                self.last_us = max(self.last_us or self._newest_us, self._newest_us)
                self._last_us = int(between[-1])


class TlogSummary:
    """Summarise a tlog, batch by batch."""

    def __init__(self, senders: Senders) -> None:
        self._index, self._senders = TlogIndex(), senders
        self._reader = VehicleReader(senders, with_attitude=False)
        self._counts: Counter[tuple[int, int]] = Counter()
        self._distances: defaultdict[int, GroundDistance] = defaultdict(GroundDistance)
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
        for message in self._reader.feed_batch(batch):
            if (at := message.position) is not None:
                self._distances[message.system_id].update(
                    message.time_us, at.lat_deg, at.lon_deg, message.boot_us
                )

    def result(self, size: int) -> FileInfo:
        """Return the summary of a file of that size."""
        index = self._index
        duration_s = self._span.length_us / US_PER_S
        return FileInfo(
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

    def _vehicle(self, system_id: int, duration_s: float) -> VehicleInfo:
        vehicle = self._senders.vehicle(system_id)
        mav_type, autopilot = vehicle.heartbeat or (None, None)
        counts = {key: n for (system, key), n in self._counts.items() if system == system_id}
        distance_m = self._distances[system_id].distance_m
        return VehicleInfo(
            system_id=system_id,
            mav_type=mav_type,
            autopilot=autopilot,
            distance_m=distance_m,
            positions=None if distance_m is None else MESSAGE_NAMES[vehicle.position_id or 0],
            rates=tuple(
                _rate(MESSAGE_NAMES.get(key, f"message {key}"), counts[key], duration_s)
                for key in sorted(counts)
            ),
        )


class TableSummary:
    """Summarise a table, event by event."""

    def __init__(self) -> None:
        self._header: TableHeader | None = None
        self._notes: list[TableNote] = []
        self._counts: Counter[str] = Counter()
        self._damaged_bytes = self._unfinished_bytes = 0
        self._last_us: int | None = None
        self._of_states, self._of_fixes = GroundDistance(), GroundDistance()
        self._span = TimesSpan()

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
            self._add_rows(block.cells)

    def result(self, size: int) -> FileInfo:
        """Return the summary of a file of that size."""
        duration_s = self._span.length_us / US_PER_S
        has_states = self._of_states.distance_m is not None
        distance_m = (self._of_states if has_states else self._of_fixes).distance_m
        positions = "states" if has_states else "GPS fixes"
        vehicle = VehicleInfo(
            system_id=self._header.vehicle_id if self._header else 1,
            mav_type=None,
            autopilot=None,
            distance_m=distance_m,
            positions=None if distance_m is None else positions,
            rates=tuple(
                _rate(name, self._counts[name], duration_s)
                for name in ("imu", "mag", "baro", "gps", "state")
                if self._counts[name]
            ),
        )
        return FileInfo(
            kind="table",
            size=size,
            records=self._counts["row"],
            first_us=self._span.first_us,
            last_us=self._last_us,
            duration_s=duration_s,
            vehicles=(vehicle,),
            gaps=tuple(self._span.gaps),
            damaged_bytes=self._damaged_bytes,
            damaged_runs=self._counts["damage"],
            unfinished_bytes=self._unfinished_bytes,
            header=self._header,
            notes=tuple(self._notes),
        )

    def _add_rows(self, cells: FloatArray) -> None:
        counts = self._counts
        has_imu, has_mag = has_group(cells, SI), has_group(cells, MAG)
        counts["row"] += len(cells)
        counts["imu"] += int((has_imu | has_group(cells, RAW)).sum())
        counts["mag"] += int((has_imu & has_mag).sum())
        for name, group in (("baro", BARO), ("gps", GPS), ("state", NAV)):
            counts[name] += int(has_group(cells, group).sum())
        times_us = cells[:, 0].astype(np.int64)
        self._last_us = max(int(times_us.max()), self._last_us or 0)
        self._span.add_all(times_us)
        fixed = cells[has_fix(cells)]
        for time_us, lat, lon in fixed[:, [GPS.start, FIX_LAT, FIX_LON]].tolist():
            self._of_fixes.update(int(time_us), lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7)
        placed = cells[has_position(cells)]
        for time_us, lat_deg, lon_deg in placed[:, [0, NAV_LAT, NAV_LON]].tolist():
            self._of_states.update(int(time_us), lat_deg, lon_deg)


def _rate(name: str, count: int, duration_s: float) -> Rate:
    return Rate(name, count, round(count / duration_s, 3) if duration_s > 0 else 0.0)


def describe(file: Path, progress: Progress | None, options: Callable[[], ReadOptions]) -> FileInfo:
    """Summarise a tlog, a table, or another program's file; FlightError for any other file.

    `options` is called for other programs' files only.
    """
    kind, size = format_of(file), file.stat().st_size
    if kind == TLOG:
        source = open_tlog(file)
        tlog = TlogSummary(source.senders)
        for batch in source.batches(progress):
            tlog.add(batch)
        found = tlog.result(size)
        found = replace(found, remarks=(*source.remarks, *found.remarks))
        if not found.records:
            raise FlightError(f"{file}: {NO_RECORDING}")
        return found
    if kind != TABLE:
        return _describe_by_rows(file, kind, options())
    table, reader = TableSummary(), TableReader()
    for block in read_blocks(file, reader, progress):
        table.add(block, reader.header)
    return table.result(size)


def _describe_by_rows(file: Path, kind: str, options: ReadOptions) -> FileInfo:
    # These import all stages, which the summary of our own recordings does not need.
    from gateway.recordings.reading import has_record, is_table, open_record, open_rows
    from gateway.recordings.workshop.joining import shifted

    recorded, table = open_rows(file, options), TableSummary()
    own = is_table(file)
    zero_us = 0 if own else recorded.header.unix_us_at_zero or 0
    for block in recorded.blocks:
        table.add(shifted(block, zero_us), recorded.header)
    remarks = list(recorded.remarks)
    if has_record(file):
        with suppress(FlightError):
            remarks += filter(None, [open_record(file, replace(options, progress=None)).lacks])
    return replace(
        table.result(file.stat().st_size),
        kind=kind,
        header=recorded.header if own else None,
        remarks=tuple(remarks),
    )
