"""Position: the track on a map, GPS before and after interpolation, latitude and longitude."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gateway.analysis.case import Case
from gateway.analysis.flight_arrays import FlightTrack, FloatArray, LocalFrame, fixes_of
from gateway.analysis.interpolation import interpolate
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, Section

EXCERPT_S: Final = 12.0
ROUND_M: Final = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000)


def ground_track(case: Case) -> Section | None:
    """Build the section of the map; None without GPS."""
    if case.frame is None:
        return None
    return Section(
        "Ground track",
        "The flight from above, on a plain local map: no map tiles, so the page needs no network. "
        f"The fused track is that of the estimator `{case.chosen}`.",
        [
            Picture(
                "ground_track",
                lambda width: _draw_map(case, width),
                "Metres east and north of the first fix, with a grid of latitude and longitude. "
                + _map_caption(case),
            )
        ],
    )


def gps_interpolation(case: Case) -> Section | None:
    """Build the section of figures 11 to 13; None without GPS."""
    if case.frame is None:
        return None
    count = len(fixes_of(case.flight))
    return Section(
        "GPS before and after interpolation",
        f"GPS measures {count} times in this flight, the IMU {len(case.flight.time_us)} "
        "times (figures 11 to 13 of the paper). Straight lines between the fixes fill the gaps, "
        "but only afterwards: the next fix must be known. The fused track fills them at once. "
        "Gaps of more than 2 s are left open.",
        [
            Picture(
                "fig11_12_interpolation",
                lambda width: _draw_interpolation(case, width),
                "The same stretch of the track as single fixes and with straight lines between "
                "them.",
            ),
            Picture(
                "fig13_latitude_longitude",
                lambda width: _draw_coordinates(case, width),
                f"Latitude and longitude over {EXCERPT_S:.0f} s: fixes held until the next one as "
                "they arrive, interpolated between the times at which they were valid, and fused.",
            ),
            Picture(
                "fig13_residuals",
                lambda width: _draw_residuals(case, width),
                "The whole flight: how far north and east the held fixes and the fused track are "
                "from the interpolated GPS. The axis ends at what 99.5 % of the held values "
                "reach; the first seconds, in which the estimator converges, do not count.",
            ),
        ],
    )


def _map_caption(case: Case) -> str:
    if case.flight.reference is None:
        return "Dots are GPS fixes, the line is the fused track."
    return f"Dots are GPS fixes, the line is the fused track, the broad line the {case.truth_name}."


def _draw_map(case: Case, width_in: float) -> Figure:
    frame = case.frame
    assert frame is not None
    fixes = fixes_of(case.flight)
    figure = Figure(figsize=(width_in, width_in * 0.72 if width_in >= style.WIDE_IN else 4.2))
    axes = figure.subplots()
    reference = case.flight.reference
    if reference is not None:
        _path(axes, frame, reference.track, style.REFERENCE, case.truth_name, lw=4.0, alpha=0.25)
    north_m, east_m = frame.north_m(fixes.lat_deg), frame.east_m(fixes.lon_deg)
    axes.plot(east_m, north_m, ".", color=style.ORANGE, ms=3.2, label="GPS fixes")
    _path(axes, frame, case.track, style.BLUE, "fused", lw=1.2)
    _start_and_end(axes, east_m, north_m)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east of the first fix (m)", ylabel="north of the first fix (m)")
    style.legend_outside(figure, axes, 5 if width_in >= style.WIDE_IN else 3)
    figure.draw_without_rendering()
    _graticule(axes, frame)
    _scale_and_north(axes, east_m, north_m)
    return figure


def _path(
    axes: Axes, frame: LocalFrame, track: FlightTrack, colour: str, label: str, **style_of: float
) -> None:
    step = max(1, len(track.lat_deg) // 4000)
    place = frame.place(track.lat_deg[::step], track.lon_deg[::step])
    axes.plot(place[:, 1], place[:, 0], color=colour, label=label, **style_of)


def _start_and_end(axes: Axes, east_m: FloatArray, north_m: FloatArray) -> None:
    axes.plot(east_m[0], north_m[0], "^", color=style.GREEN, ms=7, label="start")
    axes.plot(east_m[-1], north_m[-1], "s", color=style.RED, ms=6, label="end", mfc="none")


def _graticule(axes: Axes, frame: LocalFrame) -> None:
    """Label latitude and longitude on the upper and right side."""
    per_lat = float(frame.north_m(np.array([frame.lat_deg + 1.0]))[0])
    per_lon = float(frame.east_m(np.array([frame.lon_deg + 1.0]))[0])
    right = axes.secondary_yaxis(
        "right",
        functions=(lambda m: frame.lat_deg + m / per_lat, lambda d: (d - frame.lat_deg) * per_lat),
    )
    top = axes.secondary_xaxis(
        "top",
        functions=(lambda m: frame.lon_deg + m / per_lon, lambda d: (d - frame.lon_deg) * per_lon),
    )
    for axis in (right.yaxis, top.xaxis):
        axis.get_major_formatter().set_useOffset(False)
        axis.set_major_locator(MaxNLocator(4))
    right.tick_params(labelsize=7.0, labelcolor=style.MUTED)
    top.tick_params(labelsize=7.0, labelcolor=style.MUTED)
    right.spines["right"].set_visible(True)
    top.spines["top"].set_visible(True)
    right.set_ylabel("latitude (deg)", color=style.MUTED, fontsize=7.0)
    top.set_xlabel("longitude (deg)", color=style.MUTED, fontsize=7.0)


def _scale_and_north(axes: Axes, east_m: FloatArray, north_m: FloatArray) -> None:
    """Draw the scale in the emptiest corner, and the arrow in the emptiest of the others."""
    low, high = axes.get_xlim()
    bottom, top = axes.get_ylim()
    across, up = (east_m - low) / (high - low), (north_m - bottom) / (top - bottom)

    def crowd(corner: tuple[float, float]) -> float:
        nearest: float = np.hypot(across - corner[0], up - corner[1]).min()
        return -nearest

    scale, arrow = sorted(((0.14, 0.06), (0.86, 0.06), (0.14, 0.92), (0.86, 0.92)), key=crowd)[:2]
    length = max((m for m in ROUND_M if m <= 0.22 * (high - low)), default=ROUND_M[0])
    x, y = low + scale[0] * (high - low) - 0.5 * length, bottom + scale[1] * (top - bottom)
    axes.plot([x, x + length], [y, y], color=style.INK, lw=3.0, solid_capstyle="butt")
    axes.annotate(
        f"{length} m", (x + 0.5 * length, y), (0, 5), textcoords="offset points", ha="center"
    )
    axes.annotate(
        "N", xy=(arrow[0], arrow[1] + 0.06), xytext=(arrow[0], arrow[1] - 0.05),
        xycoords="axes fraction", ha="center", va="center", fontweight="bold",
        arrowprops={"arrowstyle": "-|>", "color": style.INK},
    )  # fmt: skip


def _excerpt(case: Case) -> tuple[int, int]:
    """Choose the fixes around the sharpest turn of the track."""
    fixes = fixes_of(case.flight)
    course = np.unwrap(np.arctan2(fixes.vel_n_mps[:, 1], fixes.vel_n_mps[:, 0]))
    speed = np.hypot(fixes.vel_n_mps[:, 0], fixes.vel_n_mps[:, 1])
    seconds = case.flight.seconds(fixes.valid_us)
    best, chosen = -1.0, (0, len(fixes))
    for begin in range(0, len(fixes), 5):
        end = int(np.searchsorted(seconds, seconds[begin] + EXCERPT_S))
        if end >= len(fixes) or end - begin < 3 or np.diff(seconds[begin:end]).max() > 2.0:
            continue
        turned = abs(course[end] - course[begin]) * float(speed[begin:end].min())
        if np.isfinite(turned) and turned > best:
            best, chosen = turned, (begin, end)
    return chosen


def _draw_interpolation(case: Case, width_in: float) -> Figure:
    frame = case.frame
    assert frame is not None
    fixes = fixes_of(case.flight)
    begin, end = _excerpt(case)
    figure, axes = style.panels(width_in, 1, 3.4, columns=2, share_x=False)
    place = frame.place(fixes.lat_deg[begin:end], fixes.lon_deg[begin:end])
    for panel in axes:
        panel.plot(place[:, 1], place[:, 0], "o", color=style.ORANGE, ms=3.6, label="GPS fixes")
        panel.set(xlabel="east (m)")
        style.fit_square(panel, place[:, 1], place[:, 0])
    axes[0].set_ylabel("north (m)")
    axes[1].plot(place[:, 1], place[:, 0], color=style.BLUE, label="interpolated")
    axes[0].set_title("before")
    axes[1].set_title("after")
    axes[1].legend(loc="best")
    return figure


def _draw_coordinates(case: Case, width_in: float) -> Figure:
    flight = case.flight
    fixes = fixes_of(flight)
    begin, end = _excerpt(case)
    low_us, high_us = fixes.arrival_us[begin], fixes.arrival_us[min(end, len(fixes) - 1)]
    rows = (flight.time_us >= low_us) & (flight.time_us <= high_us)
    time_us = flight.time_us[rows]
    straight = interpolate(fixes, time_us)
    held = np.searchsorted(fixes.arrival_us, time_us, side="right") - 1
    figure, axes = style.panels(width_in, 2, 2.2)
    seconds = flight.seconds(time_us)
    for panel, name in zip(axes, ("lat_deg", "lon_deg"), strict=True):
        panel.step(
            seconds, getattr(fixes, name)[held], color=style.ORANGE, label="raw, held", lw=1.0
        )
        panel.plot(
            seconds, getattr(straight, name), color=style.GREEN, label="interpolated", lw=1.6
        )
        panel.plot(seconds, getattr(case.track, name)[rows], color=style.BLUE, label="fused")
        panel.yaxis.get_major_formatter().set_useOffset(False)
    axes[0].set_ylabel("latitude (deg)")
    axes[1].set(ylabel="longitude (deg)", xlabel="time (s)")
    style.legend_above(axes[0])
    return figure


def _draw_residuals(case: Case, width_in: float) -> Figure:
    flight, frame = case.flight, case.frame
    assert frame is not None
    fixes = fixes_of(flight)
    straight = interpolate(fixes, flight.time_us)
    base = frame.place(straight.lat_deg, straight.lon_deg)
    newest = np.searchsorted(fixes.arrival_us, flight.time_us, side="right") - 1
    held = frame.place(fixes.lat_deg[newest], fixes.lon_deg[newest]) - base
    fused = frame.place(case.track.lat_deg, case.track.lon_deg) - base
    held[~flight.scored], fused[~flight.scored] = np.nan, np.nan
    figure, axes = style.panels(width_in, 2, 1.6)
    for panel, axis, name in zip(axes, (0, 1), ("north (m)", "east (m)"), strict=True):
        style.draw(panel, flight.time_s, held[:, axis], style.ORANGE, "held", lw=0.8)
        style.draw(panel, flight.time_s, fused[:, axis], style.BLUE, "fused", lw=1.0)
        panel.set_ylabel(name)
        if np.isfinite(held[:, axis]).any():
            limit = float(np.nanquantile(np.abs(held[:, axis]), 0.995)) + 1.0
            panel.set_ylim(-limit, limit)
    axes[-1].set_xlabel("time (s)")
    style.legend_above(axes[0])
    return figure
