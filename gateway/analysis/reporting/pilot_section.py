"""Section of the report for pilots: the flight as its recording contains it."""

from datetime import UTC, datetime
from typing import Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from gateway.analysis.flight import FloatArray
from gateway.analysis.metrics import euler_rad
from gateway.analysis.pilot import PilotFlight
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Fact, Picture, ReportTable, Section
from gateway.printable import figure
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.units import FEET_PER_M, KNOTS_PER_MPS, US_PER_S
from gateway.vehicle_state.positions import IntArray

COLOUR_MAP: Final = "viridis"
LINE_POINTS: Final = 1500
EVENT_COLOURS: Final = {
    "flight": style.GREEN, "mode": style.BLUE, "gps": style.ORANGE, "link": style.RED,
}  # fmt: skip
EVENT_NAMES: Final = {"flight": "flight", "mode": "mode", "gps": "GPS lost", "link": "link lost"}


def the_flight(flight: PilotFlight) -> Section:
    """Build the section on the flight; without positions it has no map."""
    frame, pictures = flight.frame, []
    above = flight.facts.height_above
    lead = "The recording contains no position."
    if frame is not None:
        lead = (
            f"Positions are those of {flight.positions}, heights above {above}, at "
            f"{frame.lat_deg:.5f}, {frame.lon_deg:.5f}. In the air is as the vehicle reports it, "
            "or by speed and height, for two seconds or more."
        )
        pictures = [
            Picture(
                "flight_map",
                lambda width: _draw_map(flight, width),
                f"The track from above, coloured by height above {above}. The triangle is the "
                "start, the square the end, the rings are the events of the timeline.",
            )
        ]
    if lines := _lines(flight):
        pictures.append(
            Picture(
                "flight_over_time",
                lambda width: _draw_over_time(flight, width),
                f"{', '.join(name.partition(' (')[0] for name in lines).capitalize()} over the "
                "whole flight. Below: take-off and landing, the highest and the fastest moment, "
                "changes of mode, and where GPS or link were lost, which is shaded in every panel.",
            )
        )
    events = pd.DataFrame(
        [(event.text, event.time_s) for event in flight.events], columns=["event", "at, s"]
    )
    return Section(
        "The flight",
        lead,
        *pictures,
        ReportTable("flight_figures", _figures_table(flight), "The flight in figures."),
        ReportTable("flight_events", events, "Events and texts.", digits=1),
    )


def facts_of(flight: PilotFlight) -> list[Fact]:
    """Return the key figures of the flight for the header of the page."""
    facts = flight.facts
    found = []
    if flight.begin_us > FIRST_CIVIL_US:
        began = datetime.fromtimestamp(flight.begin_us / US_PER_S, UTC)
        found = [Fact(f"{began:%Y-%m-%d %H:%M}", "UTC, first record")]
    found.append(Fact(f"{facts.duration_s:.0f} s", "recorded"))
    if facts.distance_m is None:
        return found
    minutes, seconds = divmod(round(facts.airborne_s or 0.0), 60)
    return [
        *found,
        Fact(f"{minutes}:{seconds:02d}", "minutes in the air"),
        Fact(figure(facts.distance_m / 1000, ".2f", "km"), "over ground"),
        Fact(figure(facts.highest_m, ".0f", "m"), f"highest above {facts.height_above}"),
        Fact(figure(facts.fastest_mps, ".1f", "m/s"), "fastest over ground"),
        Fact(figure(facts.farthest_m, ".0f", "m"), f"farthest from {facts.height_above}"),
        Fact(_sum_text(_outages_s(flight)), "GPS outages"),
        Fact(_sum_text([gap.duration_s for gap in facts.gaps]), "link losses"),
    ]


def _outages_s(flight: PilotFlight) -> list[float]:
    outages = flight.facts.gps_outages_us or ()
    return [(end - begin) / US_PER_S for begin, end in outages]


def _sum_text(lengths_s: list[float]) -> str:
    return f"{len(lengths_s)}, {sum(lengths_s):.1f} s" if lengths_s else "none"


def _figures_table(flight: PilotFlight) -> pd.DataFrame:
    facts, outages = flight.facts, _outages_s(flight)
    longest = f"longest {max(outages):.1f} s" if outages else ""
    climb_mps, above = facts.climb_mps, facts.height_above or "home"
    climb = f"{_feet(climb_mps * 60)}/min" if climb_mps is not None else ""
    knots = "" if facts.fastest_mps is None else f"{facts.fastest_mps * KNOTS_PER_MPS:.1f} kt"
    loss = None if facts.radio_loss is None else 100.0 * facts.radio_loss
    rows = [
        ("recorded", facts.duration_s, "s", ""),
        ("in the air", facts.airborne_s, "s", ""),
        ("armed", facts.armed_s, "s", ""),
        ("distance over ground", facts.distance_m, "m", ""),
        (f"highest above {above}", facts.highest_m, "m", _feet(facts.highest_m)),
        ("fastest over ground", facts.fastest_mps, "m/s", knots),
        ("fastest climb over a second", climb_mps, "m/s", climb),
        (f"farthest from {above}", facts.farthest_m, "m", ""),
        ("GPS outages", None if facts.gps_outages_us is None else len(outages), "", longest),
        ("fewest satellites", facts.satellites, "", ""),
        *((f"charge used, battery {n}", mah, "mAh", "") for n, mah in facts.used_mah.items()),
        ("greatest vibration", facts.vibration_mps2, "m/s2", ""),
        ("lost on the radio", loss, "%", ""),
        ("link losses", len(facts.gaps), "", ""),
        ("errors", facts.errors, "", ""),
    ]
    known = [row for row in rows if row[1] is not None]
    # As objects, so that counts stay integers.
    return pd.DataFrame(known, columns=["figure", "value", "unit", "also"], dtype=object)


def _feet(metres: float | None) -> str:
    return "" if metres is None else figure(metres * FEET_PER_M, ".0f", "ft")


def _draw_map(flight: PilotFlight, width_in: float) -> Figure:
    frame, points = flight.frame, flight.points
    assert frame is not None
    step = max(1, len(points) // LINE_POINTS)
    pos_m = frame.local_m(points.lat_deg[::step], points.lon_deg[::step])
    height = points.height_m[::step]
    height_in = width_in * 0.66 if width_in >= style.WIDE_IN else 4.0
    figure, axes = style.ground_map(width_in, height_in, str(flight.facts.height_above))
    if len(pos_m) > 1:
        drawn = pos_m[:, ::-1].reshape(-1, 1, 2)
        segments = np.concatenate([drawn[:-1], drawn[1:]], axis=1)
        # Not where the track is interrupted.
        joined = np.add.reduceat(points.broken, np.arange(0, len(points), step))[1:] == 0
        line = LineCollection(list(segments[joined]), cmap=mpl.colormaps[COLOUR_MAP], lw=2.0)
        line.set_array(np.nan_to_num(height[1:][joined]))
        axes.add_collection(line)
        axes.autoscale_view()
        bar = figure.colorbar(line, ax=axes, fraction=0.04, pad=0.02)
        bar.set_label(f"height above {flight.facts.height_above} (m)")
        bar.outline.set_visible(False)
    style.mark_ends(axes, pos_m)
    _mark_events(axes, flight)
    style.legend_outside(figure, axes, 5 if width_in >= style.WIDE_IN else 3)
    return figure


def _mark_events(axes: Axes, flight: PilotFlight) -> None:
    frame, points = flight.frame, flight.points
    assert frame is not None
    for kind, colour in EVENT_COLOURS.items():
        times = np.array([event.time_s for event in flight.events if event.kind == kind])
        index = np.minimum(np.searchsorted(flight.seconds(points.time_us), times), len(points) - 1)
        pos_m = frame.local_m(points.lat_deg[index], points.lon_deg[index])
        if len(pos_m):
            axes.plot(
                pos_m[:, 1], pos_m[:, 0], "o", color=colour, ms=8, mfc="none", mew=1.4,
                label=EVENT_NAMES[kind],
            )  # fmt: skip


def _lines(flight: PilotFlight) -> dict[str, tuple[FloatArray, FloatArray]]:
    points, attitude = flight.points, flight.tally.attitude.arrays()
    battery = flight.tally.battery.arrays()
    q_nb = np.column_stack([attitude[f"q_{part}"] for part in "wxyz"])
    roll, pitch, _ = (np.degrees(angle) for angle in euler_rad(q_nb).T)
    found: dict[str, tuple[FloatArray | IntArray, FloatArray]] = {
        "height (m)": (points.time_us, points.height_m),
        "speed (m/s)": (points.time_us, points.speed_mps),
        "roll (deg)": (attitude["time_us"], roll),
        "pitch (deg)": (attitude["time_us"], pitch),
        "battery (V)": (battery["time_us"], battery["volts"]),
    }
    return {
        label: (flight.seconds(times), values)
        for label, (times, values) in found.items()
        if np.isfinite(values).any()
    }


def _draw_over_time(flight: PilotFlight, width_in: float) -> Figure:
    lines, events = _lines(flight), flight.events
    figure, axes = style.over_time(width_in, 1.2, [*lines, ""])
    for panel, (label, (seconds, values)) in zip(axes, lines.items(), strict=False):
        style.draw(panel, seconds, values, style.BLUE, label, lw=1.0)
    outages = [flight.seconds(outage) for outage in flight.facts.gps_outages_us or ()]
    gaps = [
        flight.seconds([gap.time_us, gap.time_us + gap.duration_s * US_PER_S])
        for gap in flight.facts.gaps
    ]
    for panel in axes:
        for kind, found in (("gps", outages), ("link", gaps)):
            for begin, end in found:
                panel.axvspan(begin, end, color=EVENT_COLOURS[kind], alpha=0.25, lw=0)
    heights = dict(zip(EVENT_COLOURS, (3.0, 2.0, 1.0, 0.0), strict=True))
    for kind, height in heights.items():
        times = [event.time_s for event in events if event.kind == kind]
        axes[-1].plot(times, [height] * len(times), "|", color=EVENT_COLOURS[kind], ms=11, mew=2.0)
    axes[-1].set_ylim(-0.6, 3.6)
    axes[-1].set_yticks(list(heights.values()), [EVENT_NAMES[kind] for kind in heights])
    return figure
