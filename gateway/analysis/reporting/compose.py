"""Compose the report of one flight from its sections; the first one is for pilots."""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from gateway.analysis.case import Case
from gateway.analysis.flight import FloatArray
from gateway.analysis.metrics import euler_rad
from gateway.analysis.pilot_figures import PilotFigures
from gateway.analysis.reporting import style
from gateway.analysis.reporting.estimators import comparison, estimators, weights
from gateway.analysis.reporting.ground_track import gps_interpolation, ground_track, orientation
from gateway.analysis.reporting.page import Fact, Picture, Report, ReportTable, Section
from gateway.analysis.reporting.raw_sensors import (
    acceleration,
    heights,
    magnetometer,
    noise,
    timing,
)
from gateway.printable import figure

COLOUR_MAP: Final = "viridis"
LINE_POINTS: Final = 1500
EVENT_COLOURS: Final = {"flight": style.GREEN, "gps": style.ORANGE, "link": style.RED}
EVENT_NAMES: Final = {"flight": "flight", "gps": "GPS lost", "link": "link lost"}
KNOTS_PER_MPS: Final = 1.943844
FEET_PER_M: Final = 3.28084


def the_flight(case: Case) -> Section | None:
    """Build the section on the flight; None without GPS."""
    figures = case.figures
    if figures is None:
        return None
    lat, lon = case.fixes.lat_deg[0], case.fixes.lon_deg[0]
    events = pd.DataFrame(
        [(event.text, event.time_s) for event in figures.events], columns=["event", "at, s"]
    )
    return Section(
        "The flight",
        f"From {lat:.5f}, {lon:.5f}, by the estimator `{case.chosen}`. In the air means faster "
        "than 3 m/s and 3 m above the first fix, for two seconds or more.",
        [
            Picture(
                "flight_map",
                lambda width: _draw_map(case, width),
                "The track from above, coloured by height above the first fix. The triangle is "
                "the start, the square the end, the rings are the events of the timeline.",
            ),
            Picture(
                "flight_over_time",
                lambda width: _draw_over_time(case, figures, width),
                "Height, ground speed, roll and pitch over the whole flight. Below: take-off and "
                "landing, the highest and the fastest moment, and where GPS or link were lost, "
                "which is shaded in every panel.",
            ),
        ],
        [
            ReportTable("flight_figures", _figures_table(case, figures), "The flight in figures."),
            ReportTable("flight_events", events, "Events.", digits=1),
        ],
    )


def _sum_text(gaps: tuple[tuple[float, float], ...]) -> str:
    if not gaps:
        return "none"
    return f"{len(gaps)}, {sum(end - begin for begin, end in gaps):.1f} s"


def _figures_table(case: Case, figures: PilotFigures) -> pd.DataFrame:
    outages = figures.gps_outages_s
    longest = f"longest {max(end - begin for begin, end in outages):.1f} s" if outages else ""
    climb = _feet(60 * figures.climb_mps)
    knots = figure(figures.fastest_mps * KNOTS_PER_MPS, ".1f", "kt")
    rows = [
        ("recorded", case.flight.duration_s, "s", ""),
        ("in the air", figures.airborne_s, "s", ""),
        ("distance over ground", figures.distance_m, "m", ""),
        ("highest above the first fix", figures.highest_m, "m", _feet(figures.highest_m)),
        ("fastest over ground", figures.fastest_mps, "m/s", knots),
        ("fastest climb over a second", figures.climb_mps, "m/s", f"{climb}/min"),
        ("farthest from the first fix", figures.farthest_m, "m", ""),
        ("GPS outages", len(outages), "", longest),
        ("link losses", len(figures.link_losses_s), "", ""),
    ]
    # As objects, so that counts stay integers.
    return pd.DataFrame(rows, columns=["figure", "value", "unit", "also"], dtype=object)


def _feet(metres: float) -> str:
    return figure(metres * FEET_PER_M, ".0f", "ft")


def _draw_map(case: Case, width_in: float) -> Figure:
    frame, track = case.frame, case.track
    assert frame is not None
    step = max(1, len(track.lat_deg) // LINE_POINTS)
    pos_m = frame.local_m(track.lat_deg[::step], track.lon_deg[::step])
    height = track.alt_amsl_m[::step] - frame.alt_m
    known = np.isfinite(pos_m).all(axis=1) & np.isfinite(height)
    pos_m, height = pos_m[known], height[known]
    figure = Figure(figsize=(width_in, width_in * 0.66 if width_in >= style.WIDE_IN else 4.0))
    axes = figure.subplots()
    if len(pos_m) > 1:
        points = pos_m[:, ::-1].reshape(-1, 1, 2)
        segments = np.concatenate([points[:-1], points[1:]], axis=1)
        line = LineCollection(list(segments), cmap=mpl.colormaps[COLOUR_MAP], lw=2.0)
        line.set_array(height[1:])
        axes.add_collection(line)
        axes.autoscale_view()
        bar = figure.colorbar(line, ax=axes, fraction=0.04, pad=0.02)
        bar.set_label("height above the first fix (m)")
        bar.outline.set_visible(False)
        axes.plot(pos_m[0, 1], pos_m[0, 0], "^", color=style.GREEN, ms=8, label="start")
        axes.plot(pos_m[-1, 1], pos_m[-1, 0], "s", color=style.RED, ms=7, mfc="none", label="end")
        _mark_events(axes, case)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east of the first fix (m)", ylabel="north of the first fix (m)")
    style.legend_outside(figure, axes, 5 if width_in >= style.WIDE_IN else 3)
    return figure


def _mark_events(axes: Axes, case: Case) -> None:
    figures, frame, track = case.figures, case.frame, case.track
    assert figures is not None
    assert frame is not None
    for kind, colour in EVENT_COLOURS.items():
        times = np.array([event.time_s for event in figures.events if event.kind == kind])
        index = np.minimum(np.searchsorted(case.flight.time_s, times), len(track.lat_deg) - 1)
        pos_m = frame.local_m(track.lat_deg[index], track.lon_deg[index])
        if len(pos_m):
            axes.plot(
                pos_m[:, 1], pos_m[:, 0], "o", color=colour, ms=8, mfc="none", mew=1.4,
                label=EVENT_NAMES[kind],
            )  # fmt: skip


def _draw_over_time(case: Case, figures: PilotFigures, width_in: float) -> Figure:
    frame, track = case.frame, case.track
    assert frame is not None
    roll, pitch, _ = (np.degrees(angle) for angle in euler_rad(track.q_nb).T)
    lines: dict[str, FloatArray] = {
        "height (m)": np.where(np.isfinite(track.lat_deg), track.alt_amsl_m - frame.alt_m, np.nan),
        "speed (m/s)": np.hypot(track.vel_n_mps[:, 0], track.vel_n_mps[:, 1]),
        "roll (deg)": roll,
        "pitch (deg)": pitch,
    }
    figure, axes = style.over_time(width_in, 1.2, [*lines, ""])
    for panel, (label, values) in zip(axes, lines.items(), strict=False):
        style.draw(panel, case.flight.time_s, values, style.BLUE, label, lw=1.0)
    gaps = (("gps", figures.gps_outages_s), ("link", figures.link_losses_s))
    for panel in axes:
        for kind, found in gaps:
            for begin, end in found:
                panel.axvspan(begin, end, color=EVENT_COLOURS[kind], alpha=0.25, lw=0)
    heights = {"flight": 2.0, "gps": 1.0, "link": 0.0}
    for kind, height in heights.items():
        times = [event.time_s for event in figures.events if event.kind == kind]
        axes[-1].plot(times, [height] * len(times), "|", color=EVENT_COLOURS[kind], ms=11, mew=2.0)
    axes[-1].set_ylim(-0.6, 2.6)
    axes[-1].set_yticks(list(heights.values()), [EVENT_NAMES[kind] for kind in heights])
    return figure


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
"""Sections in the order of the page: the flight, then the study of filters. Sections without data
are left out."""


def make_report(case: Case, other: Case | None = None) -> Report:
    """Build the report of one flight."""
    compared = [comparison(case, other)] if other is not None else []
    sections = compared + [section for build in SECTIONS if (section := build(case)) is not None]
    return Report(
        title=f"Flight report: {case.flight.name}",
        description=case.flight.description,
        facts=_facts(case),
        sections=sections,
    )


def _facts(case: Case) -> list[Fact]:
    """Return the key figures for the header of the page."""
    flight, figures = case.flight, case.figures
    facts = [
        Fact(f"{flight.duration_s:.0f} s", "recorded"),
        Fact(f"{len(flight.time_us)}", f"IMU samples, {flight.rate_hz:.0f} a second"),
        Fact(f"{len(case.fixes)}", "usable GPS fixes"),
        Fact(case.chosen, "estimator"),
    ]
    if figures is None:
        return facts
    minutes, seconds = divmod(round(figures.airborne_s), 60)
    if np.isfinite(figures.began_unix_s):
        began = datetime.fromtimestamp(figures.began_unix_s, UTC)
        begin = [Fact(f"{began:%Y-%m-%d %H:%M}", "UTC, first sample")]
    else:
        begin = []
    return [
        *begin,
        Fact(f"{minutes}:{seconds:02d}", "minutes in the air"),
        Fact(figure(figures.distance_m / 1000, ".2f", "km"), "flown over ground"),
        Fact(figure(figures.highest_m, ".0f", "m"), "highest above the first fix"),
        Fact(figure(figures.fastest_mps, ".1f", "m/s"), "fastest over ground"),
        Fact(figure(figures.farthest_m, ".0f", "m"), "farthest from the first fix"),
        Fact(_sum_text(figures.gps_outages_s), "GPS outages"),
        Fact(_sum_text(figures.link_losses_s), "link losses"),
        *facts,
    ]
