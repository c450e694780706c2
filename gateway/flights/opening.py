"""Recordings opened for the player, with the times and ids of their vehicles."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from gateway.edges.disk.fused_tlog import FusedTlog
from gateway.edges.disk.recording_streams import FileKind, kind_of
from gateway.edges.disk.recordings import parts_together
from gateway.edges.disk.tlog_file import TlogFile
from gateway.flightlog.answers import LogAnswers
from gateway.flightlog.tlog.recorded_commands import FIRST_GROUND_STATION, is_station
from gateway.flightlog.track import Source, Track
from gateway.flights.flight_terms import NO_RECORDING, FlightError
from gateway.flights.reading import ReadOptions
from gateway.flights.recorded_fusion import RecordedFusion, end_of


@dataclass(slots=True)
class OpenFlight:
    """One open recording, of any number of parts."""

    sources: list[Source] = field(default_factory=list)
    answers: LogAnswers = field(default_factory=LogAnswers)
    remarks: list[str] = field(default_factory=list)
    """What the user should know."""

    @property
    def first_us(self) -> int:
        """Civil time of its begin."""
        return min(source.index.first_us or 0 for source in self.sources)

    @property
    def last_us(self) -> int:
        """Civil time of its end, as far as that is known."""
        return max(source.last_us for source in self.sources)

    @property
    def vehicles(self) -> list[int]:
        """System ids of all senders that are not ground stations."""
        return sorted(
            {
                origin >> 8
                for source in self.sources
                for origin in source.index.origins
                if not is_station(origin, source.index.stations)
            }
        )


@dataclass(frozen=True, slots=True)
class PlayedFlight:
    """A recording as it is played: when, and under which system ids."""

    tracks: tuple[Track, ...]
    answers: LogAnswers
    shift_us: int
    """From the recording's time to the player's."""
    system_ids: dict[int, int]
    """Of its vehicles: recorded and played."""


def open_flights(
    files: Sequence[Path], options: ReadOptions, opened: ExitStack
) -> list[OpenFlight]:
    """Index the tlogs, and begin to fuse other files; the parts of a recording together.

    Parameters
    ----------
    files : sequence of Path
        Anything that `mavgate play` takes.
    options : ReadOptions
        How to fuse.
    opened : ExitStack
        Closes the files.

    Raises
    ------
    FlightError
        If there is nothing to play in one of them.
    OSError
        If one cannot be read.
    """
    flights = []
    for parts in parts_together(files):
        flight = OpenFlight()
        if kind_of(parts[0]) is FileKind.TLOG:
            for file in parts:
                tlog = TlogFile(file, options.progress, flight.answers, options.unpacked_limit)
                opened.callback(tlog.close)
                flight.sources.append(tlog)
                flight.remarks += [f"{file}: {remark}" for remark in tlog.remarks]
        else:
            fusion = RecordedFusion(parts, options)
            for frame in fusion.introduction():
                flight.answers.note_frame(frame, 0)
            fused = FusedTlog(fusion.frames(), end_of(parts[-1], options), flight.answers)
            opened.callback(fused.close)
            flight.sources.append(fused)
            flight.remarks += [f"{parts[0]}: {remark}" for remark in fusion.remarks]
        for source, file in zip(flight.sources, parts, strict=False):
            if not source.index.count:
                raise FlightError(f"{file}: {NO_RECORDING}")
        flights.append(flight)
    return flights


def lay_out(
    flights: Sequence[OpenFlight], wished: Sequence[int] = (), *, with_commands: bool
) -> list[PlayedFlight]:
    """Give each vehicle its own system id, and recordings of different days the same start.

    Parameters
    ----------
    flights : sequence of OpenFlight
        At least one.
    wished : sequence of int
        System ids for the first vehicles of the recordings, as many as are given; the other
        vehicles of a recording get the following ids.
    with_commands : bool
        Play messages of stations and other requests to a vehicle too.
    """
    begin_us, end_us = flights[0].first_us, flights[0].last_us
    used: set[int] = set()
    played = []
    for number, flight in enumerate(flights):
        together = flight.first_us <= end_us and begin_us <= flight.last_us
        shift_us = 0 if together else begin_us - flight.first_us
        system_ids: dict[int, int] = {}
        for place, system_id in enumerate(flight.vehicles):
            wanted = wished[number] + place if number < len(wished) else system_id
            while wanted in used or wanted >= FIRST_GROUND_STATION:
                wanted = wanted % (FIRST_GROUND_STATION - 1) + 1
            used.add(wanted)
            system_ids[system_id] = wanted
        changed = {old: new for old, new in system_ids.items() if old != new}
        tracks = tuple(
            Track(source, shift_us=shift_us, system_ids=changed, with_commands=with_commands)
            for source in flight.sources
        )
        played.append(PlayedFlight(tracks, flight.answers, shift_us, system_ids))
    return played
