"""Compare the estimators, or two cases; and Table I of the paper."""

from functools import partial
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from gateway.analysis import metrics
from gateway.analysis.blending import grows, interpolate, paper_table
from gateway.analysis.case import (
    HOLD_OUT,
    OUTAGE_S,
    Case,
    changed_settings,
    outage_error_m,
    summarise,
    withheld_error_m,
)
from gateway.analysis.flight import BoolArray, FlightTrack, Reference
from gateway.analysis.reporting import style
from gateway.analysis.reporting.ground_track import draw_path
from gateway.analysis.reporting.page import Picture, ReportTable, Section
from gateway.analysis.sweep import WEIGHTS, blend_table
from gateway.geometry.angle import wrap_180

COLOURS: Final = {"paper": style.ORANGE, "eskf": style.PINK}
DESCRIPTION: Final = (
    "Every estimator fused the same samples, and is compared with {}. `paper` is the paper's "
    "fusion with its equations corrected: in a turn it interprets the bank as level flight, which "
    "slowly tilts its horizon. `eskf` uses the GPS velocity to distinguish the manoeuvre from "
    "gravity."
)
SMOOTHED_DESCRIPTION: Final = (
    " `smoothed` uses the whole flight for each state: `eskf` forwards and backwards, which "
    "requires a recording."
)
LATENCY_DESCRIPTION: Final = (
    " The manoeuvres contradict the GPS latency set, {:.2f} s: `smoothed` uses {:.2f} s, "
    "which they indicate, from the start."
)
OWN_GPS: Final = (
    "its own interpolated GPS, which is not independent: a track that follows the fixes' errors "
    "agrees best"
)
OTHER: Final = style.GREEN
ERROR_COLUMNS: Final = (
    ("roll, deg", metrics.rms, "roll_deg"),
    ("pitch, deg", metrics.rms, "pitch_deg"),
    ("yaw, deg", metrics.rms, "yaw_deg"),
    ("tilt, deg", metrics.rms, "tilt_deg"),
    ("worst tilt, deg", metrics.worst, "tilt_deg"),
    ("horizontal, m", metrics.rms, "horizontal_m"),
    ("worst horizontal, m", metrics.worst, "horizontal_m"),
    ("height, m", metrics.rms, "height_m"),
    ("speed, m/s", metrics.rms, "speed_mps"),
)
DRIFT: Final = f"{OUTAGE_S:.0f} s without GPS, m"
BARS: Final = {
    "horizontal, m": "position live (m)",
    DRIFT: f"position after {OUTAGE_S:.0f} s without GPS (m)",
}
SHOWN: Final = {
    "tilt_deg": "tilt (deg)", "heading_deg": "heading (deg)", "horizontal_m": "horizontal (m)",
}  # fmt: skip
TILT: Final = "Tilt is the part of the attitude error about a horizontal axis. "
SAME_POSITION_DEG: Final = 0.5
"""Maximum distance of two flights, in deg, that are drawn on one map."""
NAMES: Final = ("A", "B")
AB_COLOURS: Final = (style.BLUE, style.RED)
INTERVAL_S: Final = 1.0
"""Interval of the fixes of the paper's receiver, from the gaps in its figure 13."""
COLOUR_MAP: Final = "cividis_r"


def estimators(case: Case) -> Section | None:
    """Build the section; None without a reference, or if no sample is scored."""
    reference = _reference(case)
    if reference is None:
        return None
    tracks = dict(case.tracks)
    if case.flight.recorded is not None:
        tracks["recorded in flight"] = case.flight.recorded
    table = _error_table(tracks, reference, case.flight.scored)
    if len(case.fixes) > HOLD_OUT:
        withheld = {name: withheld_error_m(case, name) for name in case.tracks}
        table["withheld fixes, m"] = table["estimator"].map(withheld)
        drift = {name: outage_error_m(case, name) for name in case.tracks}
        table[DRIFT] = table["estimator"].map(drift)
    table = table.dropna(axis="columns", how="all")
    if not any(column in table for column in BARS):
        return None
    return Section(
        "Estimators compared",
        DESCRIPTION.format(reference.description) + _smoothed_description(case),
        Picture(
            "estimator_errors",
            lambda width: _draw_errors(case, reference, table, width),
            "Above, the errors that matter, RMS: of the position as it is live, and of the "
            f"position after {OUTAGE_S:.0f} s in which the estimator is given no GPS. Below, "
            "the error over the flight. "
            + (TILT if np.isfinite(reference.track.q_nb).any() else "")
            + "Without GPS the position drifts until it is back; its scale is logarithmic. "
            "The first seconds, in which every estimator converges, do not count.",
        ),
        ReportTable(
            "estimators",
            table,
            "RMS errors where they count; worst is the greatest. Withheld fixes: horizontal "
            f"error at every {HOLD_OUT}th fix when the estimator is not given it. {DRIFT}: at "
            "the end of such spans.",
        ),
    )


def _error_table(
    tracks: dict[str, FlightTrack], reference: Reference, scored: BoolArray
) -> pd.DataFrame:
    errors = {
        name: metrics.errors_over_time(track, reference.track) for name, track in tracks.items()
    }
    rows = [
        {"estimator": name, **{c: figure(of[key][scored]) for c, figure, key in ERROR_COLUMNS}}
        for name, of in errors.items()
    ]
    return pd.DataFrame(rows).dropna(axis="columns", how="all")


def _reference(case: Case) -> Reference | None:
    if case.flight.reference is not None:
        return case.flight.reference
    if case.frame is None:
        return None
    track = interpolate(case.fixes, case.flight.time_us)
    return Reference(track, is_exact=False, description=OWN_GPS)


def _smoothed_description(case: Case) -> str:
    """Describe how the smoothed track was computed; empty if there is none."""
    set_s, used_s = case.fusion.estimation.reference.gps_latency_s, case.smoothed_latency_s
    if used_s is None:
        return ""
    return SMOOTHED_DESCRIPTION + (
        LATENCY_DESCRIPTION.format(set_s, used_s) if used_s != set_s else ""
    )


def _draw_errors(case: Case, reference: Reference, table: pd.DataFrame, width_in: float) -> Figure:
    errors = {name: metrics.errors_over_time(t, reference.track) for name, t in case.tracks.items()}
    known = [k for k in SHOWN if any(np.isfinite(found[k]).any() for found in errors.values())]
    figure, bars, axes = _error_panels(width_in, [SHOWN[key] for key in known], table)
    for panel, column in zip(bars, filter(table.__contains__, BARS), strict=True):
        _draw_bars(panel, table, column)
    for panel, key in zip(axes, known, strict=True):
        for name, found in errors.items():
            colour = COLOURS.get(name, OTHER)
            shown = np.where(case.flight.scored, found[key], np.nan)
            style.draw(panel, case.flight.time_s, shown, colour, name, lw=1.0)
        if key == "horizontal_m":
            panel.set_yscale("log")
    style.legend_above(axes[0], 3)
    return figure


def _error_panels(
    width_in: float, labels: list[str], table: pd.DataFrame
) -> tuple[Figure, list[Axes], list[Axes]]:
    """Create the panels of the bars, side by side if there is room, and the panels over time."""
    count = sum(column in table for column in BARS)
    shape = (1, count) if width_in >= style.WIDE_IN else (count, 1)
    heights_in = (shape[0] * (0.7 + 0.3 * len(table)), 1.75 * len(labels))
    figure = Figure(figsize=(width_in, sum(heights_in)))
    above, below = figure.add_gridspec(2, 1, height_ratios=heights_in)
    bars = above.subgridspec(*shape).subplots(squeeze=False).ravel()
    axes = below.subgridspec(len(labels), 1).subplots(sharex=True, squeeze=False).ravel()
    for panel, label in zip(axes, labels, strict=True):
        panel.set_ylabel(label)
    axes[-1].set_xlabel("time (s)")
    return figure, list(bars), list(axes)


def _draw_bars(axes: Axes, table: pd.DataFrame, column: str) -> None:
    rows = table[["estimator", column]].dropna().sort_values(column, ascending=False)
    colours = [COLOURS.get(name, OTHER) for name in rows["estimator"]]
    bars = axes.barh(rows["estimator"], rows[column], color=colours, height=0.6)
    axes.bar_label(bars, fmt="%.2f", padding=3)
    axes.set_xlim(0.0, 1.2 * max(float(rows[column].max()), 1e-3))
    axes.set_title(BARS[column], loc="left")
    axes.grid(visible=False, axis="y")


def comparison(a: Case, b: Case) -> Section:
    """Build the section on two cases."""
    same = np.array_equal(a.flight.time_us, b.flight.time_us)
    what = "the same flight with other settings" if same else b.flight.name
    lead = f"A is {a.flight.name}, fused by `{a.chosen}`; B is {what}, fused by `{b.chosen}`."
    apart = "Distance between the two fused tracks over time."
    profiles = "Height above the start and ground speed of both flights, each from its own start."
    known = [
        (same, "comparison_difference", _draw_difference, apart),
        (not same, "comparison_profiles", _draw_profiles, profiles),
        (_on_one_map(a, b), "comparison_map", _draw_map, "Both fused tracks from above."),
    ]
    pictures = [
        Picture(name, partial(draw, a, b), caption)
        for is_shown, name, draw, caption in known
        if is_shown
    ]
    return Section("Comparison", lead, *pictures, *_tables(a, b))


def _tables(a: Case, b: Case) -> list[ReportTable]:
    first, second = summarise(a), summarise(b)
    numbers = pd.DataFrame({"A": first, "B": second}, [*(first | second)])
    numbers = numbers.reset_index(names="")
    numbers["B − A"] = numbers["B"] - numbers["A"]
    tables = [ReportTable("comparison", numbers, "Both in figures, and B minus A.")]
    if changes := changed_settings(a.fusion, b.fusion):
        settings = pd.DataFrame(changes, columns=["setting", "A", "B"]).astype(str)
        tables.append(ReportTable("comparison_settings", settings, "Settings that differ."))
    return tables


def _on_one_map(a: Case, b: Case) -> bool:
    if a.frame is None or b.frame is None:
        return False
    north_deg = abs(a.frame.lat_deg - b.frame.lat_deg)
    east_deg = abs(wrap_180(a.frame.lon_deg - b.frame.lon_deg))
    return max(north_deg, east_deg) < SAME_POSITION_DEG


def _draw_difference(a: Case, b: Case, width_in: float) -> Figure:
    figure, (above, below) = style.over_time(
        width_in, 1.9, ["distance (m)", "attitude difference (deg)"]
    )
    time = a.flight.time_s
    apart = metrics.position_error_m(b.track, a.track)
    turned = metrics.total_error_rad(metrics.rotation_error(b.track.q_nb, a.track.q_nb))
    style.draw(above, time, np.hypot(apart[:, 0], apart[:, 1]), style.BLUE, "horizontal")
    style.draw(above, time, np.abs(apart[:, 2]), style.ORANGE, "vertical")
    style.draw(below, time, np.degrees(turned), style.GREEN, "attitude")
    style.legend_above(above)
    return figure


def _draw_profiles(a: Case, b: Case, width_in: float) -> Figure:
    labels = ["above the start (m)", "ground speed (m/s)"]
    figure, (above, below) = style.over_time(width_in, 2.0, labels)
    for case, name, colour in zip((a, b), NAMES, AB_COLOURS, strict=True):
        track, scored = case.track, case.flight.scored
        alt = np.where(scored, track.alt_amsl_m, np.nan)
        known = alt[np.isfinite(alt)]
        if len(known):
            style.draw(above, case.flight.time_s, alt - known[0], colour, name)
        speed = np.where(scored, np.hypot(track.vel_n_mps[:, 0], track.vel_n_mps[:, 1]), np.nan)
        style.draw(below, case.flight.time_s, speed, colour, name)
    style.legend_above(above)
    return figure


def _draw_map(a: Case, b: Case, width_in: float) -> Figure:
    figure, axes = style.ground_map(width_in, min(0.7 * width_in, 4.6), "A's first fix")
    for case, name, colour, width in zip((a, b), NAMES, AB_COLOURS, (2.6, 1.0), strict=True):
        if a.frame is not None:
            draw_path(axes, a.frame, case.track, colour, name, lw=width)
    style.legend_above(axes)
    return figure


def weights(case: Case) -> Section | None:
    """Build the section on Table I; None without GPS."""
    if case.frame is None:
        return None
    thinned = blend_table(case.flight, case.fusion, INTERVAL_S)
    if not _has_errors(thinned) or not _has_errors(
        full := blend_table(case.flight, case.fusion, 0)
    ):
        return None
    paper = paper_table().rename(columns={"north_m": "paper latitude", "east_m": "paper longitude"})
    return Section(
        "Alpha and beta: Table I",
        _lead(thinned),
        Picture(
            "table1_heat_map",
            lambda width: _draw_heat_map(thinned, width),
            "Mean error against interpolated GPS, metres, on this flight and in the paper. "
            "Light is good. All four maps have one scale, which is logarithmic.",
        ),
        ReportTable(
            "table1",
            _renamed(thinned).merge(paper, on=["alpha", "beta"], how="left"),
            "GPS thinned to one fix a second. Latitude and longitude: mean error against "
            "interpolated GPS, as in the paper. Held out: horizontal RMS error at the fixes "
            "withheld from the filter. Against reference: horizontal RMS error over the "
            "whole flight, stretches without GPS included. All in metres.",
            strong=(_best(thinned),),
        ),
        ReportTable(
            "table1_all_fixes",
            _renamed(full),
            "The same with every fix of the receiver.",
            strong=(_best(full),),
        ),
    )


def _lead(table: pd.DataFrame) -> str:
    best = table.iloc[_best(table)]
    both = grows(table, "north_m") and grows(table, "east_m")
    shape = (
        "As in the paper, both errors grow" if both else "Unlike in the paper, not both errors grow"
    )
    return (
        "Alpha is the weight of the integrated acceleration in the velocity, beta that of the "
        f"integrated velocity in the position. {shape} with alpha and with beta in every row and "
        f"column; the smallest error is at {best.alpha:g}/{best.beta:g}. The figures differ from "
        "the paper's in size for three reasons: it is another flight; here the filter blends once "
        "at each fix and with the corrected equations, since the printed ones cannot be computed; "
        "and each fix is carried forward by its latency. GPS is thinned to one fix a second here "
        "because with many fixes there is little between them to get wrong."
    )


def _has_errors(table: pd.DataFrame) -> bool:
    return bool(table[["north_m", "east_m"]].notna().all(axis=1).any())


def _best(table: pd.DataFrame) -> int:
    return int(np.argmin(np.hypot(table["north_m"], table["east_m"])))


def _renamed(table: pd.DataFrame) -> pd.DataFrame:
    names = {
        "alpha": "alpha", "beta": "beta", "north_m": "latitude", "east_m": "longitude",
        "held_m": "held out", "reference_m": "against reference",
    }  # fmt: skip
    known = [name for name in names if table[name].notna().any()]
    return table[known].rename(columns=names)


def _draw_heat_map(table: pd.DataFrame, width_in: float) -> Figure:
    wide = width_in >= style.WIDE_IN
    figure = Figure(figsize=(width_in, 2.5 if wide else 4.2))
    axes = figure.subplots(1, 4) if wide else figure.subplots(2, 2)
    values = {
        f"{name}, {way}": source.pivot_table(column, "alpha", "beta").to_numpy()
        for name, source in (("this flight", table), ("paper", paper_table()))
        for way, column in (("latitude", "north_m"), ("longitude", "east_m"))
    }
    every = np.concatenate([grid.ravel() for grid in values.values()])
    # The error of a flight along a meridian or a parallel is zero, which has no logarithm.
    scale = LogNorm(float(every[every > 0.0].min()), float(np.nanmax(every)))
    for panel, (title, grid) in zip(axes.ravel(), values.items(), strict=True):
        panel.imshow(grid, cmap=COLOUR_MAP, norm=scale, origin="lower", aspect="auto")
        for (row, col), value in np.ndenumerate(grid):
            dark = scale(value) > 0.5
            panel.text(
                col, row, f"{value:.1f}", ha="center", va="center",
                color="#ffffff" if dark else "#000000",
            )  # fmt: skip
        panel.set_title(title)
        panel.set_xticks(range(len(WEIGHTS)), [f"{weight:g}" for weight in WEIGHTS])
        panel.set_yticks(range(len(WEIGHTS)), [f"{weight:g}" for weight in WEIGHTS])
        panel.grid(visible=False)
        panel.set_xlabel("beta")
    for panel in axes.ravel()[:: 4 if wide else 2]:
        panel.set_ylabel("alpha")
    return figure
