"""Fuse samples of a recording to states: in live order or smoothed, at once or block by block."""

import math
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, fields
from typing import Final, NamedTuple, TypeVar

import msgspec
import numpy as np

from gateway.aircraft import (
    Aircraft,
    AircraftSettings,
    FusedStates,
    Outputs,
    latency_in_use,
    make_fusion,
)
from gateway.estimation.columns import (
    GPS_COLUMNS,
    NAV_ALT,
    NAV_FLAGS,
    NAV_LAT,
    NAV_LON,
    imu_rows,
    nav_row,
)
from gateway.estimation.columns import NAV_COLUMNS as STATE_COLUMNS
from gateway.estimation.kernel import Aiding, CompiledEstimator, KernelEstimator, SampleLog
from gateway.estimation.select import EstimationSettings, Estimator, make_estimator
from gateway.estimation.smoother import smooth
from gateway.geometry.angle import wrap_180
from gateway.recordings.columns import (
    BARO,
    BARO_CODEC,
    FIX_ALT,
    FIX_LAT,
    FIX_LON,
    FIX_OK,
    FIX_TYPE,
    FLAGS,
    GPS,
    GPS_CODEC,
    NAV,
    NODE_ID,
    RAW,
    SI,
    BoolArray,
    FloatArray,
    has_group,
)
from gateway.recordings.recorded_clock import ORDER_US
from gateway.recordings.recorded_table import settings_of
from gateway.recordings.table import NO_ROWS, TableBlock, TableComment, TableHeader
from gateway.records import BaroSample, FusionState, GpsFix, GpsFixType, NavFlags
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import ImuLog, IntArray, SensorChain
from gateway.settings import Settings
from gateway.units import DEG_PER_DEGE7, US_PER_S

VALID: Final = int(
    NavFlags.ATTITUDE_VALID
    | NavFlags.HEADING_VALID
    | NavFlags.POSITION_VALID
    | NavFlags.VELOCITY_VALID
    | NavFlags.ALTITUDE_VALID
)
SMOOTHED_ESTIMATOR: Final = "eskf"
"""The only filter whose states can be smoothed."""
Correct = Callable[[IntArray, FloatArray], FloatArray]
"""Function that corrects states, given their times."""


class FusionSettings(Settings, frozen=True):
    """The settings that affect the fusion of calibrated samples."""

    estimation: EstimationSettings = EstimationSettings()


Chosen = TypeVar("Chosen", AircraftSettings, FusionSettings)


def with_estimator(settings: Chosen, name: str) -> Chosen:
    """Choose another estimator."""
    estimation = msgspec.structs.replace(settings.estimation, estimator=name)
    return msgspec.structs.replace(settings, estimation=estimation)


def with_reference(settings: Chosen, **changes: object) -> Chosen:
    """Replace settings of `ReferenceSettings`."""
    reference = msgspec.structs.replace(settings.estimation.reference, **changes)
    estimation = msgspec.structs.replace(settings.estimation, reference=reference)
    return msgspec.structs.replace(settings, estimation=estimation)


@dataclass(frozen=True, slots=True)
class Samples:
    """The calibrated samples of one aircraft, in the order in which they were processed."""

    imu: ImuLog
    aiding: list[Aiding]
    """Heights and fixes, each with the index of the IMU sample before which it arrived."""
    calibration: NodeCalibration = field(default_factory=NodeCalibration)
    begin: FusionState | None = None
    """The state stored before the first sample."""

    def estimator(self, estimation: EstimationSettings) -> Estimator:
        """Build an estimator in the stored state; ValueError if the state is of other settings."""
        settings = AircraftSettings(calibration=self.calibration, estimation=estimation)
        return make_fusion(settings, self.begin)[1]

    def estimator_or_cold(self, estimation: EstimationSettings) -> Estimator:
        """Build an estimator in the stored state, or without state if that is of other settings."""
        with suppress(ValueError):
            return self.estimator(estimation)
        return make_estimator(estimation)


class Fused(NamedTuple):
    """The states of a recording, and the GPS latency used."""

    states: FloatArray
    """Shape (n, NAV_COLUMNS), one row per IMU sample; see `gateway.estimation.columns`."""
    latency_s: float
    """The GPS latency in use at the end; NaN for an estimator that has none."""


def fuse(
    samples: Samples,
    estimator: Estimator,
    *,
    smoothed: bool = False,
    on_fix: Callable[[], None] | None = None,
) -> Fused:
    """Fuse the samples of a recording or of its next part; every command uses this function.

    In the order of arrival, the estimator advances over the samples, bit-identical to live states;
    `on_fix` is called after each fix. Smoothed states also use later samples, are in order of time
    (see `smooth`), and require the Kalman filter, which is not changed.

    Raises ValueError if smoothing is requested and the clock was set back, since there is no order
    to smooth in.
    """
    imu = samples.imu
    if smoothed:
        if not isinstance(estimator, KernelEstimator):
            raise TypeError(f"{type(estimator)} cannot be smoothed")
        return Fused(*smooth(estimator, _in_order(sample_log(samples, estimator))))
    if isinstance(estimator, CompiledEstimator):
        rows = imu_rows(imu.accel_b_mps2, imu.gyro_b_radps, imu.mag_b_ut, imu.flags)
        states = estimator.run_in_arrival_order(imu.time_us, rows, samples.aiding, on_fix)
    else:
        states = _fuse_singly(estimator, samples, on_fix)
    latency = latency_in_use(estimator)
    return Fused(states, math.nan if latency is None else latency[0])


def _fuse_singly(
    estimator: Estimator, samples: Samples, on_fix: Callable[[], None] | None
) -> FloatArray:
    waiting = deque(samples.aiding)
    rows = []
    for number, sample in enumerate([*samples.imu.samples(), None]):
        while waiting and waiting[0][0] <= number:
            record = waiting.popleft()[1]
            if isinstance(record, BaroSample):
                estimator.update_baro(record)
                continue
            estimator.update_gps(record)
            if on_fix is not None:
                on_fix()
        if sample is not None:
            rows.append(nav_row(estimator.update_imu(sample)))
    return np.array(rows, np.float64).reshape(-1, STATE_COLUMNS)


def sample_log(samples: Samples, estimator: KernelEstimator) -> SampleLog:
    """Arrange samples by their times, for the smoother and the estimation of the GPS latency."""
    imu = samples.imu
    heights = [record for _, record in samples.aiding if isinstance(record, BaroSample)]
    fixes = [record for _, record in samples.aiding if isinstance(record, GpsFix)]
    return SampleLog(
        imu_time_us=imu.time_us,
        imu=imu_rows(imu.accel_b_mps2, imu.gyro_b_radps, imu.mag_b_ut, imu.flags),
        baro_time_us=np.array([height.time_us for height in heights], np.int64),
        baro_alt_m=np.array([height.alt_pressure_m for height in heights], np.float64),
        gps_time_us=np.array([fix.time_us for fix in fixes], np.int64),
        gps=np.array([*map(estimator.fix_row, fixes)], np.float64).reshape(-1, GPS_COLUMNS),
    )


def _in_order(log: SampleLog) -> SampleLog:
    """Sort samples that arrived late; ValueError if the clock was set back."""
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


def has_sample(cells: FloatArray) -> BoolArray:
    """Return which rows of a table contain an IMU sample."""
    return has_group(cells, RAW) | has_group(cells, SI)


def samples_of(blocks: Iterable[TableBlock], calibration: NodeCalibration) -> Samples:
    """Calibrate all rows of one aircraft."""
    chain = SensorChain(calibration)
    parts: list[Samples] = []
    begin: FusionState | None = None
    rows = 0
    for block in blocks:
        for row, comment in block.comments:
            if rows + row == 0 and isinstance(comment, FusionState):
                begin = comment
        parts.append(samples_of_cells(block.cells, chain))
        rows += len(block)
    parts = parts or [samples_of_cells(NO_ROWS, chain)]
    counts = np.cumsum([0, *(len(part.imu) for part in parts)]).tolist()
    columns = (
        np.concatenate([getattr(part.imu, name.name) for part in parts]) for name in fields(ImuLog)
    )
    aiding = [
        (before + k, record)
        for before, part in zip(counts, parts, strict=False)
        for k, record in part.aiding
    ]
    return Samples(ImuLog(*columns), aiding, calibration, begin)


def samples_of_cells(cells: FloatArray, chain: SensorChain) -> Samples:
    """Calibrate rows of a table: raw counts if present, else SI values as they are."""
    holds = has_sample(cells)
    rows = cells[holds]
    flags = rows[:, FLAGS].astype(np.int64)
    si = rows[:, SI].copy()
    has_counts = has_group(rows, RAW)
    if has_counts.any():
        accel, gyro, mag, temperature_degc, flags[has_counts] = chain.calibrated(
            rows[has_counts, RAW], flags[has_counts]
        )
        si[has_counts] = np.column_stack([accel, gyro, mag, temperature_degc])
    imu = ImuLog(rows[:, 0].astype(np.int64), si[:, 0:3], si[:, 3:6], si[:, 6:9], si[:, 9], flags)
    before: IntArray = np.cumsum(holds) - holds
    # Within a row the height precedes the fix.
    found: list[tuple[int, int, BaroSample | GpsFix]] = []
    heights = np.flatnonzero(has_group(cells, BARO)).tolist()
    for row, values in zip(heights, cells[heights, BARO].tolist(), strict=True):
        found.append((row, 0, chain.baro(BARO_CODEC.read(values))))
    fixes = np.flatnonzero(has_group(cells, GPS)).tolist()
    for row, values in zip(fixes, cells[fixes, GPS].tolist(), strict=True):
        found.append((row, 1, GPS_CODEC.read(values)))
    found.sort(key=lambda placed: placed[:2])
    return Samples(imu, [(int(before[row]), record) for row, _, record in found])


class Fusion:
    """Fuse the blocks of a table one after another, in the way the rows were fused live."""

    def __init__(
        self,
        vehicle_id: int,
        settings: AircraftSettings,
        *,
        follow: bool,
        played: FusedStates | None = None,
        correct: Correct | None = None,
    ) -> None:
        self._aircraft = Aircraft(vehicle_id, settings)
        self._follow = follow
        self._played = played
        self._correct = correct
        self.time_us: list[IntArray] = []
        """Times of the fused IMU samples."""
        self.refused: list[str] = []
        """Reasons why states in the file were not restored; the estimator then starts cold."""

    def block(self, block: TableBlock) -> TableBlock:
        """Return a block with the new states; rows without any record are left out."""
        cells = block.cells
        held = np.any([has_group(cells, group) for group in (BARO, GPS, RAW, SI)], axis=0)
        cells = cells[held]
        held_before = np.concatenate([[0], np.cumsum(held)]).tolist()
        fused: list[FloatArray] = []
        comments: list[tuple[int, TableComment]] = []
        begin = 0
        for row, comment in block.comments:
            end = held_before[row]
            if isinstance(comment, TableHeader | FusionState):
                fused.append(self._fused(cells[begin:end]))
                begin = end
            if self._handle(comment):
                comments.append((end, comment))
        fused.append(self._fused(cells[begin:]))
        return TableBlock(np.concatenate(fused), tuple(comments))

    def _handle(self, comment: TableComment) -> bool:
        """Handle a line that is not a row; return whether it is kept in the file."""
        if isinstance(comment, TableHeader):
            if self._follow:
                self._aircraft.change(settings_of(comment), 0, Outputs())
            return self._follow
        if isinstance(comment, FusionState):
            try:
                self._aircraft.restore(comment)
            except ValueError as error:
                self.refused.append(str(error))
                return False
        return True

    def _fused(self, cells: FloatArray) -> FloatArray:
        """Return rows with newly calibrated samples and newly fused states."""
        found = cells.copy()
        has_counts, holds = has_group(cells, RAW), has_sample(cells)
        samples = samples_of_cells(cells, self._aircraft.chain)
        log, played, estimator = samples.imu, self._played, self._aircraft.estimator
        self.time_us.append(log.time_us)

        def on_fix() -> None:
            if played is not None:
                played.latencies.append(latency_in_use(estimator))

        states = fuse(samples, estimator, on_fix=None if played is None else on_fix).states
        if self._correct is not None:
            states = self._correct(log.time_us, states)
        if played is not None:
            played.states.extend(states)
        # A row without an IMU sample has the time of its newest record.
        newest_us = np.where(has_group(cells, GPS), cells[:, GPS.start], cells[:, BARO.start])
        found[~holds, 0] = newest_us[~holds]
        found[holds & ~has_counts, NODE_ID] = 0.0
        found[holds, SI] = np.column_stack(
            [log.accel_b_mps2, log.gyro_b_radps, log.mag_b_ut, log.temperature_degc]
        )
        found[:, NAV] = np.nan
        found[holds, NAV] = np.column_stack([log.time_us, states])
        return found


def interpolated_positions(fixes: FloatArray, latency_s: float) -> Correct:
    """Replace fused positions by straight lines between fixes, as in the paper's playback.

    `fixes` are cells of `GPS`. States before the first fix and after the last one are unchanged.
    """
    types = fixes[:, FIX_TYPE - GPS.start]
    is_2d_or_3d = (types == GpsFixType.FIX_2D) | (types == GpsFixType.FIX_3D)
    fixes = fixes[is_2d_or_3d & (fixes[:, FIX_OK - GPS.start] == 1.0)]
    fix_us = np.maximum.accumulate(fixes[:, 0])
    lat, lon, alt = fixes[:, [FIX_LAT - GPS.start, FIX_LON - GPS.start, FIX_ALT - GPS.start]].T

    def correct(time_us: IntArray, states: FloatArray) -> FloatArray:
        arrival_us = time_us + round(latency_s * US_PER_S)
        after = np.searchsorted(fix_us, arrival_us)
        row = np.flatnonzero((after < len(fix_us)) & (arrival_us >= fix_us.min(initial=np.inf)))
        b, a = after[row], np.maximum(after[row] - 1, 0)
        share = (arrival_us[row] - fix_us[a]) / np.maximum(fix_us[b] - fix_us[a], 1)
        # The shorter direction, so that a flight across the date line does not circle the earth.
        east_deg = wrap_180((lon[b] - lon[a]) * DEG_PER_DEGE7)
        found = states.copy()
        found[row, NAV_LAT] = (lat[a] + share * (lat[b] - lat[a])) * DEG_PER_DEGE7
        found[row, NAV_LON] = wrap_180(lon[a] * DEG_PER_DEGE7 + share * east_deg)
        found[row, NAV_ALT] = alt[a] + share * (alt[b] - alt[a])
        return found

    return correct


def smoothed_states(smooth_us: IntArray, smoothed: FloatArray) -> Correct:
    """Replace each state by the smoothed one of its time; the sensor flags are kept."""

    def correct(time_us: IntArray, states: FloatArray) -> FloatArray:
        at = np.searchsorted(smooth_us, time_us).clip(0, max(len(smooth_us) - 1, 0))
        found = states.copy()
        known = np.flatnonzero(smooth_us[at] == time_us)
        found[known, :NAV_FLAGS] = smoothed[at[known], :NAV_FLAGS]
        flags = found[known, NAV_FLAGS].astype(np.int64) & ~VALID
        flags |= smoothed[at[known], NAV_FLAGS].astype(np.int64) & VALID
        found[known, NAV_FLAGS] = flags
        return found

    return correct
