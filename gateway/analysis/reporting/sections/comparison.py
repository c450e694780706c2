"""Two flights, or one flight with two settings, side by side with the difference."""

from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gateway.analysis.case import Case
from gateway.analysis.key_figures import changed_settings, summarise
from gateway.analysis.metrics import position_error_m, rotation_error, total_error_rad
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, ReportTable, Section
from gateway.geometry.angle import wrap_180

SAME_PLACE_DEG: Final = 0.5
"""Flights further apart do not fit on one map."""
NAMES: Final = ("A", "B")
COLOURS: Final = (style.BLUE, style.RED)


def comparison(a: Case, b: Case) -> Section:
    """Build the section."""
    same = np.array_equal(a.flight.time_us, b.flight.time_us)
    what = "the same flight with other settings" if same else b.flight.name
    lead = f"A is {a.flight.name}, fused by `{a.chosen}`; B is {what}, fused by `{b.chosen}`."
    pictures = [_difference(a, b) if same else _profiles(a, b)]
    if _on_one_map(a, b):
        pictures.append(
            Picture(
                "comparison_map",
                lambda width: _draw_map(a, b, width),
                "Both fused tracks from above.",
            )
        )
    return Section("Comparison", lead, pictures, _tables(a, b))


def _tables(a: Case, b: Case) -> list[ReportTable]:
    first, second = summarise(a), summarise(b)
    rows = [
        {"": key, "A": first.get(key, np.nan), "B": second.get(key, np.nan)}
        for key in dict.fromkeys([*first, *second])
    ]
    numbers = pd.DataFrame(rows)
    numbers["B − A"] = numbers["B"] - numbers["A"]
    tables = [ReportTable("comparison", numbers, "Both in numbers, and B less A.")]
    if changes := changed_settings(a.fusion, b.fusion):
        settings = pd.DataFrame(changes, columns=["setting", "A", "B"]).astype(str)
        tables.append(ReportTable("comparison_settings", settings, "Settings that differ."))
    return tables


def _difference(a: Case, b: Case) -> Picture:
    return Picture(
        "comparison_difference",
        lambda width: _draw_difference(a, b, width),
        "Distance between the two fused tracks over time.",
    )


def _profiles(a: Case, b: Case) -> Picture:
    return Picture(
        "comparison_profiles",
        lambda width: _draw_profiles(a, b, width),
        "Height above the start and ground speed of both flights, each from its own start.",
    )


def _on_one_map(a: Case, b: Case) -> bool:
    if a.frame is None or b.frame is None:
        return False
    north_deg = abs(a.frame.lat_deg - b.frame.lat_deg)
    east_deg = abs(wrap_180(a.frame.lon_deg - b.frame.lon_deg))
    return max(north_deg, east_deg) < SAME_PLACE_DEG


def _draw_difference(a: Case, b: Case, width_in: float) -> Figure:
    figure, (above, below) = style.panels(width_in, 2, 1.9)
    time = a.flight.time_s
    apart = position_error_m(b.track, a.track)
    turned = total_error_rad(rotation_error(b.track.q_nb, a.track.q_nb))
    style.draw(above, time, np.hypot(apart[:, 0], apart[:, 1]), style.BLUE, "horizontal")
    style.draw(above, time, np.abs(apart[:, 2]), style.ORANGE, "vertical")
    style.draw(below, time, np.degrees(turned), style.GREEN, "attitude")
    above.set_ylabel("apart (m)")
    below.set(ylabel="turned apart (deg)", xlabel="time (s)")
    style.legend_above(above)
    return figure


def _draw_profiles(a: Case, b: Case, width_in: float) -> Figure:
    figure, (above, below) = style.panels(width_in, 2, 2.0)
    for case, name, colour in zip((a, b), NAMES, COLOURS, strict=True):
        track, scored = case.track, case.flight.scored
        alt = np.where(scored, track.alt_amsl_m, np.nan)
        known = alt[np.isfinite(alt)]
        if len(known):
            style.draw(above, case.flight.time_s, alt - known[0], colour, name)
        speed = np.where(scored, np.hypot(track.vel_n_mps[:, 0], track.vel_n_mps[:, 1]), np.nan)
        style.draw(below, case.flight.time_s, speed, colour, name)
    above.set_ylabel("above the start (m)")
    below.set(ylabel="ground speed (m/s)", xlabel="time (s)")
    style.legend_above(above)
    return figure


def _draw_map(a: Case, b: Case, width_in: float) -> Figure:
    figure = Figure(figsize=(width_in, min(0.7 * width_in, 4.6)))
    axes = figure.subplots()
    frame = a.frame
    for case, name, colour, width in zip((a, b), NAMES, COLOURS, (2.6, 1.0), strict=True):
        if frame is not None:
            place = frame.place(case.track.lat_deg, case.track.lon_deg)
            step = max(1, len(place) // 4000)
            axes.plot(place[::step, 1], place[::step, 0], color=colour, lw=width, label=name)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east of A's first fix (m)", ylabel="north of A's first fix (m)")
    style.legend_above(axes)
    return figure
