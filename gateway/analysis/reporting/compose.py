"""Compose the report of one flight from its sections; the first one is for pilots."""

from collections.abc import Callable
from typing import Final

from gateway.analysis.case import Case
from gateway.analysis.pilot import PilotFlight
from gateway.analysis.reporting.estimators import comparison, estimators, weights
from gateway.analysis.reporting.ground_track import gps_interpolation, ground_track, orientation
from gateway.analysis.reporting.page import Fact, Report, Section
from gateway.analysis.reporting.pilot_section import facts_of, the_flight
from gateway.analysis.reporting.raw_sensors import (
    acceleration,
    heights,
    magnetometer,
    noise,
    timing,
)

NO_SAMPLES: Final = "The recording contains no IMU samples, so its filters cannot be studied."

SECTIONS: Final[tuple[Callable[[Case], Section | None], ...]] = (
    ground_track,
    estimators,
    orientation,
    acceleration,
    gps_interpolation,
    weights,
    heights,
    magnetometer,
    noise,
    timing,
)
"""Sections of the study of filters, in the order of the page. Those without data are left out."""


def make_report(made: Case | PilotFlight, other: Case | None = None) -> Report:
    """Build the report of one flight; without IMU samples, the section for pilots only."""
    flight = made.pilot if isinstance(made, Case) else made
    sections, facts, description = [the_flight(flight)], facts_of(flight), NO_SAMPLES
    if isinstance(made, Case):
        description = made.flight.description
        samples = f"IMU samples, {made.flight.rate_hz:.0f} a second"
        facts += [
            Fact(f"{len(made.flight.time_us)}", samples),
            Fact(f"{len(made.fixes)}", "usable GPS fixes"),
            Fact(made.chosen, "estimator"),
        ]
        sections += [section for build in SECTIONS if (section := build(made)) is not None]
        if other is not None:
            sections.insert(0, comparison(made, other))
    return Report(f"Flight report: {flight.name}", description, facts, sections)
