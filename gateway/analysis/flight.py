"""One flight to analyse: its calibrated samples, the truth if known, and its fused tracks.

Flights from all sources have the same form: the samples of a recording in the order in which they
were processed, on the gateway clock.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.aircraft import AircraftSettings
from gateway.estimation.columns import NAV_ALT, NAV_FLAGS, NAV_LAT, NAV_LON, NAV_QUAT, NAV_VEL
from gateway.estimation.reference import is_usable
from gateway.estimation.select import ESTIMATORS, Estimator
from gateway.recordings.columns import NAV, NODE_TIME, RAW, has_group
from gateway.recordings.fuse import (
    SMOOTHED_ESTIMATOR,
    FusionSettings,
    Samples,
    fuse,
    has_sample,
    samples_of,
    samples_of_cells,
    with_estimator,
)
from gateway.recordings.recorded_fusion import check_latency, open_table
from gateway.recordings.recorded_table import ReadOptions, RecordedTable
from gateway.recordings.recording import open_recordings
from gateway.recordings.table import TableBlock
from gateway.recordings.workshop.joining import joined_rows
from gateway.records import BaroSample, FusionState, GpsFix, NavFlags
from gateway.sensing.calibration import IDENTITY3, Correction, NodeCalibration, new_field_ut
from gateway.sensing.chain import ImuLog, SensorChain
from gateway.units import DEG_PER_DEGE7, US_PER_S
from gateway.vehicle_state.positions import LocalFrame

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SETTLING_US: Final = 5_000_000
"""Time after the first fix from which samples are scored."""
NEAR_US: Final = 50_000
"""Maximum difference between the times of a state and of the sample it is compared with."""


@dataclass(frozen=True, slots=True)
class FlightTrack:
    """Attitude, position and velocity at N times."""

    time_us: IntArray
    q_nb: FloatArray
    """Shape (N, 4), scalar first; NaN if unknown."""
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    vel_n_mps: FloatArray
    """Shape (N, 3), NED."""


@dataclass(frozen=True, slots=True)
class Reference:
    """The reference for an estimate, at the times of the IMU samples."""

    track: FlightTrack
    is_exact: bool
    """Whether it is the exact truth; otherwise it is another estimate."""
    description: str


@dataclass(frozen=True, slots=True)
class Flight:
    """The samples of one flight."""

    name: str
    description: str
    fusion: FusionSettings
    """The settings for this flight, including its GPS latency."""
    samples: Samples
    scored: BoolArray
    """Shape (N,), whether a sample is scored."""
    mag_uncalibrated_b_ut: FloatArray | None = None
    node_time_us: IntArray | None = None
    """Time of each sample on the node's clock."""
    reference: Reference | None = None
    recorded: FlightTrack | None = None
    """The states that were fused in flight."""

    @property
    def time_us(self) -> IntArray:
        """Shape (N,), times of the IMU samples."""
        return self.samples.imu.time_us

    @property
    def imu(self) -> ImuLog:
        """The calibrated IMU samples; the magnetic field is NaN in samples without a new one."""
        return self.samples.imu

    @property
    def fixes(self) -> list[GpsFix]:
        """The GPS fixes in the order of their arrival."""
        return [record for _, record in self.samples.aiding if isinstance(record, GpsFix)]

    @property
    def usable(self) -> BoolArray:
        """Which of the fixes an estimator uses."""
        reference = self.fusion.estimation.reference
        return np.array([is_usable(fix, reference) for fix in self.fixes], np.bool_)

    @property
    def baro(self) -> tuple[IntArray, FloatArray]:
        """Times in µs and standard-atmosphere heights in m of the barometer samples."""
        found = [record for _, record in self.samples.aiding if isinstance(record, BaroSample)]
        times_us = np.array([record.time_us for record in found], np.int64)
        return times_us, np.array([record.alt_pressure_m for record in found], np.float64)

    @property
    def time_s(self) -> FloatArray:
        """Seconds since the first sample."""
        return self.seconds(self.time_us)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.time_s[-1])

    @property
    def rate_hz(self) -> float:
        """Rate of IMU samples, from the median interval; from the mean one if that is zero."""
        intervals_us = np.diff(self.time_us)
        typical_us = float(np.median(intervals_us)) or max(float(np.mean(intervals_us)), 1.0)
        return US_PER_S / typical_us

    @property
    def latency_s(self) -> float:
        """Age of a fix at its arrival."""
        return self.fusion.estimation.reference.gps_latency_s

    def seconds(self, time_us: IntArray) -> FloatArray:
        """Convert gateway times to seconds since the first sample."""
        return np.asarray((time_us - self.time_us[0]) / US_PER_S, np.float64)

    def with_fixes(self, keep: Sequence[bool] | BoolArray) -> "Flight":
        """Return the same flight with the selected fixes only."""
        kept = iter(keep)
        aiding = [(k, r) for k, r in self.samples.aiding if not isinstance(r, GpsFix) or next(kept)]
        return replace(self, samples=Samples(self.samples.imu, aiding))


@dataclass(frozen=True, slots=True)
class Fixes:
    """The usable fixes of a flight as arrays."""

    arrival_us: IntArray
    valid_us: IntArray
    """Time of validity of each fix."""
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    vel_n_mps: FloatArray
    """Shape (M, 3)."""

    def __len__(self) -> int:
        return len(self.arrival_us)


def fixes_of(flight: Flight) -> Fixes:
    """Return the fixes that an estimator uses."""
    used = [*compress(flight.fixes, flight.usable)]
    arrival = np.array([fix.time_us for fix in used], np.int64)
    return Fixes(
        arrival_us=arrival,
        valid_us=arrival - round(flight.latency_s * US_PER_S),
        lat_deg=np.array([fix.lat_dege7 for fix in used]) * DEG_PER_DEGE7,
        lon_deg=np.array([fix.lon_dege7 for fix in used]) * DEG_PER_DEGE7,
        alt_amsl_m=np.array([fix.alt_amsl_m for fix in used], np.float64),
        vel_n_mps=np.array([fix.vel_n_mps for fix in used], np.float64).reshape(-1, 3),
    )


def local_frame(flight: Flight) -> LocalFrame | None:
    """Return a frame with its origin at the first usable fix; None without any."""
    fixes = fixes_of(flight)
    if not len(fixes):
        return None
    return LocalFrame(float(fixes.lat_deg[0]), float(fixes.lon_deg[0]), float(fixes.alt_amsl_m[0]))


def flight_of_files(
    files: Sequence[Path],
    options: ReadOptions,
    *,
    name: str,
    description: str = "",
    checked: bool = False,
) -> tuple[Flight, RecordedTable, AircraftSettings]:
    """Read the parts of a recording as one flight; also return its table and its settings.

    With `checked`, a remark is added if the motion contradicts the latency of a recording.
    FlightError or OSError if a file cannot be read, ValueError for fewer than two IMU samples.
    """
    recordings = open_recordings(files)
    table, aircraft = open_table(recordings, options)
    if checked and recordings[0].is_own:
        check_latency(recordings[0], table, aircraft)
    fusion = FusionSettings(estimation=aircraft.estimation)
    flight = flight_of_blocks(
        table.blocks, aircraft.calibration, fusion, name=name, description=description
    )
    return flight, table, aircraft


def flight_of_blocks(
    blocks: Iterable[TableBlock],
    calibration: NodeCalibration,
    fusion: FusionSettings,
    *,
    name: str,
    description: str,
) -> Flight:
    """Build a flight from rows; ValueError if there are fewer than two IMU samples."""
    counts: list[FloatArray] = []
    states: list[FloatArray] = []

    def noted() -> Iterator[TableBlock]:
        for block in blocks:
            holds = block.cells[has_sample(block.cells)]
            counts.append(np.column_stack([holds[:, NODE_TIME], holds[:, RAW]]))
            states.append(block.cells[has_group(block.cells, NAV)][:, NAV])
            yield block

    samples = samples_of(noted(), calibration)
    if len(samples.imu) < 2:
        raise ValueError(f"{name}: {len(samples.imu)} IMU samples are not a flight")
    flight = Flight(name, description, fusion, samples, np.ones(len(samples.imu), np.bool_))
    flight = replace(flight, scored=_settled(flight))
    raw = np.concatenate(counts)
    if not np.isnan(raw).any():
        turned = Correction(calibration.mag_mounting, IDENTITY3, (0.0, 0.0, 0.0))
        flight = replace(
            flight,
            node_time_us=raw[:, 0].astype(np.int64),
            mag_uncalibrated_b_ut=turned.apply_all(new_field_ut(raw[:, 1:], samples.imu.flags)),
        )
    return replace(flight, recorded=_recorded_states(flight, states))


def _settled(flight: Flight) -> BoolArray:
    """Return the samples from the time on when any estimator should have converged."""
    used = compress(flight.fixes, flight.usable)
    start_us = next((fix.time_us for fix in used), int(flight.time_us[0]))
    return np.asarray(flight.time_us >= start_us + SETTLING_US)


def _recorded_states(flight: Flight, cells: Sequence[FloatArray]) -> FlightTrack | None:
    """Return states from the columns `NAV` of a table at the samples' times; None without any."""
    states = np.concatenate(cells)
    if not len(states):
        return None
    return at_times(track_of(states[:, 0].astype(np.int64), states[:, 1:]), flight.time_us)


def fuse_track(flight: Flight, settings: FusionSettings) -> FlightTrack:
    """Fuse a flight causally, from the samples only, with the estimator in the settings."""
    estimator = flight.samples.estimator_or_cold(settings.estimation)
    return track_of(flight.time_us, fuse(flight.samples, estimator).states)


def tracks_by_estimator(
    files: Sequence[Path], options: ReadOptions, step_us: int
) -> tuple[int, dict[str, FlightTrack]]:
    """Fuse a recording with each estimator, and keep a state every `step_us`.

    The rows are not held in memory. Also returns the civil time of clock time zero, or 0. Raises
    FlightError or OSError if a file cannot be read, ValueError for fewer than two IMU samples.
    """
    recordings = open_recordings(files)
    _, aircraft = open_table(recordings, options, keep=False)
    table = joined_rows(recordings, options)
    return table.header.unix_us_at_zero or 0, _tracks_of(table.blocks, aircraft, step_us)


def _tracks_of(
    blocks: Iterable[TableBlock], aircraft: AircraftSettings, step_us: int
) -> dict[str, FlightTrack]:
    chain, newest = SensorChain(aircraft.calibration), -1
    estimators: dict[str, Estimator] = {}
    times_us: list[IntArray] = []
    states: dict[str, list[FloatArray]] = {name: [] for name in ESTIMATORS}
    for block in blocks:
        samples = samples_of_cells(block.cells, chain)
        at_begin = [comment for row, comment in block.comments if row == 0]
        begin = next((one for one in at_begin if isinstance(one, FusionState)), None)
        samples = replace(samples, calibration=aircraft.calibration, begin=begin)
        if not estimators and (len(block) or begin):
            for name in ESTIMATORS:
                estimation = with_estimator(aircraft, name).estimation
                estimators[name] = samples.estimator_or_cold(estimation)
        step = samples.imu.time_us // step_us
        kept = np.flatnonzero(np.diff(np.maximum.accumulate(step), prepend=newest) > 0)
        newest = max(newest, int(step.max(initial=newest)))
        times_us.append(samples.imu.time_us[kept])
        for name, estimator in estimators.items():
            states[name].append(fuse(samples, estimator).states[kept])
    if sum(map(len, times_us)) < 2:
        raise ValueError("its IMU samples are too few for a flight")
    moments_us = np.concatenate(times_us)
    return {name: track_of(moments_us, np.concatenate(of)) for name, of in states.items()}


def smooth_track(flight: Flight, settings: FusionSettings) -> tuple[FlightTrack, float]:
    """Smooth a flight; also return the GPS latency used, s. See `fuse`."""
    estimation = with_estimator(settings, SMOOTHED_ESTIMATOR).estimation
    estimator = flight.samples.estimator_or_cold(estimation)
    fused = fuse(flight.samples, estimator, smoothed=True)
    # Smoothed states are in order of time; the samples are not, if one came late.
    states = np.empty_like(fused.states)
    states[np.argsort(flight.time_us, kind="stable")] = fused.states
    return track_of(flight.time_us, states), fused.latency_s


def track_of(time_us: IntArray, states: FloatArray) -> FlightTrack:
    """Return the values that the flags of fused states mark as valid, with NaN for others.

    An attitude without a heading is valid only if the track has no heading at all.
    """
    flags = states[:, NAV_FLAGS].astype(np.int64)

    def valid(flag: NavFlags, first: int, count: int = 0) -> FloatArray:
        known = (flags & int(flag)) != 0
        if not count:
            return np.where(known, states[:, first], np.nan)
        return np.where(known[:, np.newaxis], states[:, first : first + count], np.nan)

    q_nb = valid(NavFlags.ATTITUDE_VALID, NAV_QUAT, 4)
    headed = (flags & int(NavFlags.HEADING_VALID)) != 0
    if headed.any():
        q_nb[: int(np.argmax(headed))] = np.nan
    return FlightTrack(
        time_us,
        q_nb,
        valid(NavFlags.POSITION_VALID, NAV_LAT),
        valid(NavFlags.POSITION_VALID, NAV_LON),
        valid(NavFlags.ALTITUDE_VALID, NAV_ALT),
        valid(NavFlags.VELOCITY_VALID, NAV_VEL, 3),
    )


def compared_with(flight: Flight, blocks: Iterable[TableBlock], name: str) -> Flight:
    """Use the states of a recording as a flight's reference.

    Raises ValueError if the recording contains no states.
    """
    states = [block.cells[has_group(block.cells, NAV)][:, NAV] for block in blocks]
    track = _recorded_states(flight, states) if states else None
    if track is None:
        raise ValueError(f"{name}: contains no states to compare with")
    return replace(
        flight, reference=Reference(track, is_exact=False, description=f"the states in {name}")
    )


def at_times(track: FlightTrack, time_us: IntArray) -> FlightTrack:
    """Return the rows of a track nearest to given times; NaN if none is within `NEAR_US`."""
    after = np.searchsorted(track.time_us, time_us).clip(1, max(len(track.time_us) - 1, 1))
    before, after = after - 1, after.clip(0, len(track.time_us) - 1)
    late = track.time_us[after] - time_us < time_us - track.time_us[before]
    nearest = np.where(late, after, before)
    near = np.abs(track.time_us[nearest] - time_us) <= NEAR_US

    def chosen(values: FloatArray) -> FloatArray:
        return np.where(near if values.ndim == 1 else near[:, np.newaxis], values[nearest], np.nan)

    columns = (track.q_nb, track.lat_deg, track.lon_deg, track.alt_amsl_m, track.vel_n_mps)
    return FlightTrack(time_us, *map(chosen, columns))
