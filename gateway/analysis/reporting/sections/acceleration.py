"""Acceleration: raw, Butterworth and Chebyshev, and how the two filters differ."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from gateway.analysis.case import Case
from gateway.analysis.filtering import KINDS, PAPER_RATE_HZ, apply, compare, response
from gateway.analysis.flight_arrays import Flight
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, ReportTable, Section

EXCERPT_S: Final = 6.0
COLOURS: Final = {"butterworth": style.BLUE, "chebyshev": style.RED}
AXIS_NAMES: Final = "xyz"


def acceleration(case: Case) -> Section:
    """Build the section; if the flight's rate is too low for the filters, only their design."""
    paper, rate_hz = case.fusion.estimation.paper, case.flight.rate_hz
    cutoff = paper.accel_cutoff_hz
    if cutoff >= 0.5 * rate_hz:
        return Section(
            "Acceleration filters",
            f"At this flight's {rate_hz:.0f} samples/s a low-pass at {cutoff:g} Hz does nothing: "
            "half the sample rate is the highest possible frequency. So there is nothing to "
            "draw of this flight; the table shows the filters at the paper's rate.",
            [],
            [_paper_table(case)],
        )
    return Section(
        "Acceleration filters",
        f"Second-order low-passes at {cutoff:g} Hz, as in figures 9 and 10 of the paper. "
        "Chebyshev passes all up to the cutoff and falls faster from there, but rings after a "
        "step and delays unevenly. "
        "The paper says that it also takes longer; with the same order both are the same five "
        f"multiplications per sample, and the table gives their time here.",
        [
            _excerpt(case, 0, "fig09_acceleration_x"),
            _excerpt(case, 1, "fig10_acceleration_y"),
            Picture(
                "filter_response",
                lambda width: _draw_response(case, width),
                f"Gain, phase and group delay at {rate_hz:.0f} samples/s. The Chebyshev filter is "
                "scaled to unit gain at 0 Hz, so that gravity keeps its size; its ripple is the "
                "hump below the cutoff.",
            ),
        ],
        [
            ReportTable(
                "filters_flight",
                compare(paper, rate_hz),
                f"At this flight's {rate_hz:.0f} samples/s; times were taken on this machine for "
                "three axes.",
            ),
            _paper_table(case),
        ],
    )


def _paper_table(case: Case) -> ReportTable:
    return ReportTable(
        "filters_paper",
        compare(case.fusion.estimation.paper, PAPER_RATE_HZ),
        f"At the paper's {PAPER_RATE_HZ:.0f} samples/s.",
    )


def _excerpt(case: Case, axis: int, name: str) -> Picture:
    return Picture(
        name,
        lambda width: _draw_excerpt(case, axis, width),
        f"Specific force along body {AXIS_NAMES[axis]}, the {EXCERPT_S:.0f} s in which it changes "
        "most: raw, and after either filter. The lines nearly cover one another, so the lower "
        "panel shows Chebyshev minus Butterworth.",
    )


def liveliest(flight: Flight, axis: int) -> slice:
    """Find the stretch of `EXCERPT_S` in which a smoothed axis of the acceleration moves most."""
    count = min(max(round(EXCERPT_S * flight.rate_hz), 2), len(flight.time_us))
    x = np.nan_to_num(flight.accel_b_mps2[:, axis])
    first = np.concatenate([[0.0], np.cumsum(x)])
    second = np.concatenate([[0.0], np.cumsum(x * x)])
    mean = (first[count:] - first[:-count]) / count
    spread = (second[count:] - second[:-count]) / count - mean * mean
    begin = int(np.argmax(spread))
    return slice(begin, begin + count)


def _draw_excerpt(case: Case, axis: int, width_in: float) -> Figure:
    flight = case.flight
    part = liveliest(flight, axis)
    figure, axes = style.panels(width_in, 2, 2.0)
    time = flight.time_s[part]
    raw = flight.accel_b_mps2[part, axis]
    axes[0].plot(time, raw, color=style.MUTED, lw=0.7, alpha=0.6, label="raw")
    filtered = {
        kind: apply(kind, case.fusion.estimation.paper, flight.rate_hz, flight.accel_b_mps2)[
            part, axis
        ]
        for kind in KINDS
    }
    for kind, line in filtered.items():
        dashes = (0, (4, 2)) if kind == "chebyshev" else "-"
        axes[0].plot(time, line, color=COLOURS[kind], ls=dashes, label=kind.capitalize())
    axes[0].set_ylabel(f"specific force {AXIS_NAMES[axis]} (m/s²)")
    style.legend_above(axes[0])
    difference = filtered["chebyshev"] - filtered["butterworth"]
    axes[1].plot(time, difference, color=style.GREEN)
    axes[1].axhline(0.0, color=style.MUTED, lw=0.7)
    axes[1].set(xlabel="time (s)", ylabel="difference (m/s²)")
    return figure


def _draw_response(case: Case, width_in: float) -> Figure:
    rate_hz = case.flight.rate_hz
    figure, axes = style.panels(width_in, 1, 2.6, columns=3, share_x=True)
    for kind in KINDS:
        found = response(kind, case.fusion.estimation.paper, rate_hz)
        lines = (found.gain_db, found.phase_deg, found.delay_ms)
        for panel, line in zip(axes, lines, strict=True):
            panel.semilogx(found.frequency_hz, line, color=COLOURS[kind], label=kind.capitalize())
    for panel, label in zip(axes, ("gain (dB)", "phase (deg)", "group delay (ms)"), strict=True):
        panel.axvline(
            case.fusion.estimation.paper.accel_cutoff_hz, color=style.MUTED, lw=0.8, ls=":"
        )
        panel.set(xlabel="frequency (Hz)", ylabel=label)
    axes[0].set_ylim(bottom=-60.0)
    style.legend_above(axes[0], 2)
    return figure
