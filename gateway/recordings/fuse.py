"""Fuse recorded flights again: as the live pipeline, as rows, or smoothed from both ends.

GPS latency and declination follow one rule for every command: a latency that the user has set is
used; else that of the log's comments; else it is estimated from the motion; else the default is
assumed, with a remark. mavgate's own recordings keep theirs.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from gateway import __version__
from gateway.aircraft import Action, Aircraft, AircraftSettings, make_fusion
from gateway.estimation.columns import GPS_COLUMNS, imu_rows, nav_state
from gateway.estimation.kernel import (
    FoundLatency,
    KernelEstimator,
    SampleLog,
    estimate_latency,
)
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.smoother.smoother import smooth
from gateway.geometry.angle import wrap_180
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.columns import (
    BARO,
    BARO_CODEC,
    FLAGS,
    GPS,
    GPS_CODEC,
    NAV,
    NAV_COLUMNS,
    NODE_ID,
    RAW,
    SI,
    WHOLE_COLUMNS,
    FloatArray,
    TableRow,
    has_group,
    write_lines,
)
from gateway.recordings.files import (
    FileKind,
    FlightError,
    encoding_of,
    kind_of,
    read_chunks,
    read_ends,
)
from gateway.recordings.join import joined_tables
from gateway.recordings.reading import (
    ReadOptions,
    RecordedTable,
    aircraft_of,
    csv_reader,
    header_for,
    is_table,
    open_rows,
    settings_of,
)
from gateway.recordings.table import (
    FORMAT_LINE,
    NO_ROWS,
    REMARK,
    TableBlock,
    TableComment,
    TableHeader,
    TableMark,
    TableReader,
    encode_header,
)
from gateway.recordings.tlog import ORDER_US, UNRECORDED, Stamper, TlogRecord
from gateway.records import (
    RECORDED_ONLY,
    BaroRaw,
    FusionState,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuRaw,
    NavState,
    NodeStatus,
    Outgoing,
)
from gateway.sensing.chain import SensorChain
from gateway.sensing.imu_log import ImuLog, IntArray
from gateway.units import DEG_PER_DEGE7, US_PER_S
from gateway.vehicle.actions import INFO, StatusText

LONGEST_GAP_US: Final = 1_000_000
"""In a longer gap the pipeline's timers are not run one by one."""


class Replay:
    """Feed rows to a pipeline as if they arrived now."""

    def __init__(self, pipeline: Pipeline, *, follow: bool = True) -> None:
        self._pipeline = pipeline
        self._follow = follow
        self._now_us: int | None = None

        self.refused: list[str] = []
        """Why states of the file were not restored; then the estimator starts cold."""

    def take(
        self, row: TableRow | TableHeader | TableMark | FusionState | NodeStatus
    ) -> Iterator[tuple[int, Action]]:
        """Process one row, a change of settings, a mark, or a state to restore."""
        if isinstance(row, TableHeader):
            if self._follow:
                now_us = self._now_us or 0
                for action in self._pipeline.change(row.vehicle_id, settings_of(row), now_us):
                    yield now_us, action
            return
        if isinstance(row, TableMark):
            yield from self._wait(row.time_us)
            now_us = self._now_us or 0
            for action in self._pipeline.say(StatusText(INFO, REMARK + row.text), now_us):
                yield now_us, action
            return
        if isinstance(row, FusionState):
            self.restore(row)
            return
        for record in [row] if isinstance(row, NodeStatus) else records_of(row):
            yield from self._wait(record.time_us)
            now_us = self._now_us if self._now_us is not None else record.time_us
            for action in self._pipeline.take(record, now_us):
                yield now_us, action

    def restore(self, state: FusionState) -> bool:
        """Restore a state of the file, if it fits; return whether it does."""
        try:
            self._pipeline.restore(state)
        except ValueError as error:
            self.refused.append(str(error))
            return False
        return True

    def _wait(self, until_us: int) -> Iterator[tuple[int, Action]]:
        """Run the timed actions before the next record; the clock never goes back."""
        now_us = until_us if self._now_us is None else max(self._now_us, until_us)
        if self._now_us is None or now_us - self._now_us > LONGEST_GAP_US:
            self._now_us = now_us
        while (due_us := max(self._pipeline.next_due_us(), self._now_us)) < now_us:
            self._now_us = due_us
            for action in self._pipeline.poll(due_us):
                yield due_us, action
            if self._pipeline.next_due_us() <= due_us:
                break
        self._now_us = now_us


def records_of(row: TableRow) -> list[BaroRaw | GpsFix | ImuRaw | ImuCalibrated]:
    """List a row's records in the order in which they were processed; counts before SI values."""
    records = (row.baro, row.gps, row.raw or row.imu)
    return [record for record in records if record is not None]


def imu_log_of(cells: FloatArray, chain: SensorChain) -> ImuLog:
    """Let the IMU samples of a table's rows run through the sensing stage; counts before SI values.

    Parameters
    ----------
    cells : ndarray, shape (n, len(COLUMNS))
        Rows that each have a sample; see `gateway.recordings.columns`.
    chain : SensorChain
        Of their aircraft.
    """
    time_us = cells[:, 0].astype(np.int64)
    return ImuLog(time_us, *calibrated_of(cells, chain))


def calibrated_of(
    cells: FloatArray, chain: SensorChain
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Calibrate the IMU samples of a table's rows; see `imu_log_of`.

    Returns
    -------
    accel, gyro, mag : ndarray, shape (n, 3)
    temperature_degc : ndarray, shape (n,)
    flags : ndarray of int, shape (n,)
    """
    flags = cells[:, FLAGS].astype(np.int64)
    si = cells[:, SI].copy()
    has_counts = has_group(cells, RAW)
    if has_counts.any():
        accel, gyro, mag, temperature_degc, flags[has_counts] = chain.calibrated(
            cells[has_counts, RAW], flags[has_counts]
        )
        si[has_counts] = np.column_stack([accel, gyro, mag, temperature_degc])
    return si[:, 0:3], si[:, 3:6], si[:, 6:9], si[:, 9], flags


def heard_of(cells: FloatArray, vehicle_id: int) -> list[tuple[int, BaroRaw | GpsFix]]:
    """List the heights and fixes of a table's rows, each with how many IMU samples came before."""
    has_sample = has_group(cells, RAW) | has_group(cells, SI)
    before: IntArray = np.cumsum(has_sample) - has_sample
    found: list[tuple[int, int, BaroRaw | GpsFix]] = []
    for order, group, make in ((0, BARO, BARO_CODEC.read), (1, GPS, GPS_CODEC.read)):
        rows = np.flatnonzero(has_group(cells, group))
        for row, values in zip(rows.tolist(), cells[rows, group].tolist(), strict=True):
            record = make(values, vehicle_id)
            if record is not None:
                found.append((row, order, record))
    found.sort(key=lambda heard: heard[:2])
    return [(int(before[row]), record) for row, _, record in found]


class InterpolatedPosition:
    """The paper's playback: straight lines between fixes instead of the fused position."""

    def __init__(self, fixes: Iterable[GpsFix], latency_s: float) -> None:
        self._latency_us = round(latency_s * US_PER_S)
        self._fixes = (
            fix
            for fix in fixes
            if fix.fix_ok and fix.fix_type in (GpsFixType.FIX_3D, GpsFixType.FIX_2D)
        )
        self._before: GpsFix | None = None
        self._after = next(self._fixes, None)

    def __call__(self, state: NavState) -> NavState:
        """Replace a state's position by the interpolated one, except before and after the fixes."""
        arrival_us = state.time_us + self._latency_us
        while self._after is not None and self._after.time_us < arrival_us:
            self._before, self._after = self._after, next(self._fixes, None)
        a, b = self._before or self._after, self._after
        if a is None or b is None or arrival_us < a.time_us:
            return state
        way = (arrival_us - a.time_us) / max(b.time_us - a.time_us, 1)
        # The shorter way, so that a flight over the date line does not go around the earth.
        east_deg = wrap_180((b.lon_dege7 - a.lon_dege7) * DEG_PER_DEGE7)
        return msgspec.structs.replace(
            state,
            lat_deg=(a.lat_dege7 + way * (b.lat_dege7 - a.lat_dege7)) * DEG_PER_DEGE7,
            lon_deg=wrap_180(a.lon_dege7 * DEG_PER_DEGE7 + way * east_deg),
            alt_amsl_m=a.alt_amsl_m + way * (b.alt_amsl_m - a.alt_amsl_m),
        )


SMOOTHED_ESTIMATOR: Final = "eskf"
"""The filter that the smoother goes over."""


def with_smoothed_estimator(aircraft: AircraftSettings) -> AircraftSettings:
    """Choose the estimator that can be smoothed."""
    estimation = msgspec.structs.replace(aircraft.estimation, estimator=SMOOTHED_ESTIMATOR)
    return msgspec.structs.replace(aircraft, estimation=estimation)


def smooth_blocks(
    blocks: Iterable[TableBlock], aircraft: AircraftSettings
) -> tuple[IntArray, FloatArray, float]:
    """Smooth the rows of one aircraft.

    Parameters
    ----------
    blocks : iterable of TableBlock
        In the order of the recording.
    aircraft : AircraftSettings
        Calibration, filters, and the settings of the Kalman filter.

    Returns
    -------
    time_us : ndarray, shape (n,)
        Of the IMU samples.
    states : ndarray, shape (n, NAV_COLUMNS)
        See `gateway.estimation.columns`.
    latency_s : float
        The GPS latency that was used; see `smooth`.

    Raises
    ------
    ValueError
        If the clock was set back: there is no order to smooth in.
    """
    log, estimator = gather_samples(blocks, aircraft)
    log = _in_order(log)
    return log.imu_time_us, *smooth(estimator, log)


def smoothed_latency_in_words(used_s: float, set_s: float) -> str:
    """Describe a GPS latency that a flight was smoothed with, and that was not set."""
    return (
        f"smoothed with a GPS latency of {used_s:.2f} s, which its manoeuvres show; "
        f"gps_latency_s is {set_s:.2f} s"
    )


class SmoothedStates:
    """Replace each state by the smoothed one of its time.

    Parameters
    ----------
    time_us : ndarray, shape (n,)
        In order.
    states : ndarray, shape (n, NAV_COLUMNS)
        At these times.
    """

    def __init__(self, time_us: IntArray, states: FloatArray) -> None:
        self._time_us, self._states = time_us, states

    def __call__(self, state: NavState) -> NavState:
        """Return the smoothed state of that time; a state of another time is unchanged."""
        at = int(np.searchsorted(self._time_us, state.time_us))
        if at == len(self._time_us) or self._time_us[at] != state.time_us:
            return state
        smoothed = nav_state(state.time_us, self._states[at])
        return msgspec.structs.replace(smoothed, flags=state.flags)


def gather_samples(
    blocks: Iterable[TableBlock], aircraft: AircraftSettings
) -> tuple[SampleLog, KernelEstimator]:
    """Lay a flight's rows out as arrays, calibrated, for the Kalman filter, which is fresh."""
    chain, estimator = make_fusion(with_smoothed_estimator(aircraft))
    if not isinstance(estimator, KernelEstimator):
        raise TypeError(f"{SMOOTHED_ESTIMATOR} is {type(estimator)}, which cannot be smoothed")
    logs = [_sample_log(block.cells, chain, estimator) for block in blocks]
    if not logs:
        logs = [_sample_log(NO_ROWS, chain, estimator)]
    joined = [
        np.concatenate([getattr(log, field.name) for log in logs]) for field in fields(SampleLog)
    ]
    return SampleLog(*joined), estimator


def _in_order(log: SampleLog) -> SampleLog:
    """Put the samples that came late into their place."""
    if not len(log.imu_time_us):
        return log
    back_us = -np.diff(log.imu_time_us, prepend=log.imu_time_us[:1])
    sample = int(np.argmax(back_us))
    if back_us[sample] > ORDER_US:
        back_s = back_us[sample] / US_PER_S
        raise ValueError(
            f"its clock goes back by {back_s:.1f} s at IMU sample {sample + 1}, so it cannot be "
            "smoothed; cut it there, or leave out --smooth"
        )
    imu, baro, gps = (
        np.argsort(time_us, kind="stable")
        for time_us in (log.imu_time_us, log.baro_time_us, log.gps_time_us)
    )
    return SampleLog(
        log.imu_time_us[imu], log.imu[imu],
        log.baro_time_us[baro], log.baro_alt_m[baro],
        log.gps_time_us[gps], log.gps[gps],
    )  # fmt: skip


def _sample_log(cells: FloatArray, chain: SensorChain, estimator: KernelEstimator) -> SampleLog:
    samples = cells[has_group(cells, RAW) | has_group(cells, SI)]
    accel, gyro, mag, _, flags = calibrated_of(samples, chain)
    heard = [record for _, record in heard_of(cells, 1)]
    heights = [chain.baro(record) for record in heard if isinstance(record, BaroRaw)]
    fixes = [record for record in heard if isinstance(record, GpsFix)]
    return SampleLog(
        imu_time_us=samples[:, 0].astype(np.int64),
        imu=imu_rows(accel, gyro, mag, flags),
        baro_time_us=np.array([height.time_us for height in heights], np.int64),
        baro_alt_m=np.array([height.alt_pressure_m for height in heights], np.float64),
        gps_time_us=np.array([fix.time_us for fix in fixes], np.int64),
        gps=np.array([*map(estimator.fix_row, fixes)], np.float64).reshape(-1, GPS_COLUMNS),
    )


HEAD_LINES: Final = 20
LATENCY_TOLERANCE_S: Final = 0.03
"""The position may lag the velocity of the same fix by this much; only the velocity is compared."""
_KEY_VALUE: Final = re.compile(r"(\w+)=(-?[\d.]+)")
USUAL: Final = ReferenceSettings()


def aircraft_for(
    files: Sequence[Path],
    table: RecordedTable,
    options: ReadOptions,
    given_s: float | None = None,
) -> AircraftSettings:
    """Choose the settings for a flight, and complete them from its log.

    Parameters
    ----------
    files : sequence of Path
        The parts of one flight.
    table : RecordedTable
        Their rows. Where the latency has to be estimated they are read here, and kept for the
        next reader; a remark states the result.
    options : ReadOptions
        Current settings that differ from the defaults take precedence over the log.
    given_s : float, optional
        The GPS latency as the user gives it, s.

    Returns
    -------
    AircraftSettings
        Those of `aircraft_of`. For a log of another program, `gps_latency_s` and
        `declination_deg` of its # lines are used, else the latency estimated from its manoeuvres.

    Raises
    ------
    FlightError
        If a value in a # line is out of range.
    """
    aircraft = aircraft_of(table, options)
    facts = {} if is_table(files[0]) else facts_of(files[0])
    aircraft = with_facts(aircraft, facts)
    if given_s is not None:
        return with_reference(aircraft, gps_latency_s=given_s)
    latency_s = aircraft.estimation.reference.gps_latency_s
    known = is_table(files[0]) or "gps_latency_s" in facts
    if known or latency_s != USUAL.gps_latency_s:
        return aircraft
    log = _samples_of(table, aircraft)
    if len(log.gps) == 0:
        return aircraft
    found = estimate_latency(log)
    if found is None:
        how = f"{latency_s:.2f} s is assumed, since no manoeuvre shows it"
    else:
        how = f"{_in_words(found)} is estimated from its manoeuvres"
        aircraft = with_reference(aircraft, gps_latency_s=found.latency_s)
    table.remarks.append(f"{files[0]}: gives no GPS latency; {how}; gps_latency_s sets it")
    return aircraft


def check_latency(file: Path, table: RecordedTable, aircraft: AircraftSettings) -> None:
    """Add a remark where the motion of a recording speaks against the latency that is set."""
    set_s = aircraft.estimation.reference.gps_latency_s
    found = estimate_latency(_samples_of(table, aircraft))
    if found is None:
        return
    if abs(found.latency_s - set_s) > max(LATENCY_TOLERANCE_S, 3.0 * found.std_s):
        table.remarks.append(
            f"{file}: its manoeuvres show a GPS latency of {_in_words(found)}, "
            f"but gps_latency_s is {set_s:.2f} s"
        )


def note_smoothed_latency(
    file: Path, table: RecordedTable, aircraft: AircraftSettings, used_s: float
) -> AircraftSettings:
    """Return the settings that a flight was smoothed with; a remark states a latency not set."""
    set_s = aircraft.estimation.reference.gps_latency_s
    if used_s == set_s:
        return aircraft
    table.remarks.append(f"{file}: {smoothed_latency_in_words(used_s, set_s)}")
    return with_reference(aircraft, gps_latency_s=used_s)


def _samples_of(table: RecordedTable, aircraft: AircraftSettings) -> SampleLog:
    blocks = list(table.blocks)
    table.blocks = iter(blocks)
    return gather_samples(blocks, aircraft)[0]


def _in_words(latency: FoundLatency) -> str:
    return f"{latency.latency_s:.3f} s +- {latency.std_s:.3f} s"


def facts_of(file: Path) -> dict[str, float]:
    """Read `key=value` in the comments of another program's CSV; FlightError if no number."""
    facts: dict[str, float] = {}
    if kind_of(file) is not FileKind.CSV:
        return facts
    begin = next(read_chunks(file), b"")
    head = begin.decode(encoding_of(begin), errors="replace")
    for number, line in enumerate(head.split("\n", HEAD_LINES)[:HEAD_LINES], 1):
        for key, value in _KEY_VALUE.findall(line) if line.startswith("#") else ():
            try:
                facts[key] = float(value)
            except ValueError as error:
                raise FlightError(f"{file}: line {number}: {key}={value} is no number") from error
    return facts


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


def with_reference(aircraft: AircraftSettings, **changes: object) -> AircraftSettings:
    """Replace settings of `ReferenceSettings`."""
    reference = msgspec.structs.replace(aircraft.estimation.reference, **changes)
    estimation = msgspec.structs.replace(aircraft.estimation, reference=reference)
    return msgspec.structs.replace(aircraft, estimation=estimation)


class RowFusion:
    """Put new states into rows."""

    def __init__(self, aircraft: Aircraft, *, follow: bool) -> None:
        self._aircraft = aircraft
        self._follow = follow
        self.refused: list[str] = []
        """Why states of the file were not restored."""

    def blocks(self, blocks: Iterable[TableBlock]) -> Iterator[TableBlock]:
        """Yield the blocks of a file with the new states; rows without a record are left out."""
        for block in blocks:
            cells = block.cells
            held = np.any([has_group(cells, group) for group in (BARO, GPS, RAW, SI)], axis=0)
            cells = cells[held]
            location_of = np.concatenate([[0], np.cumsum(held)]).tolist()
            fused: list[FloatArray] = []
            comments: list[tuple[int, TableComment]] = []
            begin = 0
            for row, comment in block.comments:
                place = location_of[row]
                if isinstance(comment, TableHeader | FusionState):
                    fused.append(self._fused(cells[begin:place]))
                    begin = place
                if self._goes_on(comment):
                    comments.append((place, comment))
            fused.append(self._fused(cells[begin:]))
            yield TableBlock(np.concatenate(fused), tuple(comments))

    def _goes_on(self, comment: TableComment) -> bool:
        """Handle a line that is not a row; return whether it stays in the file."""
        if isinstance(comment, TableHeader):
            if self._follow:
                self._aircraft.change(settings_of(comment), 0)
            return self._follow
        if isinstance(comment, FusionState):
            try:
                self._aircraft.restore(comment)
            except ValueError as error:
                self.refused.append(str(error))
                return False
        return True

    def _fused(self, cells: FloatArray) -> FloatArray:
        """Return rows with the samples as they are calibrated now, and the states of now."""
        found = cells.copy()
        has_counts = has_group(cells, RAW)
        has_sample = has_counts | has_group(cells, SI)
        samples = cells[has_sample]
        log = imu_log_of(samples, self._aircraft.chain)
        states = self._aircraft.fuse(log, heard_of(cells, self._aircraft.vehicle_id))
        # A row without an IMU sample has the time of its newest record.
        newest_us = np.where(has_group(cells, GPS), cells[:, GPS.start], cells[:, BARO.start])
        found[~has_sample, 0] = newest_us[~has_sample]
        found[has_sample & ~has_counts, NODE_ID] = 0.0
        found[has_sample, SI] = np.column_stack(
            [log.accel_b_mps2, log.gyro_b_radps, log.mag_b_ut, log.temperature_degc]
        )
        found[:, NAV] = np.nan
        found[has_sample, NAV] = np.column_stack([samples[:, 0], states])
        return found


LINES: Final = 2000
"""Lines that are written at once."""
WRITTEN: Final = ("time_us", *NAV_COLUMNS)
IS_WHOLE: Final = np.array([name in WHOLE_COLUMNS for name in WRITTEN])


def fused_lines(header: TableHeader, time_us: IntArray, states: FloatArray) -> Iterator[bytes]:
    """Write a table of states only; unknown values are left blank.

    Parameters
    ----------
    header : TableHeader
        Head of the table: how they were fused.
    time_us : ndarray, shape (N,)
        Of the IMU samples.
    states : ndarray, shape (N, NAV_COLUMNS)
        See `gateway.estimation.columns`.
    """
    yield f"{FORMAT_LINE}\n{encode_header(header)}{','.join(WRITTEN)}\n".encode()
    table = np.column_stack([time_us, time_us, states])
    for begin in range(0, len(table), LINES):
        yield write_lines(table[begin : begin + LINES], IS_WHOLE)


SETTLES: Final = "the state stored at the start is not used: {}; the estimator has to converge"


class RecordedFusion:
    """Flights in sequence, fused again."""

    def __init__(
        self, files: Sequence[Path], options: ReadOptions, *, smooth: bool = False
    ) -> None:
        self._table = table = joined_tables([open_rows(file, options) for file in files])
        self._aircraft = aircraft_for(files, table, options)
        self._zero_us = table.header.unix_us_at_zero
        self._recorded = options.choice == "recorded" and is_table(files[0])
        correct: Callable[[NavState], NavState] | None = None
        if smooth:
            self._aircraft = with_smoothed_estimator(self._aircraft)
            blocks = _blocks_of(files, options)
            try:
                time_us, states, latency_s = smooth_blocks(blocks, self._aircraft)
            except ValueError as error:
                raise FlightError(f"{files[0]}: {error}") from error
            self._aircraft = note_smoothed_latency(files[0], table, self._aircraft, latency_s)
            correct = SmoothedStates(time_us, states)
        elif options.position == "interpolated":
            latency_s = self._aircraft.estimation.reference.gps_latency_s
            correct = InterpolatedPosition(_fixes_of(files, options), latency_s)
        common = PipelineSettings(self._aircraft, {}, self._zero_us or 0, correct)
        self._replay = Replay(Pipeline(common), follow=self._recorded)
        fresh = Aircraft(table.header.vehicle_id, self._aircraft, correct=correct)
        self._rows = RowFusion(fresh, follow=self._recorded)

    @property
    def remarks(self) -> list[str]:
        """Remarks about the states for the user, as far as the rows were read."""
        return [
            *(SETTLES.format(reason) for reason in (*self._replay.refused, *self._rows.refused)),
            *self._table.remarks,
        ]

    def introduction(self) -> Iterator[bytes]:
        """Yield the frames with the vehicle's version and the parameters that it is fused with."""
        vehicle = Aircraft(self._table.header.vehicle_id, self._aircraft).vehicle
        return (sent.frame for sent in vehicle.introduction())

    def frames(self) -> Iterator[TlogRecord]:
        """Yield the MAVLink that the gateway would have sent, at civil times."""
        stamper = Stamper(self._zero_us or 0)
        for row in self._table.rows:
            for now_us, action in self._replay.take(row):
                if not isinstance(action, Outgoing) or action.message_id in UNRECORDED:
                    continue
                if action.client_id in (None, RECORDED_ONLY):
                    yield TlogRecord(stamper.stamp(now_us), action.frame)

    def table(self) -> RecordedTable:
        """Return the rows with the new states, under a head that says how they were fused."""
        blocks = self._rows.blocks(self._table.blocks)
        # The first may hold nothing but the head of the file.
        first = next((block for block in blocks if len(block) or block.comments), None)
        at_begin = [] if first is None else [c for row, c in first.comments if row == 0]
        begins_cold = not any(isinstance(comment, FusionState) for comment in at_begin[:1])
        old, new = self._table.header, header_for(self._aircraft, self._table.header.vehicle_id)
        if not self._recorded or not old.settings:
            old = msgspec.structs.replace(old, settings=new.settings, calibration=new.calibration)
        header = msgspec.structs.replace(old, mavgate_version=__version__, cold_start=begins_cold)
        return RecordedTable(header, chain([] if first is None else [first], blocks))


def end_of(file: Path, options: ReadOptions) -> int | None:
    """Return the civil time of a table's last row without reading all of it; None if unknown."""
    kind = kind_of(file)
    if kind is FileKind.OTHER:
        return None
    head, tail = read_ends(file)
    rows: list[TableRow] = []
    if kind is FileKind.CSV:
        lines = (head + tail).decode(errors="replace").splitlines()
        with suppress(ValueError):
            rows = list(csv_reader(options).rows(lines))
        zero_us = 0
    else:
        reader = TableReader()
        events = reader.feed(head + tail, final=True)
        rows = [event for event in events if isinstance(event, TableRow)]
        zero_us = (reader.header.unix_us_at_zero or 0) if reader.header else 0
    return zero_us + rows[-1].time_us if rows else None


def _blocks_of(files: Iterable[Path], options: ReadOptions) -> Iterator[TableBlock]:
    """Read all once more, before the rows or along with them."""
    quiet = replace(options, progress=None)
    return joined_tables([open_rows(file, quiet) for file in files]).blocks


def _fixes_of(files: Iterable[Path], options: ReadOptions) -> Iterator[GpsFix]:
    heard = (
        record for block in _blocks_of(files, options) for _, record in heard_of(block.cells, 1)
    )
    return (record for record in heard if isinstance(record, GpsFix))
