"""Fuse a recorded flight again: rows of a table through the pipeline, on the recorded clock."""

from collections.abc import Iterable, Iterator
from typing import Any, Final

import msgspec
import numpy as np

from gateway import __version__
from gateway.aircraft import Action, AircraftSettings
from gateway.flightlog.table.cells import FLAGS, FloatArray, has_group
from gateway.flightlog.table.row import (
    BARO,
    GPS,
    RAW,
    SI,
    TableRow,
    baro_of_cells,
    fix_of_cells,
)
from gateway.flightlog.table.table import REMARK, TableHeader, TableMark
from gateway.geometry.angle import wrap_180
from gateway.pipeline import Pipeline
from gateway.records import (
    BaroRaw,
    FusionState,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuRaw,
    NavState,
    NodeStatus,
)
from gateway.sensing.chain import SensorChain
from gateway.sensing.imu_log import ImuLog, IntArray
from gateway.units import DEG_PER_DEGE7, US_PER_S
from gateway.vehicle.telemetry.events import INFO, StatusText

LONGEST_SILENCE_US: Final = 1_000_000
"""In a longer gap the pipeline's timers are not run one by one."""


class Replay:
    """Feed rows to a pipeline as if they arrived now.

    Parameters
    ----------
    pipeline : Pipeline
        Fresh, with the settings to fuse with.
    follow : bool
        Whether to change settings where they were changed in flight.
    """

    def __init__(self, pipeline: Pipeline, *, follow: bool = True) -> None:
        self._pipeline = pipeline
        self._follow = follow
        self._now_us: int | None = None

        self.refused: list[str] = []
        """Why states of the file were not restored; then the estimator starts cold."""

    def take(
        self, row: TableRow | TableHeader | TableMark | FusionState | NodeStatus
    ) -> Iterator[tuple[int, Action]]:
        """Process one row, a change of settings, a mark, or a state to restore.

        Parameters
        ----------
        row : TableRow, TableHeader, TableMark, FusionState or NodeStatus
            The next of the file.

        Yields
        ------
        tuple of int and Action
            Time on the recorded gateway clock, and the pipeline's action.
        """
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
        if self._now_us is None or now_us - self._now_us > LONGEST_SILENCE_US:
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
        Rows that each have a sample; see `gateway.flightlog.table.cells`.
    chain : SensorChain
        Of their aircraft.
    """
    time_us = cells[:, 0].astype(np.int64)
    return chain.imu_si_log(time_us, *calibrated_of(cells, chain))


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
    for order, group, make in ((0, BARO, baro_of_cells), (1, GPS, fix_of_cells)):
        rows = np.flatnonzero(has_group(cells, group))
        for row, values in zip(rows.tolist(), cells[rows, group].tolist(), strict=True):
            record = make(values, vehicle_id)
            if record is not None:
                found.append((row, order, record))
    found.sort(key=lambda heard: heard[:2])
    return [(int(before[row]), record) for row, _, record in found]


def header_for(aircraft: AircraftSettings, vehicle_id: int) -> TableHeader:
    """Return the header that a table needs to be fused again.

    Parameters
    ----------
    aircraft : AircraftSettings
        Those that the flight is fused with; the signing passphrase stays out of the file.
    vehicle_id : int
        The aircraft of the table.

    Returns
    -------
    TableHeader
        Version, settings and calibration; the rest is the recorder's to fill in.
    """
    sections: dict[str, Any] = msgspec.to_builtins(aircraft)
    sections["vehicle"].pop("signing_passphrase")
    calibration = sections.pop("calibration")
    return TableHeader(
        mavgate_version=__version__,
        vehicle_id=vehicle_id,
        settings=sections,
        calibration=calibration,
    )


def settings_of(header: TableHeader) -> AircraftSettings:
    """Return the settings with which a table was recorded.

    Parameters
    ----------
    header : TableHeader
        Of the table.

    Returns
    -------
    AircraftSettings
        Absent sections keep their defaults.

    Raises
    ------
    msgspec.ValidationError
        If another version wrote them, with settings that this one does not have.
    """
    sections = {**header.settings, "calibration": header.calibration}
    return msgspec.convert(sections, AircraftSettings)


class InterpolatedPosition:
    """The paper's playback: straight lines between fixes instead of the fused position.

    Parameters
    ----------
    fixes : iterable of GpsFix
        Of one aircraft, in the order of their arrival; read only as far as the states go.
    latency_s : float
        How much earlier than its arrival a fix was valid.
    """

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
