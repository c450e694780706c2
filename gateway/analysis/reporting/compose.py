"""The report of one flight, put together from its sections."""

from collections.abc import Callable
from typing import Final

from gateway.analysis.case import Case
from gateway.analysis.reporting.estimators import comparison, estimators, weights
from gateway.analysis.reporting.ground_track import gps_interpolation, ground_track, orientation
from gateway.analysis.reporting.page import Fact, Report, Section
from gateway.analysis.reporting.pilot import pilot_facts, the_flight
from gateway.analysis.reporting.raw_sensors import (
    acceleration,
    heights,
    magnetometer,
    noise,
    timing,
)

SECTIONS: Final[tuple[Callable[[Case], Section | None], ...]] = (
    the_flight,
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
"""In the order of the page: the flight itself, then the study of filters. A section that the flight
has no data for is left out."""


def make_report(case: Case, other: Case | None = None) -> Report:
    """Build the report of one flight."""
    compared = [comparison(case, other)] if other is not None else []
    sections = compared + [section for build in SECTIONS if (section := build(case)) is not None]
    return Report(
        title=f"Flight report: {case.flight.name}",
        story=case.flight.story,
        facts=_facts(case),
        sections=sections,
    )


def _facts(case: Case) -> list[Fact]:
    flight = case.flight
    return [
        *([] if case.figures is None else pilot_facts(case.figures)),
        Fact(f"{flight.duration_s:.0f} s", "recorded"),
        Fact(f"{len(flight.time_us)}", f"IMU samples, {flight.rate_hz:.0f} a second"),
        Fact(f"{len(case.fixes)}", "usable GPS fixes"),
        Fact(case.chosen, "estimator"),
    ]
