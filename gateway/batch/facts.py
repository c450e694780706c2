"""Flights of the catalogue: their facts as columns, and their simplified tracks."""

from collections.abc import Iterator, Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.geometry.angle import wrap_180
from gateway.recordings.flight_facts import FlightTrackPoints
from gateway.recordings.moment import civil_time
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.recordings.summary import Summary, VehicleInfo
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import LocalFrame, TrackPoint

TOLERANCE_M: Final = 3.0
"""Tolerance of a simplified track, less than the error of GPS."""
MAX_POSITIONS: Final = 400
"""Maximum positions of a track: a day of circling gets a coarser track, not a larger one."""

Segments = list[list[TrackPoint]]
"""The uninterrupted parts of a track."""


def simplified(points: Sequence[TrackPoint]) -> list[TrackPoint]:
    """Leave out points that are within a tolerance of the straight lines between the others."""
    if len(points) < 3:
        return list(points)
    lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points]).T
    frame = LocalFrame(points[0].lat_deg, points[0].lon_deg, 0.0)
    plane, tolerance_m = frame.local_m(lat_deg, lon_deg), TOLERANCE_M
    while np.count_nonzero(kept := _kept(plane, tolerance_m)) > MAX_POSITIONS:
        tolerance_m *= 2.0
    return [point for point, keep in zip(points, kept.tolist(), strict=True) if keep]


def _kept(plane: NDArray[np.float64], tolerance_m: float) -> NDArray[np.bool_]:
    kept = np.zeros(len(plane), np.bool_)
    kept[[0, -1]] = True
    stretches = [(0, len(plane) - 1)]
    while stretches:
        begin, end = stretches.pop()
        if end - begin < 2:
            continue
        away = _distances_m(plane[begin + 1 : end], plane[begin], plane[end])
        farthest = int(np.argmax(away))
        if away[farthest] > tolerance_m:
            middle = begin + 1 + farthest
            kept[middle] = True
            stretches += [(begin, middle), (middle, end)]
    return kept


def _distances_m(
    points: NDArray[np.float64], begin: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    line = end - begin
    length2 = float(line @ line)
    share = ((points - begin) @ line / length2).clip(0.0, 1.0) if length2 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - begin - share[:, np.newaxis] * line, axis=1))


class CataloguedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Facts of one flight in the catalogue; None is unknown.

    The names are also the names of columns that a query can use.
    """

    vehicle: int | None = None
    began: str | None = None
    """Start in UTC, as YYYY-MM-DD HH:MM:SS."""
    duration: float | None = None
    """Time from the first record to the last, s."""
    distance: float | None = None
    """Distance over ground, m."""
    highest: float | None = None
    """Greatest height above home, or above the first position, m; see `height_above`."""
    height_above: str | None = None
    """Zero of the height: `home` or `first position`."""
    airborne: float | None = None
    """Time in the air, s."""
    armed: float | None = None
    """Time for which the vehicle was armed, s."""
    fastest: float | None = None
    """Greatest speed over ground, m/s."""
    lat_min: float | None = None
    lat_max: float | None = None
    lon_min: float | None = None
    lon_max: float | None = None
    """Eastern limit, deg; less than lon_min across the date line."""
    takeoff_lat: float | None = None
    takeoff_lon: float | None = None
    gps_outages: int | None = None
    gps_lost: float | None = None
    """Total duration of the GPS outages, s."""
    faults: int | None = None
    """Number of bus errors and failed sensors of nodes, and of texts of severity ERROR or worse."""
    loss: float | None = None
    """Proportion of samples lost on the radio link, 0 to 1."""
    damaged: int | None = None
    """Number of damaged bytes in the file."""
    version: str | None = None
    """Version of mavgate, or of the autopilot's firmware."""
    settings: str | None = None
    """Checksum of settings and calibration."""


def began_text(unix_us: int | None) -> str | None:
    """Return a civil time in the form of the catalogue; None if it is out of range."""
    moment = None if unix_us is None or unix_us < FIRST_CIVIL_US else civil_time(unix_us)
    return None if moment is None else f"{moment:%Y-%m-%d %H:%M:%S}"


def _limits(points: FlightTrackPoints) -> tuple[float, float, float, float]:
    lat, lon = points.lat_deg, points.lon_deg
    turned = lon[0] + wrap_180(lon - lon[0])
    west, east = float(turned.min()), float(turned.max())
    return float(lat.min()), float(lat.max()), wrap_180(west), wrap_180(east)


Flown = tuple[CataloguedFlight, Segments]


def flights_of(found: Summary) -> Iterator[Flown]:
    """Yield a flight for each vehicle of a file, or one without a vehicle if there is none."""
    info, tallies = found.info, found.tallies
    for vehicle in info.vehicles:
        if vehicle.system_id in tallies:
            points = tallies[vehicle.system_id].points()
            zero_us = 0 if info.header is None else info.header.unix_us_at_zero
            known = _catalogued(vehicle, points, zero_us)
            known = msgspec.structs.replace(known, damaged=info.damaged_bytes)
            yield known, [*map(simplified, points.segments())]
    if not tallies:
        yield (
            CataloguedFlight(
                began=began_text(info.first_us),
                duration=info.duration_s,
                damaged=info.damaged_bytes,
            ),
            [],
        )


def _catalogued(
    vehicle: VehicleInfo, points: FlightTrackPoints, zero_us: int | None
) -> CataloguedFlight:
    """Return the facts of a vehicle; `zero_us` is the civil time of the recording's time zero."""
    facts = vehicle.facts
    if facts is None or facts.first_us is None:
        return CataloguedFlight(vehicle=vehicle.system_id)
    south, north, west, east = _limits(points) if len(points) else (None, None, None, None)
    outages, take_off = facts.gps_outages_us, facts.take_off or (None, None)
    lost_us = sum(end - begin for begin, end in outages or ())
    return CataloguedFlight(
        vehicle=vehicle.system_id,
        began=began_text(None if zero_us is None else zero_us + facts.first_us),
        duration=facts.duration_s,
        distance=facts.distance_m,
        highest=facts.highest_m,
        height_above=facts.height_above,
        airborne=facts.airborne_s,
        armed=facts.armed_s,
        fastest=facts.fastest_mps,
        lat_min=south,
        lat_max=north,
        lon_min=west,
        lon_max=east,
        takeoff_lat=take_off[0],
        takeoff_lon=take_off[1],
        gps_outages=None if outages is None else len(outages),
        gps_lost=None if outages is None else lost_us / US_PER_S,
        faults=facts.errors,
        loss=facts.radio_loss,
        version=vehicle.version,
        settings=vehicle.settings,
    )
