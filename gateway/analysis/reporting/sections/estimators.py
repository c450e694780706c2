"""The estimators side by side: errors over the flight, as a table and as lines."""

from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gateway.analysis.case import Case
from gateway.analysis.flight_arrays import BoolArray, FlightTrack, Reference, fixes_of
from gateway.analysis.interpolation import interpolate
from gateway.analysis.key_figures import HOLD_OUT, withheld_error_m
from gateway.analysis.metrics import errors_over_time, rms, worst
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, ReportTable, Section

COLOURS: Final = {"paper": style.ORANGE, "eskf": style.PINK}
STORY: Final = (
    "Every estimator fused the same samples, and is compared with {}. `paper` is the paper's "
    "fusion with its equations corrected: in a turn its accelerometer takes the bank for level "
    "flight and slowly tilts the horizon. `eskf` uses the GPS velocity to distinguish the "
    "manoeuvre from gravity."
)
SMOOTHED_STORY: Final = (
    " `smoothed` uses the whole flight for each state: `eskf` from both ends, which only a "
    "recording can be."
)
LATENCY_STORY: Final = (
    " The manoeuvres contradict the GPS latency set, {:.2f} s: `smoothed` uses the {:.2f} s "
    "they show, from the beginning."
)
OWN_GPS: Final = (
    "its own interpolated GPS, which is not independent: what follows the fixes' own errors agrees "
    "best"
)
OTHER: Final = style.GREEN
TILT: Final = "Tilt is the part of the attitude error about a horizontal axis. "


def estimators(case: Case) -> Section | None:
    """Build the section; None without a reference."""
    reference = _reference(case)
    if reference is None:
        return None
    turns = bool(np.isfinite(reference.track.q_nb).any())
    tracks = dict(case.tracks)
    if case.flight.recorded is not None:
        tracks["recorded in flight"] = case.flight.recorded
    table = error_table(tracks, reference, case.flight.scored)
    if len(fixes_of(case.flight)) > HOLD_OUT:
        withheld = {name: withheld_error_m(case, name) for name in case.tracks}
        table["withheld fixes, m"] = table["estimator"].map(withheld)
    return Section(
        "Estimators compared",
        STORY.format(reference.story) + _smoothed_story(case),
        [
            Picture(
                "estimator_errors",
                lambda width: _draw_errors(case, reference, width),
                "Error of each estimator over the flight. "
                + (TILT if turns else "")
                + "Without GPS the position drifts until it is back; its scale is logarithmic. "
                "The first seconds, in which every estimator converges, do not count.",
            )
        ],
        [
            ReportTable(
                "estimators",
                table,
                "RMS errors where they count; worst is the greatest. Withheld fixes: horizontal "
                f"error at every {HOLD_OUT}th fix when the estimator is not given it.",
            )
        ],
    )


def error_table(
    tracks: dict[str, FlightTrack], reference: Reference, scored: BoolArray
) -> pd.DataFrame:
    """Score tracks against a reference.

    Parameters
    ----------
    tracks : dict of str to FlightTrack
        By the name to show.
    reference : Reference
    scored : ndarray of bool, shape (N,)
        Which samples count.

    Returns
    -------
    DataFrame
        One row per track; a column without values is left out.
    """
    rows = []
    for name, track in tracks.items():
        errors = errors_over_time(track, reference.track)
        errors = {key: np.where(scored, value, np.nan) for key, value in errors.items()}
        rows.append(
            {
                "estimator": name,
                "roll, deg": rms(errors["roll_deg"]),
                "pitch, deg": rms(errors["pitch_deg"]),
                "yaw, deg": rms(errors["yaw_deg"]),
                "tilt, deg": rms(errors["tilt_deg"]),
                "worst tilt, deg": worst(errors["tilt_deg"]),
                "horizontal, m": rms(errors["horizontal_m"]),
                "worst horizontal, m": worst(errors["horizontal_m"]),
                "height, m": rms(errors["height_m"]),
                "speed, m/s": rms(errors["speed_mps"]),
            }
        )
    return pd.DataFrame(rows).dropna(axis="columns", how="all")


def _reference(case: Case) -> Reference | None:
    """Choose the flight's own reference, or its interpolated GPS."""
    if case.flight.reference is not None:
        return case.flight.reference
    if case.frame is None:
        return None
    track = interpolate(fixes_of(case.flight), case.flight.time_us)
    return Reference(track, is_exact=False, story=OWN_GPS)


def _smoothed_story(case: Case) -> str:
    """Describe the origin of the smoothed track, if there is one."""
    set_s, used_s = case.fusion.estimation.reference.gps_latency_s, case.smoothed_latency_s
    if used_s is None:
        return ""
    return SMOOTHED_STORY + (LATENCY_STORY.format(set_s, used_s) if used_s != set_s else "")


def _draw_errors(case: Case, reference: Reference, width_in: float) -> Figure:
    errors = {name: errors_over_time(t, reference.track) for name, t in case.tracks.items()}
    kinds = [
        (key, label)
        for key, label in (
            ("tilt_deg", "tilt (deg)"),
            ("heading_deg", "heading (deg)"),
            ("horizontal_m", "horizontal (m)"),
        )
        if any(np.isfinite(found[key]).any() for found in errors.values())
    ]
    figure, axes = style.panels(width_in, len(kinds), 1.75)
    for panel, (key, label) in zip(axes, kinds, strict=True):
        for name, found in errors.items():
            colour = COLOURS.get(name, OTHER)
            shown = np.where(case.flight.scored, found[key], np.nan)
            style.draw(panel, case.flight.time_s, shown, colour, name, lw=1.0)
        panel.set_ylabel(label)
        if key == "horizontal_m":
            panel.set_yscale("log")
    axes[-1].set_xlabel("time (s)")
    style.legend_above(axes[0], 3)
    return figure
