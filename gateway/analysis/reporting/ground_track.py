"""Sections on attitude and position over the flight: yaw, quaternion, map, interpolated GPS."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gateway.analysis.blending import interpolate
from gateway.analysis.case import Case
from gateway.analysis.flight import FlightTrack, FloatArray, IntArray
from gateway.analysis.metrics import euler_rad, rms, worst
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, ReportTable, Section, table_of_series
from gateway.geometry.angle import wrap_180
from gateway.geometry.quaternion import integrate_rate
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import LocalFrame

PAPER: Final = "paper"
GYRO: Final = "gyroscope alone"
COMPASS: Final = "gyroscope and compass"
COLOURS: Final = (style.ORANGE, style.GREEN, style.BLUE)
MAX_STEP_S: Final = 0.5
EXCERPT_S: Final = 12.0
ROUND_M: Final = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000)


def orientation(case: Case) -> Section | None:
    """Build the section on yaw; None without a compass."""
    flight = case.flight
    if not np.isfinite(flight.imu.mag_b_ut).any():
        return None
    lines = yaw_lines(case)
    below = "its error" if flight.reference else f"its difference from the estimator {case.chosen}"
    return Section(
        "Yaw and quaternion",
        "Yaw by integrating the gyroscope alone drifts without limit; the magnetometer corrects "
        "it (figure 7 of the paper). In long turns the paper's filter interprets the bank as level "
        "flight, which tilts its compass; for some minutes the gyroscope's drift may be less than "
        "this error, but it never decreases. The quaternion has no gimbal lock "
        "and no jump at 360° (figure 8).",
        Picture(
            "fig07_yaw",
            lambda width: _draw_yaw(case, lines, width),
            f"Above: unwrapped yaw over the flight. Below: {below}.",
        ),
        Picture(
            "fig08_quaternion",
            lambda width: _draw_quaternion(case, width),
            f"The attitude of the estimator `{case.chosen}`, body to north-east-down, the "
            "scalar w first. The sign is chosen so that no component jumps.",
        ),
        ReportTable("yaw", _yaw_table(lines), f"Yaw error against {lines.description}.", digits=1),
    )


@dataclass(frozen=True, slots=True)
class YawLines:
    """Yaw by several methods, unwrapped, in degrees."""

    yaw_deg: dict[str, FloatArray]
    """Shape (N,) each, by name for the legend."""
    reference_deg: FloatArray
    """Yaw of the reference, shape (N,)."""
    description: str

    def error_deg(self, name: str) -> FloatArray:
        """Return the error of a line; that of the gyroscope may exceed a full turn."""
        error = self.yaw_deg[name] - self.reference_deg
        return error if name == GYRO else wrap_180(error)


def yaw_lines(case: Case) -> YawLines:
    """Compute yaw from the gyroscope alone, from the paper's filter, and from the chosen one."""
    flight, reference = case.flight, case.flight.reference
    fused = {COMPASS: case.tracks[PAPER]}
    if reference and case.chosen != PAPER:
        fused[f"estimator {case.chosen}"] = case.track
    basis = reference.track if reference else case.track
    known = np.isfinite(basis.q_nb).all(axis=1)
    if not known.any():
        basis, known = case.track, np.isfinite(case.track.q_nb).all(axis=1)
    start = int(np.argmax(known))
    gyro_q = np.full((len(flight.time_us), 4), np.nan)
    gyro_q[start:] = _attitude_by_rate(
        flight.time_us[start:], flight.imu.gyro_b_radps[start:], basis.q_nb[start]
    )
    reference_deg = continuous_yaw_deg(basis.q_nb)
    yaw = {GYRO: continuous_yaw_deg(gyro_q)}
    yaw |= {name: continuous_yaw_deg(track.q_nb) for name, track in fused.items()}
    for name, line in yaw.items():
        # Remove whole turns between the lines at their start.
        both = np.flatnonzero(np.isfinite(line) & np.isfinite(reference_deg))
        turns = np.round((line[both[:1]] - reference_deg[both[:1]]) / 360.0)
        yaw[name] = line - 360.0 * (turns[0] if len(turns) else 0.0)
    description = reference.description if reference else f"the estimator {case.chosen}"
    return YawLines(yaw, reference_deg, description)


def continuous_yaw_deg(q_nb: FloatArray) -> FloatArray:
    """Return unwrapped yaw; NaN where the attitude is unknown."""
    yaw = euler_rad(q_nb)[:, 2]
    known = np.isfinite(yaw)
    yaw[known] = np.unwrap(yaw[known])
    return np.degrees(yaw)


def _yaw_table(lines: YawLines) -> pd.DataFrame:
    def last(error: FloatArray) -> float:
        known = error[np.isfinite(error)]
        return float(known[-1]) if len(known) else NAN

    return table_of_series(
        "yaw from",
        {name: lines.error_deg(name) for name in lines.yaw_deg},
        {"RMS error, deg": rms, "greatest, deg": worst, "at the end, deg": last},
    )


def _attitude_by_rate(time_us: IntArray, gyro_b_radps: FloatArray, q_nb: FloatArray) -> FloatArray:
    """Integrate the rate, except over steps back in time or longer than `MAX_STEP_S`."""
    dt_s = np.diff(time_us, prepend=time_us[:1]) / US_PER_S
    dt_s = np.where((dt_s > 0.0) & (dt_s <= MAX_STEP_S), dt_s, 0.0)
    return integrate_rate(dt_s, np.nan_to_num(gyro_b_radps), q_nb)


def _draw_yaw(case: Case, lines: YawLines, width_in: float) -> Figure:
    below_label = "yaw error (deg)" if case.flight.reference else "difference (deg)"
    labels = ["unwrapped yaw (deg)", below_label]
    figure, (above, below) = style.over_time(width_in, 2.3, labels)
    time = case.flight.time_s
    if case.flight.reference:
        style.draw(
            above, time, lines.reference_deg, style.REFERENCE, case.truth_name, lw=2.4, alpha=0.4
        )
    for (name, yaw), colour in zip(lines.yaw_deg.items(), COLOURS, strict=False):
        style.draw(above, time, yaw, colour, name)
        style.draw(below, time, lines.error_deg(name), colour, name)
    style.legend_outside(figure, above, 4 if width_in >= style.WIDE_IN else 2)
    return figure


def _draw_quaternion(case: Case, width_in: float) -> Figure:
    figure, (axes,) = style.over_time(width_in, 2.8, ["quaternion component (1)"])
    q_nb = continuous(case.track.q_nb)
    colours = (style.INK, style.BLUE, style.RED, style.GREEN)
    for name, part, colour in zip("wxyz", q_nb.T, colours, strict=True):
        style.draw(axes, case.flight.time_s, part, colour, name)
    axes.set_ylim(-1.05, 1.05)
    style.legend_above(axes)
    return figure


def continuous(q_nb: FloatArray) -> FloatArray:
    """Choose the signs of quaternions, shape (N, 4), so that no component jumps."""
    nearer = np.einsum("ij,ij->i", q_nb[1:], q_nb[:-1]) < 0.0
    signs = np.where(np.cumsum(np.concatenate([[False], nearer])) % 2 == 1, -1.0, 1.0)
    return np.asarray(q_nb * signs[:, np.newaxis])


def ground_track(case: Case) -> Section | None:
    """Build the section of the map; None without GPS."""
    if (frame := case.frame) is None:
        return None
    broad = f", the broad line the {case.truth_name}" if case.flight.reference else ""
    return Section(
        "Ground track",
        "The flight from above, on a plain local map: no map tiles, so the page needs no network. "
        f"The fused track is that of the estimator `{case.chosen}`.",
        Picture(
            "ground_track",
            lambda width: _draw_map(case, frame, width),
            "Metres east and north of the first fix, with a grid of latitude and longitude. "
            f"Dots are GPS fixes, the line is the fused track{broad}.",
        ),
    )


def gps_interpolation(case: Case) -> Section | None:
    """Build the section with figures 11 to 13; None without GPS."""
    if (frame := case.frame) is None:
        return None
    return Section(
        "GPS before and after interpolation",
        f"GPS measures {len(case.fixes)} times in this flight, the IMU {len(case.flight.time_us)} "
        "times (figures 11 to 13 of the paper). Straight lines between the fixes fill the gaps, "
        "but only afterwards: the next fix must be known. The fused track fills them at once. "
        "Gaps of more than 2 s are left open.",
        Picture(
            "fig11_12_interpolation",
            lambda width: _draw_interpolation(case, frame, width),
            "The same stretch of the track as single fixes and with straight lines between them.",
        ),
        Picture(
            "fig13_latitude_longitude",
            lambda width: _draw_coordinates(case, width),
            f"Latitude and longitude over {EXCERPT_S:.0f} s: fixes held until the next one as "
            "they arrive, interpolated between the times at which they were valid, and fused.",
        ),
        Picture(
            "fig13_residuals",
            lambda width: _draw_residuals(case, frame, width),
            "The whole flight: how far north and east the held fixes and the fused track are "
            "from the interpolated GPS. The axis ends at what 99.5 % of the held values "
            "reach; the first seconds, in which the estimator converges, do not count.",
        ),
    )


def _draw_map(case: Case, frame: LocalFrame, width_in: float) -> Figure:
    fixes, reference = case.fixes, case.flight.reference
    height_in = width_in * 0.72 if width_in >= style.WIDE_IN else 4.2
    figure, axes = style.ground_map(width_in, height_in, "the first fix")
    if reference is not None:
        broad = (style.REFERENCE, case.truth_name)
        draw_path(axes, frame, reference.track, *broad, lw=4.0, alpha=0.25)
    pos_m = frame.local_m(fixes.lat_deg, fixes.lon_deg)
    axes.plot(pos_m[:, 1], pos_m[:, 0], ".", color=style.ORANGE, ms=3.2, label="GPS fixes")
    draw_path(axes, frame, case.track, style.BLUE, "fused", lw=1.2)
    style.mark_ends(axes, pos_m)
    style.legend_outside(figure, axes, 5 if width_in >= style.WIDE_IN else 3)
    figure.draw_without_rendering()
    _graticule(axes, frame)
    _scale_and_north(axes, pos_m[:, 1], pos_m[:, 0])
    return figure


def draw_path(
    axes: Axes, frame: LocalFrame, track: FlightTrack, colour: str, label: str, **style_of: float
) -> None:
    """Draw a track from above, with a limited number of points."""
    step = max(1, len(track.lat_deg) // 4000)
    pos_m = frame.local_m(track.lat_deg[::step], track.lon_deg[::step])
    axes.plot(pos_m[:, 1], pos_m[:, 0], color=colour, label=label, **style_of)


def _graticule(axes: Axes, frame: LocalFrame) -> None:
    """Label latitude and longitude on the upper and right side."""
    corner_deg = np.array([[frame.lat_deg + 1.0], [frame.lon_deg + 1.0]])
    per_lat, per_lon = frame.local_m(*corner_deg)[0].tolist()
    for add, side, origin, scale, name in (
        (axes.secondary_yaxis, "right", frame.lat_deg, per_lat, "latitude (deg)"),
        (axes.secondary_xaxis, "top", frame.lon_deg, per_lon, "longitude (deg)"),
    ):
        functions = (
            lambda m, o=origin, s=scale: o + m / s,
            lambda d, o=origin, s=scale: (d - o) * s,
        )
        shown = add(side, functions=functions)
        axis = shown.yaxis if side == "right" else shown.xaxis
        axis.get_major_formatter().set_useOffset(False)
        axis.set_major_locator(MaxNLocator(4))
        axis.set_label_text(name, color=style.MUTED, fontsize=7.0)
        shown.tick_params(labelsize=7.0, labelcolor=style.MUTED)
        shown.spines[side].set_visible(True)


def _scale_and_north(axes: Axes, east_m: FloatArray, north_m: FloatArray) -> None:
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
    """Return the range of fixes around the sharpest turn of the track."""
    fixes = case.fixes
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


def _draw_interpolation(case: Case, frame: LocalFrame, width_in: float) -> Figure:
    fixes, (begin, end) = case.fixes, _excerpt(case)
    figure, axes = style.panels(width_in, 1, 3.4, columns=2, share_x=False)
    pos_m = frame.local_m(fixes.lat_deg[begin:end], fixes.lon_deg[begin:end])
    for panel in axes:
        panel.plot(pos_m[:, 1], pos_m[:, 0], "o", color=style.ORANGE, ms=3.6, label="GPS fixes")
        panel.set(xlabel="east (m)")
        style.fit_square(panel, pos_m[:, 1], pos_m[:, 0])
    axes[0].set_ylabel("north (m)")
    axes[1].plot(pos_m[:, 1], pos_m[:, 0], color=style.BLUE, label="interpolated")
    axes[0].set_title("before")
    axes[1].set_title("after")
    axes[1].legend(loc="best")
    return figure


def _draw_coordinates(case: Case, width_in: float) -> Figure:
    flight, fixes, (begin, end) = case.flight, case.fixes, _excerpt(case)
    low_us, high_us = fixes.arrival_us[begin], fixes.arrival_us[min(end, len(fixes) - 1)]
    rows = (flight.time_us >= low_us) & (flight.time_us <= high_us)
    time_us = flight.time_us[rows]
    straight = interpolate(fixes, time_us)
    held = np.searchsorted(fixes.arrival_us, time_us, side="right") - 1
    figure, axes = style.over_time(width_in, 2.2, ["latitude (deg)", "longitude (deg)"])
    seconds = flight.seconds(time_us)
    for panel, name in zip(axes, ("lat_deg", "lon_deg"), strict=True):
        raw = getattr(fixes, name)[held]
        panel.step(seconds, raw, color=style.ORANGE, label="raw, held", lw=1.0)
        line = getattr(straight, name)
        panel.plot(seconds, line, color=style.GREEN, label="interpolated", lw=1.6)
        panel.plot(seconds, getattr(case.track, name)[rows], color=style.BLUE, label="fused")
        panel.yaxis.get_major_formatter().set_useOffset(False)
    style.legend_above(axes[0])
    return figure


def _draw_residuals(case: Case, frame: LocalFrame, width_in: float) -> Figure:
    flight, fixes = case.flight, case.fixes
    straight = interpolate(fixes, flight.time_us)
    base = frame.local_m(straight.lat_deg, straight.lon_deg)
    newest = np.searchsorted(fixes.arrival_us, flight.time_us, side="right") - 1
    held = frame.local_m(fixes.lat_deg[newest], fixes.lon_deg[newest]) - base
    fused = frame.local_m(case.track.lat_deg, case.track.lon_deg) - base
    held[~flight.scored], fused[~flight.scored] = np.nan, np.nan
    figure, axes = style.over_time(width_in, 1.6, ["north (m)", "east (m)"])
    for axis, panel in enumerate(axes):
        style.draw(panel, flight.time_s, held[:, axis], style.ORANGE, "held", lw=0.8)
        style.draw(panel, flight.time_s, fused[:, axis], style.BLUE, "fused", lw=1.0)
        if np.isfinite(held[:, axis]).any():
            limit = float(np.nanquantile(np.abs(held[:, axis]), 0.995)) + 1.0
            panel.set_ylim(-limit, limit)
    style.legend_above(axes[0])
    return figure
