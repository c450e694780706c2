"""A flight as its recording contains it, for pilots: track, attitude, battery, modes, texts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from gateway.analysis.flight import Flight
from gateway.recordings.columns import FloatArray
from gateway.recordings.files import FlightError
from gateway.recordings.flight_facts import FlightFacts, FlightTally, FlightTrackPoints
from gateway.recordings.formats.maps import point_of_fix
from gateway.recordings.recorded_table import ReadOptions, RecordedTable
from gateway.recordings.recording import open_recordings
from gateway.recordings.tallies import MessageTally, RowTally
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.recordings.workshop.joining import joined_rows
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import IntArray, LocalFrame, Position

MAX_SHOWN_TEXTS: Final = 200


@dataclass(frozen=True, slots=True)
class FlightEvent:
    """An event at one moment."""

    time_s: float
    """Time since the first record."""
    kind: str
    """Kind of mark on the timeline: flight, mode, gps, link or text."""
    text: str


@dataclass(frozen=True)
class PilotFlight:
    """The flight of one vehicle, as its recording contains it."""

    name: str
    tally: FlightTally
    positions: str | None
    """Source of the positions; None without any."""
    vehicle_id: int = 1
    zero_us: int = 0
    """Civil time of the recording's time zero, µs since 1970."""

    @cached_property
    def facts(self) -> FlightFacts:
        """Its facts."""
        return self.tally.facts()

    @cached_property
    def points(self) -> FlightTrackPoints:
        """Its positions."""
        return self.tally.points()

    @property
    def begin_us(self) -> int:
        """Civil time of the first record, µs since 1970; small if it is not known."""
        return self.zero_us + (self.facts.first_us or 0)

    def seconds(self, time_us: FloatArray | IntArray | Sequence[float]) -> FloatArray:
        """Convert times of the recording to seconds since its first record."""
        return (np.asarray(time_us, np.float64) - (self.facts.first_us or 0)) / US_PER_S

    @cached_property
    def frame(self) -> LocalFrame | None:
        """Local frame in metres around home, or around the first position; None without any."""
        points, home = self.points, self.tally.home
        if not len(points):
            return None
        if home is not None:
            return LocalFrame(home.lat_deg, home.lon_deg, 0.0)
        return LocalFrame(float(points.lat_deg[0]), float(points.lon_deg[0]), 0.0)

    @cached_property
    def events(self) -> list[FlightEvent]:
        """Events in the order of their times."""
        facts, tally = self.facts, self.tally
        lost = [("gps", "GPS", begin, end - begin) for begin, end in facts.gps_outages_us or ()]
        lost += [("link", "link", g.time_us, round(g.duration_s * US_PER_S)) for g in facts.gaps]
        found = [
            *self._flight_events(),
            *(
                self._event(begin_us, kind, f"{name} lost for {length_us / US_PER_S:.1f} s")
                for kind, name, begin_us, length_us in lost
            ),
            *(self._event(time_us, "mode", f"mode {mode}") for time_us, mode in tally.modes),
            *(
                self._event(time_us, "text", text)
                for time_us, _, text in tally.texts[:MAX_SHOWN_TEXTS]
            ),
        ]
        return sorted(found, key=lambda event: event.time_s)

    def _event(self, time_us: float, kind: str, text: str) -> FlightEvent:
        return FlightEvent(float(self.seconds([time_us])[0]), kind, text)

    def _flight_events(self) -> list[FlightEvent]:
        points, found = self.points, []
        for index in np.flatnonzero(np.diff(points.airborne)) + 1:
            text = "in the air" if points.airborne[index] else "on the ground"
            found.append(self._event(points.time_us[index], "flight", text))
        for values, form in (
            (points.height_m, "highest, {:.0f} m"),
            (points.speed_mps, "fastest, {:.1f} m/s"),
        ):
            if np.isfinite(values).any():
                top = int(np.nanargmax(values))
                found.append(self._event(points.time_us[top], "flight", form.format(values[top])))
        return found


def read_pilot_flight(files: Sequence[Path], options: ReadOptions, name: str) -> PilotFlight:
    """Read the parts of a recording of any format.

    Of several vehicles, it is the one that `options` select, or else the first with a position.
    Raises FlightError if there is no vehicle, OSError if a file cannot be read.
    """
    flight = FlightToWrite(open_recordings(files), options)
    if not flight.has_messages:
        return _flight_of_table(joined_rows(flight.recordings, options), name)
    found = MessageTally(flight.senders, with_attitude=True)
    found.add_all(flight.chosen())
    known = [found.vehicles[number] for number in sorted(found.vehicles)]
    if options.system_id in found.vehicles:
        known = [found.vehicles[options.system_id]]
    if not known:
        raise FlightError(f"{name}: contains no vehicle")
    tally = next((one for one in known if one.positions is not None), known[0])
    return PilotFlight(name, tally, tally.positions, tally.vehicle.origin >> 8)


def _flight_of_table(table: RecordedTable, name: str) -> PilotFlight:
    tally = RowTally()
    for block in table.blocks:
        tally.add(block)
    header = table.header
    zero_us = header.unix_us_at_zero or 0
    return PilotFlight(name, tally, tally.positions, header.vehicle_id, zero_us)


def pilot_flight_of_samples(flight: Flight) -> PilotFlight:
    """Return a flight of which only samples and fixes are known, as of the simulator."""
    tally, fixes = FlightTally(), flight.fixes
    tally.span.add_all(flight.time_us)
    for fix in fixes:
        tally.add_gps(fix.time_us, fixed=fix.fix_ok)
        if fix.fix_ok:
            at = point_of_fix(fix)
            speed_mps = math.hypot(*fix.vel_n_mps[:2])
            where = (at.lat_deg, at.lon_deg, at.alt_amsl_m)
            tally.add_position(fix.time_us, Position(*where, NAN, speed_mps, fix.vel_n_mps))
    utc = next((fix.utc_us - fix.time_us for fix in fixes if fix.utc_us is not None), 0)
    return PilotFlight(flight.name, tally, "GPS fixes", zero_us=utc)
