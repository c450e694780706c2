"""Aircraft of a recording and their heights, read before it is played."""

import math
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gateway.recordings.answers import FIRST_GROUND_STATION, is_station
from gateway.recordings.columns import TableRow
from gateway.recordings.files import FileKind, kind_of, read_chunks
from gateway.recordings.formats.maps import TrackPoint, VehicleTrack, tracks_of_frames
from gateway.recordings.index import parts_together
from gateway.recordings.opening import TlogFile
from gateway.recordings.reading import recorded_frames
from gateway.recordings.table import TableHeader, TableReader
from gateway.units import US_PER_S

PROFILE_POINTS: Final = 400
HEIGHT_GAP_US: Final = US_PER_S // 5
RECORDED: Final = "recorded"
FUSED_AGAIN: Final = "fused again"


@dataclass(frozen=True, slots=True)
class Profile:
    """Height over time."""

    time_s: tuple[float, ...] = ()
    """Since its begin."""
    alt_amsl_m: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class RecordedAircraft:
    """One aircraft of a recording."""

    recorded_id: int
    """Its recorded MAVLink system id."""
    origin: str
    """`RECORDED`, or `FUSED_AGAIN` for one that is fused again while it plays."""
    profile: Profile
    """Empty if no height was recorded."""


def look_into(files: Sequence[Path]) -> list[list[RecordedAircraft]]:
    """Read which aircraft the files hold.

    Parameters
    ----------
    files : sequence of Path
        Tlogs and tables of one recording.

    Returns
    -------
    list of list of RecordedAircraft
        One list for each flight that a player makes of these files, in its order.

    Raises
    ------
    OSError
        If one cannot be read.
    """
    flights = []
    for parts in parts_together(files):
        if kind_of(parts[0]) is FileKind.TLOG:
            flights.append(_of_tlogs(parts))
        else:
            flights.append([_of_tables(parts)])
    return flights


def free_ids(count: int, taken: Collection[int]) -> range:
    """Find consecutive free system ids, the highest possible.

    Parameters
    ----------
    count : int
        Number of ids.
    taken : collection of int
        Ids of others.

    Raises
    ------
    ValueError
        If there are not enough.
    """
    for first in range(FIRST_GROUND_STATION - count, 0, -1):
        wanted = range(first, first + count)
        if not any(system_id in wanted for system_id in taken):
            return wanted
    raise ValueError(f"{count} more aircraft have no room beside those that are shown")


def _of_tlogs(parts: Sequence[Path]) -> list[RecordedAircraft]:
    begins, origins, stations = list[int](), set[int](), set[int]()
    for part in parts:
        with closing(TlogFile(part)) as tlog:
            begins.append(tlog.index.first_us or 0)
            origins |= tlog.index.origins
            stations |= tlog.index.stations
    vehicles = sorted({origin >> 8 for origin in origins if not is_station(origin, stations)})
    tracks = {track.name: track for track in tracks_of_frames(recorded_frames(parts, None), None)}
    none = VehicleTrack("")
    return [
        RecordedAircraft(
            system_id, RECORDED, _profile(tracks.get(f"system {system_id}", none).points, begins[0])
        )
        for system_id in vehicles
    ]


def _of_tables(parts: Sequence[Path]) -> RecordedAircraft:
    vehicle_id, points, begin_us = 1, list[TrackPoint](), None
    for part in parts:
        reader = TableReader()
        for chunk in read_chunks(part, None):
            for event in reader.feed(chunk):
                if isinstance(event, TableHeader):
                    vehicle_id = event.vehicle_id
                elif isinstance(event, TableRow):
                    begin_us = event.time_us if begin_us is None else begin_us
                    _note_height(event, points)
    return RecordedAircraft(vehicle_id, FUSED_AGAIN, _profile(points, begin_us or 0))


def _note_height(row: TableRow, points: list[TrackPoint]) -> None:
    state = row.state
    if state is None or not math.isfinite(state.alt_amsl_m):
        return
    if points and row.time_us - points[-1].time_us < HEIGHT_GAP_US:
        return
    points.append(TrackPoint(row.time_us, state.lat_deg, state.lon_deg, state.alt_amsl_m))


def _profile(points: Sequence[TrackPoint], begin_us: int) -> Profile:
    kept = points[:: max(1, len(points) // PROFILE_POINTS)]
    return Profile(
        tuple((point.time_us - begin_us) / US_PER_S for point in kept),
        tuple(point.alt_amsl_m for point in kept),
    )
