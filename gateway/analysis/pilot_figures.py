"""Key figures of a flight for pilots: times, distance, height, speed and outages."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.analysis.flight import Flight, FlightTrack, FloatArray
from gateway.analysis.metrics import greatest
from gateway.recordings.figures import gps_outages_us
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import LocalFrame

AIRBORNE_MPS: Final = 3.0
"""Minimum ground speed in flight, more than that of a person who carries the aircraft."""
AIRBORNE_M: Final = 3.0
HELD_S: Final = 2.0
"""Minimum duration of an interval in the air or on the ground."""
LINK_LOSS_S: Final = 0.5
"""Minimum gap between IMU samples that counts as a loss of the link."""
LONGEST_STEP_M: Final = 200.0
"""Maximum distance between two samples; a longer one is a jump of the position."""


@dataclass(frozen=True, slots=True)
class FlightEvent:
    """An event at one moment."""

    time_s: float
    """Time since the first sample."""
    kind: str
    """Kind of mark on the timeline: flight, gps or link."""
    text: str


@dataclass(frozen=True, slots=True)
class PilotFigures:
    """Key figures of one flight; NaN if unknown."""

    began_unix_s: float
    airborne_s: float
    distance_m: float
    """Distance over ground while airborne."""
    highest_m: float
    """Greatest height above the first fix."""
    fastest_mps: float
    """Greatest ground speed."""
    climb_mps: float
    """Greatest climb rate, averaged over a second."""
    farthest_m: float
    """Greatest distance from the first fix."""
    gps_outages_s: tuple[tuple[float, float], ...]
    """Start and end of each outage since the first sample."""
    link_losses_s: tuple[tuple[float, float], ...]
    events: tuple[FlightEvent, ...]
    """Events in the order of their times."""


def pilot_figures(flight: Flight, track: FlightTrack, frame: LocalFrame) -> PilotFigures:
    """Summarise one flight."""
    seconds = flight.time_s
    pos_m = frame.local_m(track.lat_deg, track.lon_deg)
    height_m = np.where(np.isfinite(track.lat_deg), track.alt_amsl_m - frame.alt_m, np.nan)
    speed_mps = np.hypot(track.vel_n_mps[:, 0], track.vel_n_mps[:, 1])
    airborne = _held(seconds, (speed_mps > AIRBORNE_MPS) & (height_m > AIRBORNE_M))
    outages = _outages_s(flight)
    losses = _gaps(seconds, flight.duration_s, LINK_LOSS_S)
    events = [
        *_flight_events(seconds, airborne, height_m, speed_mps),
        *_gap_events(outages, "gps", "GPS"),
        *_gap_events(losses, "link", "link"),
    ]
    return PilotFigures(
        began_unix_s=_began_unix_s(flight),
        airborne_s=float(np.diff(seconds)[airborne[1:]].sum()),
        distance_m=_distance_m(pos_m, airborne),
        highest_m=greatest(height_m),
        fastest_mps=greatest(speed_mps),
        climb_mps=greatest(_smoothed(-track.vel_n_mps[:, 2], round(flight.rate_hz))),
        farthest_m=greatest(np.hypot(pos_m[:, 0], pos_m[:, 1])),
        gps_outages_s=outages,
        link_losses_s=losses,
        events=tuple(sorted(events, key=lambda event: event.time_s)),
    )


def _outages_s(flight: Flight) -> tuple[tuple[float, float], ...]:
    fixes = flight.fixes
    reported_us = np.array([fix.time_us for fix in fixes], np.int64)
    fixed = np.array([fix.fix_ok for fix in fixes], bool)
    found = gps_outages_us(reported_us, fixed, int(flight.time_us[-1])) or []
    seconds = flight.seconds(np.array(found, np.int64).reshape(-1, 2))
    return tuple((begin, end) for begin, end in seconds.tolist())


def _began_unix_s(flight: Flight) -> float:
    """Return the civil time of the first sample, from the first fix that contains civil time."""
    for fix in flight.fixes:
        if fix.utc_us is not None:
            return float(fix.utc_us - fix.time_us + flight.time_us[0]) / US_PER_S
    return float("nan")


def _smoothed(values: FloatArray, count: int) -> FloatArray:
    """Return the moving average over a number of samples, ignoring unknown ones."""
    known = np.isfinite(values)
    window = np.ones(max(count, 1))
    total = np.convolve(np.where(known, values, 0.0), window, "same")
    number = np.convolve(known.astype(float), window, "same")
    return np.where(number > 0, total / np.maximum(number, 1.0), np.nan)


def _held(seconds: FloatArray, state: np.ndarray) -> np.ndarray:
    """Merge intervals shorter than `HELD_S` with their neighbours, first those on the ground."""
    found = np.asarray(state, bool).copy()
    for wanted in (False, True):
        edges = np.flatnonzero(np.diff(found)) + 1
        for begin, end in zip([0, *edges], [*edges, len(found)], strict=True):
            inner = begin > 0 and end < len(found)
            if found[begin] == wanted and inner and seconds[end - 1] - seconds[begin] < HELD_S:
                found[begin:end] = not wanted
    return found


def _distance_m(pos_m: FloatArray, airborne: np.ndarray) -> float:
    steps = np.hypot(*np.diff(pos_m, axis=0).T)
    flown = airborne[1:] & np.isfinite(steps) & (steps < LONGEST_STEP_M)
    return float(steps[flown].sum()) if flown.any() else 0.0


def _gaps(
    times_s: FloatArray, duration_s: float, longest_s: float
) -> tuple[tuple[float, float], ...]:
    """Return the gaps between some times, from the first one to the end of the flight."""
    if not len(times_s):
        return ()
    ends = np.append(times_s[1:], duration_s)
    return tuple(
        (float(begin), float(end))
        for begin, end in zip(times_s, ends, strict=True)
        if end - begin > longest_s
    )


def _flight_events(
    seconds: FloatArray, airborne: np.ndarray, height_m: FloatArray, speed_mps: FloatArray
) -> list[FlightEvent]:
    events = []
    for index in np.flatnonzero(np.diff(airborne)) + 1:
        text = "in the air" if airborne[index] else "on the ground"
        events.append(FlightEvent(float(seconds[index]), "flight", text))
    for values, form in ((height_m, "highest, {:.0f} m"), (speed_mps, "fastest, {:.1f} m/s")):
        if np.isfinite(values).any():
            top = int(np.nanargmax(values))
            events.append(FlightEvent(float(seconds[top]), "flight", form.format(values[top])))
    return events


def _gap_events(gaps: tuple[tuple[float, float], ...], kind: str, name: str) -> list[FlightEvent]:
    return [FlightEvent(begin, kind, f"{name} lost for {end - begin:.1f} s") for begin, end in gaps]
