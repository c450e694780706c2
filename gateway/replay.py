"""Fuse a recorded flight again: rows of a table through the pipeline, on the recorded clock."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Final

import msgspec
import numpy as np

from gateway import __version__
from gateway.flightlog.row import TableRow
from gateway.flightlog.table import TableHeader
from gateway.pipeline import Action, AircraftSettings, Pipeline
from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuCalibrated, ImuRaw, NavState
from gateway.units import DEG_PER_DEGE7, US_PER_S

LONGEST_SILENCE_US: Final = 1_000_000
"""In a longer one the pipeline's timers are not run through one by one."""


class Replay:
    """Feeds rows to a pipeline as if they arrived now.

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

    def take(self, row: TableRow | TableHeader) -> Iterator[tuple[int, Action]]:
        """Take one row, or a change of settings.

        Parameters
        ----------
        row : TableRow or TableHeader
            The next of the file.

        Yields
        ------
        tuple of int and Action
            Time on the recorded gateway clock, and what the pipeline decided.
        """
        if isinstance(row, TableHeader):
            if self._follow:
                self._pipeline.change(row.vehicle_id, settings_of(row))
            return
        for record in records_of(row):
            yield from self._wait(record.time_us)
            now_us = self._now_us if self._now_us is not None else record.time_us
            for action in self._pipeline.take(record, now_us):
                yield now_us, action

    def _wait(self, until_us: int) -> Iterator[tuple[int, Action]]:
        """Run what is due by time before the next record; the clock never falls."""
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
    """List a row's records in the order in which they were taken; counts before SI values."""
    records = (row.baro, row.gps, row.raw or row.imu)
    return [record for record in records if record is not None]


def header_for(aircraft: AircraftSettings, vehicle_id: int) -> TableHeader:
    """Tell what a table must say of the settings so that it can be fused again.

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
    """Read the settings back with which a table was recorded.

    Parameters
    ----------
    header : TableHeader
        Of the table.

    Returns
    -------
    AircraftSettings
        Sections that it does not have keep their defaults.

    Raises
    ------
    msgspec.ValidationError
        If another version wrote them, with settings that this one does not have.
    """
    sections = {**header.settings, "calibration": header.calibration}
    return msgspec.convert(sections, AircraftSettings)


class InterpolatedPosition:
    """The paper's playback: straight lines from fix to fix in place of the fused position.

    Parameters
    ----------
    fixes : iterable of GpsFix
        Of one aircraft, the whole flight.
    latency_s : float
        How much earlier than its arrival a fix was valid.
    """

    def __init__(self, fixes: Iterable[GpsFix], latency_s: float) -> None:
        usable = [
            (fix.time_us, fix.lat_dege7, fix.lon_dege7, fix.alt_amsl_m)
            for fix in fixes
            if fix.fix_ok and fix.fix_type in (GpsFixType.FIX_3D, GpsFixType.FIX_2D)
        ]
        track = np.array(sorted(usable), float).reshape(-1, 4)
        self._time_us = track[:, 0] - latency_s * US_PER_S
        self._lat_deg = track[:, 1] * DEG_PER_DEGE7
        # Unwrapped, so that a flight over the date line does not go round the earth.
        self._lon_deg = np.unwrap(track[:, 2] * DEG_PER_DEGE7, period=360.0)
        self._alt_m = track[:, 3]

    def __call__(self, state: NavState) -> NavState:
        """Put the interpolated position into a state; before and after the fixes it stays."""
        t = state.time_us
        if not len(self._time_us) or not self._time_us[0] <= t <= self._time_us[-1]:
            return state
        lon_deg = float(np.interp(t, self._time_us, self._lon_deg))
        return replace(
            state,
            lat_deg=float(np.interp(t, self._time_us, self._lat_deg)),
            lon_deg=(lon_deg + 180.0) % 360.0 - 180.0,
            alt_amsl_m=float(np.interp(t, self._time_us, self._alt_m)),
        )
