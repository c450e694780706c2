"""Sections on the sensors: acceleration filters, magnetometer, heights, noise, timing, loss."""

from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gateway.analysis import signals
from gateway.analysis.blending import MAX_GAP_S
from gateway.analysis.case import Case
from gateway.analysis.flight import Flight, FloatArray, IntArray
from gateway.analysis.metrics import rms, worst
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Figures, Picture, ReportTable, Section, table_of_series
from gateway.recordings.flight_facts import NODE_WRAP_US, lost_share, missing_samples

EXCERPT_S: Final = 6.0
COLOURS: Final = {"butterworth": style.BLUE, "chebyshev": style.RED}
AXIS_NAMES: Final = "xyz"
AXIS_COLOURS: Final = (style.BLUE, style.RED, style.GREEN)
MIN_REST_S: Final = 5.0
MAX_DOTS: Final = 800


def acceleration(case: Case) -> Section:
    """Build the section; only the filters' design if the flight's rate is too low for them."""
    paper, rate_hz = case.fusion.estimation.paper, case.flight.rate_hz
    cutoff = paper.accel_cutoff_hz
    if cutoff >= 0.5 * rate_hz:
        return Section(
            "Acceleration filters",
            f"At this flight's {rate_hz:.0f} samples/s a low-pass at {cutoff:g} Hz has no effect: "
            "half the sample rate is the highest possible frequency. So there is nothing to "
            "plot for this flight; the table is for the filters at the paper's rate.",
            _paper_table(case),
        )
    return Section(
        "Acceleration filters",
        f"Second-order low-passes at {cutoff:g} Hz, as in figures 9 and 10 of the paper. "
        "Chebyshev passes all frequencies up to the cutoff and falls off faster, but rings after a "
        "step and delays unevenly. "
        "The paper states that it also takes longer; with the same order both are the same five "
        f"multiplications per sample, and the table gives their time here.",
        _excerpt(case, 0, "fig09_acceleration_x"),
        _excerpt(case, 1, "fig10_acceleration_y"),
        Picture(
            "filter_response",
            lambda width: _draw_response(case, width),
            f"Gain, phase and group delay at {rate_hz:.0f} samples/s. The Chebyshev filter is "
            "scaled to unit gain at 0 Hz, so that gravity keeps its size; its ripple is the "
            "hump below the cutoff.",
        ),
        ReportTable(
            "filters_flight",
            signals.compare(paper, rate_hz),
            f"At this flight's {rate_hz:.0f} samples/s; times were taken on this machine for "
            "three axes.",
        ),
        _paper_table(case),
    )


def _paper_table(case: Case) -> ReportTable:
    return ReportTable(
        "filters_paper",
        signals.compare(case.fusion.estimation.paper, signals.PAPER_RATE_HZ),
        f"At the paper's {signals.PAPER_RATE_HZ:.0f} samples/s.",
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
    """Return the part of `EXCERPT_S` in which a smoothed axis of the acceleration varies most."""
    count = min(max(round(EXCERPT_S * flight.rate_hz), 2), len(flight.time_us))
    begin = int(np.argmax(signals.spread(flight.imu.accel_b_mps2[:, [axis]], count)))
    return slice(begin, begin + count)


def _draw_excerpt(case: Case, axis: int, width_in: float) -> Figure:
    flight = case.flight
    part = liveliest(flight, axis)
    paper = case.fusion.estimation.paper
    labels = [f"specific force {AXIS_NAMES[axis]} (m/s²)", "difference (m/s²)"]
    figure, axes = style.over_time(width_in, 2.0, labels)
    time = flight.time_s[part]
    raw = flight.imu.accel_b_mps2[part, axis]
    axes[0].plot(time, raw, color=style.MUTED, lw=0.7, alpha=0.6, label="raw")
    filtered = {
        kind: signals.apply(kind, paper, flight.rate_hz, flight.imu.accel_b_mps2)[part, axis]
        for kind in signals.KINDS
    }
    for kind, line in filtered.items():
        dashes = (0, (4, 2)) if kind == "chebyshev" else "-"
        axes[0].plot(time, line, color=COLOURS[kind], ls=dashes, label=kind.capitalize())
    style.legend_above(axes[0])
    difference = filtered["chebyshev"] - filtered["butterworth"]
    axes[1].plot(time, difference, color=style.GREEN)
    axes[1].axhline(0.0, color=style.MUTED, lw=0.7)
    return figure


def _draw_response(case: Case, width_in: float) -> Figure:
    rate_hz, paper = case.flight.rate_hz, case.fusion.estimation.paper
    figure, axes = style.panels(width_in, 1, 2.6, columns=3, share_x=True)
    for kind in signals.KINDS:
        frequency_hz, *lines = signals.response(kind, paper, rate_hz)
        for panel, line in zip(axes, lines, strict=True):
            panel.semilogx(frequency_hz, line, color=COLOURS[kind], label=kind.capitalize())
    for panel, label in zip(axes, ("gain (dB)", "phase (deg)", "group delay (ms)"), strict=True):
        panel.axvline(paper.accel_cutoff_hz, color=style.MUTED, lw=0.8, ls=":")
        panel.set(xlabel="frequency (Hz)", ylabel=label)
    axes[0].set_ylim(bottom=-60.0)
    style.legend_above(axes[0], 2)
    return figure


def noise(case: Case) -> Section:
    """Build the section on spectra and Allan deviations."""
    flight = case.flight
    rest = signals.longest_rest(flight.imu.accel_b_mps2, flight.imu.gyro_b_radps, flight.rate_hz)
    rest_s = (rest.stop - rest.start) / flight.rate_hz
    pictures = [
        Picture(
            "spectrum",
            lambda width: _draw_spectrum(flight, width),
            "Power spectral density over the whole flight. Motion is on the left, the engine's "
            "shaking and the sensor's own noise on the right.",
        )
    ]
    if rest_s >= MIN_REST_S:
        pictures.append(
            Picture(
                "allan_deviation",
                lambda width: _draw_allan(flight, rest, width),
                f"Allan deviation in the longest rest, {rest_s:.0f} s. A slope of -1/2 is white "
                "noise; where the line rises again, the bias drifts. This rest shows averaging "
                f"times up to {rest_s / 4.0:.1f} s only.",
            )
        )
        tail = ""
    else:
        tail = " The flight has no rest long enough for an Allan deviation."
    return Section(
        "Noise",
        "Spectrum of the inertial sensors, and the effect of averaging at rest." + tail,
        *pictures,
    )


def timing(case: Case) -> Section | None:
    """Build the section on jitter and loss; None if the recording has no node times."""
    node = case.flight.node_time_us
    if node is None or len(node) < 3:
        return None
    table = loss_table(case.flight, node)
    return Section(
        "Timing and loss",
        "Regularity of the samples, by the gateway's clock and by the node's own, and "
        "samples that are missing.",
        Picture(
            "timing",
            lambda width: _draw_timing(case.flight, node, width),
            "Left: interval between neighbouring samples; a sample that is lost doubles it, "
            "jitter spreads it. Right: samples lost in each second.",
        ),
        ReportTable("timing", table, "Samples lost are gaps in the node's own time.", digits=3),
    )


def loss_table(flight: Flight, node_time_us: IntArray) -> pd.DataFrame:
    """Return a table of jitter and loss."""
    interval_us = np.diff(node_time_us) % NODE_WRAP_US
    nominal_us = float(np.median(interval_us))
    jitter_ms = (np.diff(flight.time_us) - interval_us) * 1e-3
    row = {
        "samples": len(node_time_us),
        "nominal interval, ms": nominal_us * 1e-3,
        "lost": int(missing_samples(node_time_us).sum()),
        "lost, %": 100.0 * (lost_share(node_time_us) or 0.0),
        "longest gap, ms": float(np.diff(flight.time_us).max()) * 1e-3,
        "jitter of gateway time, ms RMS": rms(jitter_ms),
    }
    return pd.DataFrame([row])


def magnetometer(case: Case) -> Section | None:
    """Build the section on the magnetometer; None without one."""
    before, after = case.flight.mag_uncalibrated_b_ut, case.flight.imu.mag_b_ut
    if before is None or not np.isfinite(after).any():
        return None
    before, after = before[np.isfinite(before[:, 0])], after[np.isfinite(after[:, 0])]
    strengths = {"before": np.linalg.norm(before, axis=1), "after": np.linalg.norm(after, axis=1)}
    figures: Figures = {
        "mean field, uT": np.mean,
        "spread, uT": np.std,
        "spread, %": lambda strength: 100.0 * np.std(strength) / np.mean(strength),
    }
    table = table_of_series("calibration", strengths, figures)
    return Section(
        "Magnetometer before and after calibration",
        "A magnetometer that turns in the Earth's field alone measures points on a sphere about "
        "zero. Hard iron of the aircraft shifts it, soft iron deforms it; the calibration corrects "
        "both.",
        Picture(
            "magnetometer_sphere",
            lambda width: _draw_sphere(before, after, width),
            "Each dot is one sample, seen from two sides; the circle is the mean field after "
            "calibration.",
        ),
        ReportTable("magnetometer", table, "On a sphere about zero the spread is the noise alone."),
    )


def heights(case: Case) -> Section | None:
    """Build the section on sources of height; None if there is only one."""
    flight = case.flight
    if case.frame is None or not len(flight.baro[0]):
        return None
    offset_m = baro_offset_m(case)
    return Section(
        "Height sources",
        "Height above mean sea level by GPS, by the barometer and fused. The barometer gives the "
        f"standard atmosphere's height; it is shifted by {offset_m:+.1f} m here, so that it agrees "
        "with GPS in the mean.",
        Picture(
            "heights",
            lambda width: _draw_heights(case, offset_m, width),
            "Above: heights. Below: the difference of each from "
            + (f"the {case.truth_name}." if flight.reference else "the fused height."),
        ),
        *(
            [ReportTable("heights", _height_table(case, offset_m), "Height errors.")]
            if flight.reference
            else []
        ),
    )


def baro_offset_m(case: Case) -> float:
    """Return the mean difference of GPS height and barometer height."""
    baro_m = np.interp(case.fixes.valid_us, *case.flight.baro)
    return float(np.nanmean(case.fixes.alt_amsl_m - baro_m))


def _height_table(case: Case, offset_m: float) -> pd.DataFrame:
    lines = _height_lines(case, offset_m).items()
    errors = {name: alt - _height_reference(case, time_us) for name, (time_us, alt, _) in lines}
    figures: Figures = {
        "mean error, m": np.nanmean,
        "spread, m": np.nanstd,
        "worst, m": worst,
    }
    return table_of_series("source", errors, figures)


def _height_lines(case: Case, offset_m: float) -> dict[str, tuple[IntArray, FloatArray, str]]:
    flight, fixes = case.flight, case.fixes
    baro_us, baro_m = flight.baro
    return {
        "GPS": (fixes.valid_us, fixes.alt_amsl_m, style.ORANGE),
        "barometer, shifted": (baro_us, baro_m + offset_m, style.GREEN),
        f"fused ({case.chosen})": (
            flight.time_us,
            np.where(flight.scored, case.track.alt_amsl_m, np.nan),
            style.BLUE,
        ),
    }


def _height_reference(case: Case, time_us: IntArray) -> FloatArray:
    track = case.flight.reference.track if case.flight.reference else case.track
    known = np.isfinite(track.alt_amsl_m)
    return np.asarray(
        np.interp(time_us, track.time_us[known], track.alt_amsl_m[known], left=np.nan, right=np.nan)
    )


def _draw_heights(case: Case, offset_m: float, width_in: float) -> Figure:
    flight = case.flight
    figure, (above, below) = style.over_time(width_in, 2.1, ["height AMSL (m)", "difference (m)"])
    if flight.reference is not None:
        truth = flight.reference.track.alt_amsl_m
        style.draw(above, flight.time_s, truth, style.REFERENCE, case.truth_name, lw=3, alpha=0.3)
    for name, (time_us, alt_m, colour) in _height_lines(case, offset_m).items():
        seconds = flight.seconds(time_us)
        # In a dropout there is no measurement: the line is interrupted.
        alt_m = np.where(np.diff(seconds, append=seconds[-1:]) > MAX_GAP_S, np.nan, alt_m)
        style.draw(above, seconds, alt_m, colour, name, lw=1.0)
        style.draw(below, seconds, alt_m - _height_reference(case, time_us), colour, name, lw=1.0)
    style.legend_above(above, 4 if width_in >= style.WIDE_IN else 2)
    return figure


def _draw_spectrum(flight: Flight, width_in: float) -> Figure:
    accel, gyro = flight.imu.accel_b_mps2, flight.imu.gyro_b_radps
    lines = {
        "specific force ((m/s²)²/Hz)": signals.power_density(accel, flight.rate_hz),
        "angular rate ((rad/s)²/Hz)": signals.power_density(gyro, flight.rate_hz),
    }
    return _draw_logarithmic(lines, "frequency (Hz)", 1.0, width_in)


def _draw_allan(flight: Flight, rest: slice, width_in: float) -> Figure:
    accel, gyro = flight.imu.accel_b_mps2[rest], np.degrees(flight.imu.gyro_b_radps)[rest]
    lines = {
        "Allan deviation,\nspecific force (m/s²)": signals.allan_deviation(accel, flight.rate_hz),
        "Allan deviation,\nangular rate (deg/s)": signals.allan_deviation(gyro, flight.rate_hz),
    }
    return _draw_logarithmic(lines, "averaging time (s)", 1.2, width_in)


def _draw_logarithmic(
    lines: dict[str, tuple[FloatArray, FloatArray]], xlabel: str, line_width: float, width_in: float
) -> Figure:
    figure, axes = style.panels(width_in, 1, 2.7, columns=2, share_x=False)
    for panel, (label, (x, values)) in zip(axes, lines.items(), strict=True):
        for part, name, colour in zip(values.T, "xyz", AXIS_COLOURS, strict=True):
            panel.loglog(x, part, color=colour, lw=line_width, label=name)
        panel.set(xlabel=xlabel, ylabel=label)
        style.legend_above(panel)
    return figure


def _draw_timing(flight: Flight, node_time_us: IntArray, width_in: float) -> Figure:
    figure, (left, right) = style.panels(width_in, 1, 2.5, columns=2, share_x=False)
    gateway_ms = np.diff(flight.time_us) * 1e-3
    node_ms = np.diff(node_time_us) % NODE_WRAP_US * 1e-3
    top_ms = 3.5 * float(np.median(node_ms))
    bins = np.linspace(0.0, top_ms, 141).tolist()
    for x, colour, name in ((gateway_ms, style.BLUE, "gateway"), (node_ms, style.ORANGE, "node")):
        left.hist(x.clip(0.0, top_ms), bins, histtype="step", color=colour, label=name, lw=1.3)
    left.set_yscale("log")
    left.set(xlabel="interval (ms)", ylabel="samples")
    left.legend(loc="upper right")
    seconds = np.arange(int(flight.duration_s) + 2).tolist()
    lost, _ = np.histogram(flight.time_s[1:], seconds, weights=missing_samples(node_time_us))
    right.stairs(lost, seconds, color=style.RED, fill=True)
    right.set(xlabel="time (s)", ylabel="lost in each second")
    return figure


def _draw_sphere(before: FloatArray, after: FloatArray, width_in: float) -> Figure:
    figure, axes = style.panels(width_in, 1, 3.5, columns=2, share_x=False)
    radius = float(np.linalg.norm(after, axis=1).mean())
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    step = max(1, len(before) // MAX_DOTS)
    for panel, (i, j) in zip(axes, ((0, 1), (0, 2)), strict=True):
        for name, found, colour in (("before", before, style.ORANGE), ("after", after, style.BLUE)):
            panel.plot(found[::step, i], found[::step, j], ".", color=colour, ms=2, label=name)
        panel.plot(radius * np.cos(angle), radius * np.sin(angle), color=style.INK, lw=0.8)
        panel.plot(0.0, 0.0, "+", color=style.INK, ms=8)
        panel.set_aspect("equal", adjustable="datalim")
        panel.set(xlabel=f"{'xyz'[i]} (uT)", ylabel=f"{'xyz'[j]} (uT)")
    style.legend_above(axes[0])
    return figure
