"""One flight fused with every estimator, and its key figures."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Final

import numpy as np

from gateway.analysis.blending import SplitFlight, score, withhold, withhold_spans
from gateway.analysis.flight import (
    Fixes,
    Flight,
    FlightTrack,
    fixes_of,
    fuse_track,
    local_frame,
    smooth_track,
)
from gateway.analysis.metrics import errors_over_time, greatest, rms
from gateway.analysis.pilot import PilotFlight, pilot_flight_of_samples
from gateway.analysis.signals import apply
from gateway.estimation.select import OWN_ESTIMATORS, EstimationSettings
from gateway.recordings.flight_facts import HOME
from gateway.recordings.fuse import FusionSettings, with_estimator
from gateway.records import NAN
from gateway.settings import Settings, fields_of
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import LocalFrame

ESTIMATORS: Final[tuple[str, ...]] = tuple(
    name for name in OWN_ESTIMATORS if name in EstimationSettings.__struct_fields__
)
"""Names of the estimators, each of which has a section of settings of that name."""

SMOOTHED: Final = "smoothed"
"""Name of the smoothed track, whose states use the whole flight."""
HOLD_OUT: Final = 5
"""Every n-th fix is withheld for comparison."""
OUTAGE_S: Final = 10.0
OUTAGE_EVERY_S: Final = 30.0
"""Period of the outages, which leaves two thirds of the time for the estimator to converge."""


@dataclass(frozen=True)
class Case:
    """A flight, the settings to fuse it with, and the results."""

    flight: Flight
    fusion: FusionSettings
    tracks: dict[str, FlightTrack]
    """Tracks by estimator, and `SMOOTHED` if requested."""
    frame: LocalFrame | None
    """Local frame in metres around the first fix; None for a flight without GPS."""
    smoothed_latency_s: float | None = None
    """GPS latency of the smoothed track, estimated if the motion contradicts the setting."""
    recorded: PilotFlight | None = None
    """The flight as its recording contains it, if it is known."""

    @property
    def chosen(self) -> str:
        """The estimator selected in the settings."""
        return self.fusion.estimation.estimator

    @property
    def track(self) -> FlightTrack:
        """The track of the chosen estimator."""
        return self.tracks[self.chosen]

    @cached_property
    def fixes(self) -> Fixes:
        """The usable GPS fixes."""
        return fixes_of(self.flight)

    @cached_property
    def pilot(self) -> PilotFlight:
        """The flight as its recording contains it, else its samples and fixes."""
        return self.recorded or pilot_flight_of_samples(self.flight)

    @property
    def truth_name(self) -> str:
        """Name of the reference for legends."""
        reference = self.flight.reference
        return "truth" if reference is not None and reference.is_exact else "reference"


def make_case(
    flight: Flight,
    fusion: FusionSettings | None = None,
    *,
    smooth: bool = False,
    recorded: PilotFlight | None = None,
) -> Case:
    """Fuse a flight with every estimator."""
    fusion = fusion or flight.fusion
    tracks = {name: fuse_track(flight, with_estimator(fusion, name)) for name in ESTIMATORS}
    latency_s = None
    if smooth:
        # Smoothing is not possible if the clock was set back.
        with suppress(ValueError):
            tracks[SMOOTHED], latency_s = smooth_track(flight, fusion)
    return Case(flight, fusion, tracks, local_frame(flight), latency_s, recorded)


def recorded_summary(flight: PilotFlight) -> dict[str, float]:
    """Return the facts of a flight that its summary contains, by name; NaN if unknown."""
    facts = flight.facts
    return {
        "duration, s": facts.duration_s,
        "distance flown, m": _known(facts.distance_m),
        f"greatest height above {facts.height_above or HOME}, m": _known(facts.highest_m),
        "greatest ground speed, m/s": _known(facts.fastest_mps),
    }


def summarise(case: Case) -> dict[str, float]:
    """Return the summary of a flight, by name."""
    flight, track = case.flight, case.track
    gap_s = np.diff(case.fixes.arrival_us) / US_PER_S
    filtering = case.fusion.estimation.paper
    smooth = apply(filtering.accel_filter, filtering, flight.rate_hz, flight.imu.accel_b_mps2)
    shaking = flight.imu.accel_b_mps2 - smooth
    found = recorded_summary(case.pilot) | {
        "IMU samples a second": flight.rate_hz,
        "usable GPS fixes": float(len(case.fixes)),
        "longest time without a fix, s": greatest(gap_s),
        "shaking above the low-pass, m/s² RMS": rms(shaking),
        "error at withheld fixes, m RMS": withheld_error_m(case, case.chosen),
    }
    if flight.reference is not None:
        errors = errors_over_time(track, flight.reference.track)
        for key, name in (
            ("tilt_deg", "tilt error, deg RMS"),
            ("heading_deg", "heading error, deg RMS"),
            ("horizontal_m", "horizontal error, m RMS"),
            ("height_m", "height error, m RMS"),
        ):
            found[name] = rms(errors[key][flight.scored])
    return found


def _known(value: float | None) -> float:
    return NAN if value is None else value


def withheld_error_m(case: Case, estimator: str) -> float:
    """Fuse without every n-th fix; return the horizontal RMS error at those fixes."""
    split = SplitFlight.by(case.flight, withhold(case.flight, HOLD_OUT))
    return _held_m(case, estimator, split)


def outage_error_m(case: Case, estimator: str) -> float:
    """Fuse without the fixes of 10 s in every 30 s; return the horizontal RMS error at the ends.

    NaN if the flight is too short.
    """
    flight = case.flight
    keep, ends = withhold_spans(flight, OUTAGE_S, OUTAGE_EVERY_S)
    if not ends.any():
        return float("nan")
    split = SplitFlight(flight.with_fixes(keep), flight.with_fixes(ends))
    return _held_m(case, estimator, split)


def _held_m(case: Case, estimator: str, split: SplitFlight) -> float:
    if estimator == SMOOTHED:
        track, _ = smooth_track(split.fused, case.fusion)
    else:
        track = fuse_track(split.fused, with_estimator(case.fusion, estimator))
    return score(track, split)["held_m"]


def changed_settings(a: FusionSettings, b: FusionSettings) -> list[tuple[str, object, object]]:
    """List the settings that differ: key, value in `a`, value in `b`."""
    pairs = ((key, attrgetter(key)(a), attrgetter(key)(b)) for key in setting_keys(type(a)))
    return [(key, of_a, of_b) for key, of_a, of_b in pairs if of_a != of_b]


def setting_keys(kind: type[Settings], prefix: str = "") -> Iterator[str]:
    """List the paths of all settings, such as `estimation.paper.alpha_accel`."""
    for field in fields_of(kind):
        if field.section:
            yield from setting_keys(field.section, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}"
