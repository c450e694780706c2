"""Fuse recordings again: the settings to use, the rows and states, their MAVLink.

GPS latency and declination follow one rule for all commands: a value that the user has set is used;
else that of the log's comments; else the latency is estimated from the motion; else the default is
used, with a remark. mavgate's own recordings keep theirs.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway import __version__
from gateway.aircraft import Aircraft, AircraftSettings, FusedStates, Outputs
from gateway.estimation.eskf.settings import EskfSettings, make_gains
from gateway.estimation.kernel import FoundLatency, KernelEstimator, SampleLog
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import make_estimator
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.columns import (
    COLUMNS,
    GPS,
    NAV_COLUMNS,
    WHOLE_COLUMNS,
    FloatArray,
    has_group,
)
from gateway.recordings.files import FlightError
from gateway.recordings.fuse import (
    SMOOTHED_ESTIMATOR,
    Correct,
    Fusion,
    fuse,
    interpolated_positions,
    sample_log,
    samples_of,
    samples_of_cells,
    smoothed_states,
    with_estimator,
    with_reference,
)
from gateway.recordings.recorded_clock import Stamper
from gateway.recordings.recorded_table import (
    Line,
    ReadOptions,
    RecordedTable,
    aircraft_of,
    header_for,
    settings_of,
)
from gateway.recordings.recording import RecordedFile
from gateway.recordings.table import (
    FORMAT_LINE,
    NO_ROWS,
    NOTE,
    TableBlock,
    TableComment,
    TableHeader,
    TableNote,
    encode_line,
)
from gateway.recordings.table_lines import write_lines
from gateway.recordings.tlog import UNRECORDED
from gateway.recordings.workshop.joining import joined_rows
from gateway.records import RECORDED_ONLY, FusionState, NodeStatus
from gateway.sensing.chain import IntArray, SensorChain
from gateway.units import US_PER_S, counted
from gateway.vehicle.service import INFO, StatusText
from gateway.wire.recorded_frames import RecordedFrame

PIECE: Final = 200
"""Rows fused per step of a playback: some milliseconds, in which nothing is sent."""
SAMPLES: Final = 20_000
"""Samples in a piece of the estimation of the GPS latency: 4 MB of states."""
LONGEST_GAP_US: Final = 1_000_000
"""In a longer gap the pipeline's timers are not run step by step."""
LATENCY_TOLERANCE_S: Final = 0.03
"""The position may lag the velocity of the same fix by this much; the estimation compares only
the velocity."""
USUAL: Final = ReferenceSettings()
LINES: Final = 2000
"""Number of lines written at a time."""
WRITTEN: Final = ("time_us", *NAV_COLUMNS)
IS_WHOLE: Final = np.array([name in WHOLE_COLUMNS for name in WRITTEN])
LEAST_RATE_HZ: Final = 10.0
"""Minimum sample rate without a remark: a tracker turns within a tenth of a second."""
NOT_RESTORED: Final = "the state stored at the start is not used: {}; the estimator has to converge"


class Replay:
    """Feed rows to a pipeline as if they arrived now, to convert them and states to MAVLink."""

    def __init__(self, pipeline: Pipeline, *, follow: bool = True) -> None:
        self._pipeline = pipeline
        self._follow = follow
        self._now_us: int | None = None

    def feed(self, row: Line) -> Iterator[tuple[int, Outputs]]:
        """Process one row, a change of settings, a note, or a state to be restored."""
        if isinstance(row, TableHeader):
            if self._follow:
                now_us = self._now_us or 0
                yield now_us, self._pipeline.change(row.vehicle_id, settings_of(row), now_us)
            return
        if isinstance(row, TableNote):
            yield from self._wait(row.time_us)
            now_us = self._now_us or 0
            yield now_us, self._pipeline.announce(StatusText(INFO, NOTE + row.text), now_us)
            return
        if isinstance(row, FusionState):
            self._pipeline.restore(row)
            return
        # In the order in which they were processed; raw counts are preferred to SI values.
        records = [row] if isinstance(row, NodeStatus) else [row.baro, row.gps, row.raw or row.imu]
        for record in records:
            if record is None:
                continue
            yield from self._wait(record.time_us)
            now_us = self._now_us if self._now_us is not None else record.time_us
            yield now_us, self._pipeline.feed_record(record, now_us)

    def _wait(self, until_us: int) -> Iterator[tuple[int, Outputs]]:
        """Run the timed actions before the next record; time never decreases."""
        now_us = until_us if self._now_us is None else max(self._now_us, until_us)
        if self._now_us is None or now_us - self._now_us > LONGEST_GAP_US:
            self._now_us = now_us
        while (due_us := max(self._pipeline.next_due_us(), self._now_us)) < now_us:
            self._now_us = due_us
            yield due_us, self._pipeline.poll(due_us)
            if self._pipeline.next_due_us() <= due_us:
                break
        self._now_us = now_us


def aircraft_for(
    recording: RecordedFile,
    table: RecordedTable,
    options: ReadOptions,
    given_s: float | None = None,
    *,
    keep: bool = True,
) -> AircraftSettings:
    """Choose the settings for a flight, and complete them from the values in its first file.

    `given_s` is the GPS latency that the user gives. If it must be estimated, the table is read
    here, and with `keep` its rows are kept for the next reader. FlightError if a value in a # line
    is out of range.
    """
    aircraft = aircraft_of(table, options)
    facts = recording.facts()
    aircraft = with_facts(aircraft, facts)
    if given_s is not None:
        return with_reference(aircraft, gps_latency_s=given_s)
    latency_s = aircraft.estimation.reference.gps_latency_s
    known = recording.is_own or "gps_latency_s" in facts
    if known or latency_s != USUAL.gps_latency_s:
        return aircraft
    log = _log_of(table, aircraft, keep=keep)
    if len(log.gps) == 0:
        return aircraft
    found = estimate_latency(log)
    if found is None:
        how = f"assumed {latency_s:.2f} s, since no manoeuvre shows it"
    else:
        how = f"estimated {_in_words(found)}"
        aircraft = with_reference(aircraft, gps_latency_s=found.latency_s)
    table.remarks.append(
        f"{recording.path}: GPS latency not in log; {how} (override: gps_latency_s)"
    )
    return aircraft


def open_table(
    recordings: Sequence[RecordedFile],
    options: ReadOptions,
    given_s: float | None = None,
    *,
    keep: bool = True,
) -> tuple[RecordedTable, AircraftSettings]:
    """Open the rows of a flight, and choose its settings as `aircraft_for`."""
    table = joined_rows(recordings, options)
    return table, aircraft_for(recordings[0], table, options, given_s, keep=keep)


def check_latency(
    recording: RecordedFile, table: RecordedTable, aircraft: AircraftSettings
) -> None:
    """Add a remark if the motion in a recording contradicts the GPS latency that is set."""
    set_s = aircraft.estimation.reference.gps_latency_s
    found = estimate_latency(_log_of(table, aircraft))
    if found is None:
        return
    if abs(found.latency_s - set_s) > max(LATENCY_TOLERANCE_S, 3.0 * found.std_s):
        table.remarks.append(
            f"{recording.path}: its manoeuvres show a GPS latency of {_in_words(found)}, "
            f"but gps_latency_s is {set_s:.2f} s"
        )


def estimate_latency(log: SampleLog) -> FoundLatency | None:
    """Estimate the GPS latency of a whole flight; None if no manoeuvre allows it."""
    estimator = KernelEstimator(make_gains(EskfSettings(), USUAL), USUAL)
    # In pieces, since the states, which are not used, take much memory.
    begin, heights, fixes = 0, 0, 0
    while begin < len(log.imu_time_us):
        imu = slice(begin, begin + SAMPLES)
        newest_us = log.imu_time_us[imu][-1]
        baro = slice(heights, int(np.searchsorted(log.baro_time_us, newest_us, "right")))
        gps = slice(fixes, int(np.searchsorted(log.gps_time_us, newest_us, "right")))
        estimator.run(
            SampleLog(
                log.imu_time_us[imu], log.imu[imu], log.baro_time_us[baro], log.baro_alt_m[baro],
                log.gps_time_us[gps], log.gps[gps],
            )
        )  # fmt: skip
        begin, heights, fixes = begin + SAMPLES, max(heights, baro.stop), max(fixes, gps.stop)
    return estimator.found_latency()


def smoothed_latency_in_words(used_s: float, set_s: float) -> str:
    """Describe the GPS latency of a smoothed flight, if it is not the one that was set."""
    return (
        f"smoothed with a GPS latency of {used_s:.2f} s, which its manoeuvres show; "
        f"gps_latency_s is {set_s:.2f} s"
    )


def _log_of(table: RecordedTable, aircraft: AircraftSettings, *, keep: bool = True) -> SampleLog:
    """Read a table for `estimate_latency`, and keep its rows for the next reader if wanted."""
    calibration, kalman = SensorChain(aircraft.calibration), _kalman_filter(aircraft)
    kept: list[PackedBlock] = []
    parts = [sample_log(samples_of_cells(NO_ROWS, calibration), kalman)]
    for block in table.blocks:
        if keep:
            kept.append(PackedBlock.of(block))
        parts.append(sample_log(samples_of_cells(block.cells, calibration), kalman))
    table.blocks = (packed.block() for packed in kept)
    names = [field.name for field in fields(SampleLog)]
    return SampleLog(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, slots=True)
class PackedBlock:
    """A block of rows, most of whose cells are empty."""

    is_known: NDArray[np.uint8]
    """One bit for each cell."""
    values: FloatArray
    rows: int
    comments: tuple[tuple[int, TableComment], ...]

    @classmethod
    def of(cls, block: TableBlock) -> "PackedBlock":
        """Pack a block."""
        is_known = ~np.isnan(block.cells)
        return cls(np.packbits(is_known), block.cells[is_known], len(block), block.comments)

    def block(self) -> TableBlock:
        """Return the rows."""
        cells = np.full((self.rows, len(COLUMNS)), np.nan)
        is_known = np.unpackbits(self.is_known, count=cells.size).astype(bool)
        cells.ravel()[is_known] = self.values
        return TableBlock(cells, self.comments)


def _kalman_filter(aircraft: AircraftSettings) -> KernelEstimator:
    estimator = make_estimator(with_estimator(aircraft, SMOOTHED_ESTIMATOR).estimation)
    assert isinstance(estimator, KernelEstimator)
    return estimator


def _in_words(latency: FoundLatency) -> str:
    return f"{latency.latency_s:.3f} ± {latency.std_s:.3f} s"


def with_facts(aircraft: AircraftSettings, facts: dict[str, float]) -> AircraftSettings:
    """Replace default settings by values of a log; raises FlightError if one is out of range."""
    reference = aircraft.estimation.reference
    changes: dict[str, object] = {}
    if "gps_latency_s" in facts and reference.gps_latency_s == USUAL.gps_latency_s:
        changes["gps_latency_s"] = facts["gps_latency_s"]
    if "declination_deg" in facts and reference.declination == USUAL.declination:
        changes |= {"declination": "fixed", "declination_deg": facts["declination_deg"]}
    try:
        msgspec.convert(msgspec.to_builtins(reference) | changes, ReferenceSettings)
    except msgspec.ValidationError as error:
        raise FlightError(f"its # line has an invalid value: {error}") from error
    return with_reference(aircraft, **changes)


def fused_lines(header: TableHeader, time_us: IntArray, states: FloatArray) -> Iterator[bytes]:
    """Write a table of states only; unknown values become empty cells."""
    yield f"{FORMAT_LINE}\n{encode_line(header)}{','.join(WRITTEN)}\n".encode()
    table = np.column_stack([time_us, time_us, states])
    for begin in range(0, len(table), LINES):
        yield write_lines(table[begin : begin + LINES], IS_WHOLE)


class RecordedFusion:
    """Recordings in sequence, fused again as one flight; FlightError if that is not possible."""

    def __init__(
        self,
        recordings: Sequence[RecordedFile],
        options: ReadOptions,
        *,
        smooth: bool = False,
        estimator: str | None = None,
        latency_s: float | None = None,
    ) -> None:
        first, quiet = recordings[0], replace(options, progress=None)
        self._path = first.path
        self._table, self.aircraft = open_table(recordings, options, latency_s)
        """The settings used for the fusion."""
        if smooth or estimator is not None:
            name = SMOOTHED_ESTIMATOR if smooth or estimator is None else estimator
            self.aircraft = with_estimator(self.aircraft, name)
        is_own = options.choice == "recorded" and first.is_own
        self._follow = is_own and estimator is None and latency_s is None
        self._correct: Correct | None = None
        if smooth:
            self._correct = smoothed_states(*self._smooth(joined_rows(recordings, quiet).blocks))
        elif options.position == "interpolated":
            latency_s = self.aircraft.estimation.reference.gps_latency_s
            cells = (block.cells for block in joined_rows(recordings, quiet).blocks)
            fixes = [some[has_group(some, GPS), GPS] for some in cells]
            self._correct = interpolated_positions(np.concatenate(fixes), latency_s)
        self._refused: list[str] = []
        self._time_us: list[IntArray] = []
        self._name = self.aircraft.estimation.estimator + (" and smoothed" if smooth else "")

    def _smooth(self, blocks: Iterable[TableBlock]) -> tuple[IntArray, FloatArray]:
        """Smooth the rows; a remark is added if the latency used is not the one that was set."""
        samples = samples_of(blocks, self.aircraft.calibration)
        try:
            estimator = samples.estimator(self.aircraft.estimation)
        except ValueError:  # a state of other settings, which the fusion reports
            estimator = _kalman_filter(self.aircraft)
        try:
            fused = fuse(samples, estimator, smoothed=True)
        except ValueError as error:
            raise FlightError(f"{self._path}: {error}") from error
        set_s = self.aircraft.estimation.reference.gps_latency_s
        if fused.latency_s != set_s:
            text = smoothed_latency_in_words(fused.latency_s, set_s)
            self._table.remarks.append(f"{self._path}: {text}")
            self.aircraft = with_reference(self.aircraft, gps_latency_s=fused.latency_s)
        return np.sort(samples.imu.time_us, kind="stable"), fused.states

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user on the states, as far as the rows were read."""
        refused = (f"{self._path}: {NOT_RESTORED.format(why)}" for why in self._refused)
        return [*refused, *self._table.remarks, *self._of_rate()]

    @property
    def summary(self) -> str:
        """Number and rate of the fused samples, and the estimator."""
        count = counted(sum(map(len, self._time_us)), "sample")
        return f"{count} at {self._rate_hz():.3g} Hz fused by {self._name}"

    def _of_rate(self) -> Iterator[str]:
        if 0.0 < (rate_hz := self._rate_hz()) < LEAST_RATE_HZ:
            yield (
                f"{self._path}: its IMU samples come at {rate_hz:.2g} Hz; below "
                f"{LEAST_RATE_HZ:.0f} Hz rotation between them is not measured, so attitude and "
                "position may be wrong"
            )

    def _rate_hz(self) -> float:
        """Return the rate of samples from their median interval; 0 for a single one."""
        intervals_us = np.diff(np.concatenate([np.empty(0, np.int64), *self._time_us]))
        intervals_us = intervals_us[intervals_us > 0]
        return US_PER_S / float(np.median(intervals_us)) if len(intervals_us) else 0.0

    def introduction(self) -> Iterator[bytes]:
        """Yield frames with the version of the vehicle and the parameters of the fusion."""
        vehicle = Aircraft(self._table.header.vehicle_id, self.aircraft).vehicle
        return (sent.frame for sent in vehicle.introduction())

    def _fusion(self, played: FusedStates | None = None) -> Fusion:
        vehicle_id = self._table.header.vehicle_id
        fusion = Fusion(
            vehicle_id, self.aircraft, follow=self._follow, played=played, correct=self._correct
        )
        self._refused, self._time_us = fusion.refused, fusion.time_us
        return fusion

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield the MAVLink that the gateway would have sent, at civil times."""
        header, states = self._table.header, FusedStates()
        fusion = self._fusion(played=states)
        zero_us = header.unix_us_at_zero or 0
        settings = PipelineSettings(self.aircraft, {}, zero_us, states)
        replay, stamper = Replay(Pipeline(settings), follow=self._follow), Stamper(zero_us)
        for piece in (piece for block in self._table.blocks for piece in block.pieces(PIECE)):
            fusion.block(piece)
            lines = (e for e in piece.events(header.vehicle_id) if isinstance(e, Line))
            for now_us, out in (each for line in lines for each in replay.feed(line)):
                for sent in out.frames:
                    is_kept = sent.client_id in (None, RECORDED_ONLY)
                    if is_kept and sent.message_id not in UNRECORDED:
                        yield RecordedFrame(stamper.stamp(now_us), sent.frame)

    def table(self) -> RecordedTable:
        """Return the rows with the new states, under a head with the settings of the fusion."""
        blocks = map(self._fusion().block, self._table.blocks)
        # The first block may contain only the head of the file.
        first = next((block for block in blocks if len(block) or block.comments), None)
        at_begin = [] if first is None else [c for row, c in first.comments if row == 0]
        begins_cold = not any(isinstance(comment, FusionState) for comment in at_begin[:1])
        old, new = self._table.header, header_for(self.aircraft, self._table.header.vehicle_id)
        if not self._follow or not old.settings:
            old = msgspec.structs.replace(old, settings=new.settings, calibration=new.calibration)
        header = msgspec.structs.replace(old, mavgate_version=__version__, cold_start=begins_cold)
        return RecordedTable(header, chain([] if first is None else [first], blocks))


def header_of_states(known: TableHeader, aircraft: AircraftSettings) -> TableHeader:
    """Return the head of a table of new states, for a recording with a known head."""
    return msgspec.structs.replace(
        header_for(aircraft, known.vehicle_id),
        session=known.session,
        unix_us_at_zero=known.unix_us_at_zero,
    )
