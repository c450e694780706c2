"""Orientation: yaw by the gyroscope alone and with the magnetometer, and the quaternion."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gateway.analysis.case import Case
from gateway.analysis.flight_arrays import FloatArray, IntArray
from gateway.analysis.metrics import euler_rad, rms, worst
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, ReportTable, Section
from gateway.geometry.angle import wrap_180
from gateway.geometry.quaternion import integrate_rate
from gateway.units import US_PER_S

PAPER: Final = "paper"
GYRO: Final = "gyroscope alone"
COMPASS: Final = "gyroscope and compass"
COLOURS: Final = (style.ORANGE, style.GREEN, style.BLUE)
MAX_STEP_S: Final = 0.5


def orientation(case: Case) -> Section | None:
    """Build the section; None without a compass."""
    flight = case.flight
    if not np.isfinite(flight.mag_b_ut).any():
        return None
    lines = yaw_lines(case)
    below = "its error" if flight.reference else f"how far it is from the estimator {case.chosen}"
    return Section(
        "Yaw and quaternion",
        "Yaw by integrating the gyroscope alone drifts without limit; the magnetometer corrects "
        "it (figure 7 of the paper). In long turns the paper's filter slowly takes the bank "
        "for level flight, which tilts its compass; the drift of the gyroscope may be less "
        "than that for some minutes, but it never comes back. The quaternion has no gimbal lock "
        "and no jump at 360° (figure 8).",
        [
            Picture(
                "fig07_yaw",
                lambda width: _draw_yaw(case, lines, width),
                f"Above: yaw over the flight, turns counted on. Below: {below}.",
            ),
            Picture(
                "fig08_quaternion",
                lambda width: _draw_quaternion(case, width),
                f"The attitude of the estimator `{case.chosen}`, body to north-east-down, the "
                "scalar part w first. The sign is chosen so that no part jumps.",
            ),
        ],
        [ReportTable("yaw", _yaw_table(lines), f"Yaw error against {lines.story}.", digits=1)],
    )


@dataclass(frozen=True, slots=True)
class YawLines:
    """Yaw by several methods, continuous, in degrees."""

    yaw_deg: dict[str, FloatArray]
    """Shape (N,) each, by name in the legend."""
    reference_deg: FloatArray
    """The reference."""
    story: str
    """Description of the reference."""

    def error_deg(self, name: str) -> FloatArray:
        """Error of a line; that of the gyroscope may exceed a turn."""
        error = self.yaw_deg[name] - self.reference_deg
        if name == GYRO:
            return error
        return wrap_180(error)


def yaw_lines(case: Case) -> YawLines:
    """Compare yaw by the gyroscope alone with yaw of the paper's filter and the chosen one's."""
    flight, reference = case.flight, case.flight.reference
    fused = {COMPASS: case.tracks[PAPER]}
    if reference and case.chosen != PAPER:
        fused[f"estimator {case.chosen}"] = case.track
    judge = reference.track if reference else case.track
    known = np.isfinite(judge.q_nb).all(axis=1)
    if not known.any():
        judge, known = case.track, np.isfinite(case.track.q_nb).all(axis=1)
    start = int(np.argmax(known))
    gyro_q = np.full((len(flight.time_us), 4), np.nan)
    gyro_q[start:] = _attitude_by_rate(
        flight.time_us[start:], flight.gyro_b_radps[start:], judge.q_nb[start]
    )
    reference_deg = continuous_yaw_deg(judge.q_nb)
    yaw = {GYRO: continuous_yaw_deg(gyro_q)}
    yaw |= {name: continuous_yaw_deg(track.q_nb) for name, track in fused.items()}
    for name, line in yaw.items():
        # All start in the same turn.
        both = np.flatnonzero(np.isfinite(line) & np.isfinite(reference_deg))
        turns = np.round((line[both[:1]] - reference_deg[both[:1]]) / 360.0)
        yaw[name] = line - 360.0 * (turns[0] if len(turns) else 0.0)
    story = reference.story if reference else f"the estimator {case.chosen}"
    return YawLines(yaw, reference_deg, story)


def continuous_yaw_deg(q_nb: FloatArray) -> FloatArray:
    """Count yaw on over full turns; NaN where the attitude is not known."""
    yaw = euler_rad(q_nb)[:, 2]
    known = np.isfinite(yaw)
    yaw[known] = np.unwrap(yaw[known])
    return np.degrees(yaw)


def _yaw_table(lines: YawLines) -> pd.DataFrame:
    rows = []
    for name in lines.yaw_deg:
        error = lines.error_deg(name)
        known = error[np.isfinite(error)]
        rows.append(
            {
                "yaw from": name,
                "RMS error, deg": rms(error),
                "greatest, deg": worst(error),
                "at the end, deg": float(known[-1]) if len(known) else float("nan"),
            }
        )
    return pd.DataFrame(rows)


def _attitude_by_rate(time_us: IntArray, gyro_b_radps: FloatArray, q_nb: FloatArray) -> FloatArray:
    """Integrate the rate, except over steps that go back in time or exceed `MAX_STEP_S`."""
    dt_s = np.diff(time_us, prepend=time_us[:1]) / US_PER_S
    dt_s = np.where((dt_s > 0.0) & (dt_s <= MAX_STEP_S), dt_s, 0.0)
    return integrate_rate(dt_s, np.nan_to_num(gyro_b_radps), q_nb)


def _draw_yaw(case: Case, lines: YawLines, width_in: float) -> Figure:
    figure, (above, below) = style.panels(width_in, 2, 2.3)
    time = case.flight.time_s
    if case.flight.reference:
        style.draw(
            above, time, lines.reference_deg, style.REFERENCE, case.truth_name, lw=2.4, alpha=0.4
        )
    for (name, yaw), colour in zip(lines.yaw_deg.items(), COLOURS, strict=False):
        style.draw(above, time, yaw, colour, name)
        style.draw(below, time, lines.error_deg(name), colour, name)
    above.set_ylabel("yaw, turns counted on (deg)")
    below.set_ylabel("yaw error (deg)" if case.flight.reference else "difference (deg)")
    below.set_xlabel("time (s)")
    style.legend_outside(figure, above, 4 if width_in >= style.WIDE_IN else 2)
    return figure


def _draw_quaternion(case: Case, width_in: float) -> Figure:
    figure, (axes,) = style.panels(width_in, 1, 2.8)
    q_nb = continuous(case.track.q_nb)
    colours = (style.INK, style.BLUE, style.RED, style.GREEN)
    for name, part, colour in zip("wxyz", q_nb.T, colours, strict=True):
        style.draw(axes, case.flight.time_s, part, colour, name)
    axes.set(xlabel="time (s)", ylabel="part of the quaternion (1)", ylim=(-1.05, 1.05))
    style.legend_above(axes)
    return figure


def continuous(q_nb: FloatArray) -> FloatArray:
    """Choose the signs of quaternions of shape (N, 4) so that no part jumps."""
    nearer = np.einsum("ij,ij->i", q_nb[1:], q_nb[:-1]) < 0.0
    signs = np.where(np.cumsum(np.concatenate([[False], nearer])) % 2 == 1, -1.0, 1.0)
    return np.asarray(q_nb * signs[:, np.newaxis])
