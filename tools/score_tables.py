"""The scores of the estimators as tables: what reaches its target is green, what does not red."""

import math
from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.table import Table

from tools.spoil_flight import RECOVERY_S, SPOILS

Scores = dict[str, float]

WIDTH = 200
"""Of the tables in characters, so that they look the same in a file."""
SPEEDS = {"paper": 5e5, "complementary": 1e6, "eskf": 2e5, "smoothed": 1e5}
"""Samples a second that each is to reach."""
SPOILT_LIMITS = (3.0, 3.0, 10.0)
"""Tilt and heading in deg and place in m, off the unspoilt run, at which a spoilt one is back."""
FULL_SHARE = 0.995
"""A share that rounds to all of the time."""
HONEST = (0.9, 0.99)
"""Share of instants within two sigma that an honest covariance has."""
TARGETS: dict[tuple[str, str], Scores] = {
    ("arduplane_testlog2", "complementary"): {
        "roll": 1.1, "pitch": 1.0, "yaw": 1.7, "pos_1hz": 1.07, "out10": 7.0,
    },
    ("arduplane_testlog2", "eskf"): {
        "roll": 0.85, "pitch": 0.7, "yaw": 1.1, "pos_1hz": 1.0, "out10": 5.0, "out30": 45.0,
    },
    ("arduplane_testlog2", "smoothed"): {"yaw": 1.0, "fix_out10": 1.5, "fix_out30": 10.0},
    ("car_rtk_drive0708_first_half", "complementary"): {"out10": 2.1},
    ("car_rtk_drive0708_first_half", "eskf"): {"out10": 2.1, "out30": 13.0},
    ("px4_mocap_log008", "complementary"): {"total": 2.2},
    ("px4_mocap_log008", "eskf"): {"total": 2.2},
}  # fmt: skip
"""What is to be reached; on the other flights, not to be worse than VQF."""
SCORES = {
    "roll": "roll", "pitch": "pitch", "yaw": "yaw", "total": "total", "heading": "head.",
    "inclination": "incl.", "pos": "place", "pos_max": "at most", "pos_1hz": "at 1 Hz",
    "out10": "10 s", "fix_out10": "to fixes", "out30": "30 s", "fix_out30": "to fixes",
}  # fmt: skip
"""Columns of the first table: what is scored, and its heading."""
RATES = ("samples_per_s", "singly_per_s")
"""Over a whole log at once, and sample by sample."""
KINDS = ("tilt", "heading", "place")
SPANS = {
    "2s": "", "out10": "10 s\n", "out30": "30 s\n", "spoilt": "spoilt\n", "alone": "no GPS\n",
}  # fmt: skip
"""With GPS, in outages of two lengths, after the disturbance where it holds least of all, and
without GPS throughout."""


def targets_for(flight: str, name: str, rows: dict[str, Scores]) -> Scores:
    """Return what a row is to reach."""
    found = dict(TARGETS.get((flight, name), {}))
    if flight.startswith("broad") and name in ("complementary", "eskf") and "vqf" in rows:
        found["total"] = rows["vqf"]["total"]
    return found | ({"samples_per_s": SPEEDS[name]} if name in SPEEDS else {})


def show_scores(board: dict[str, dict[str, Scores]]) -> None:
    """Print how far off each estimator is on each flight."""
    title = "RMSE in deg and m; over outages also to the fixes that were withheld"
    table = table_of(title, (*SCORES.values(), "samples/s", "singly/s"))
    for flight, rows in board.items():
        for name, scores in rows.items():
            wanted = targets_for(flight, name, rows)
            cells = [cell(scores, column, wanted) for column in (*SCORES, *RATES)]
            table.add_row(flight, name, *cells)
        table.add_section()
    Console(width=WIDTH).print(table)


def show_honesty(board: dict[str, dict[str, Scores]]) -> None:
    """Print how often the errors lie within two standard deviations told."""
    title = (
        "Instants within two sigma in %: with GPS, in outages, after the worst disturbance, "
        "without any GPS (and deg off)"
    )
    heads = [f"{words}{kind}" for words in SPANS.values() for kind in KINDS]
    # Without GPS there is no place.
    table = table_of(title, (*heads[:-1], "incl.", "head."))
    for flight, rows in board.items():
        for name, scores in rows.items():
            if "tilt_2s" not in scores:
                continue
            columns = [f"{kind}_{span}" for span in SPANS for kind in KINDS][:-1]
            off = [cell(scores, column, {}) for column in ("inclination_off", "heading_off")]
            table.add_row(flight, name, *(share_cell(scores, c) for c in columns), *off)
        table.add_section()
    Console(width=WIDTH).print(table)


def show_spoilt(board: dict[str, dict[str, dict[str, tuple[float, float, float, float]]]]) -> None:
    """Print what is left of each disturbance 20 s after its end."""
    title = (
        f"{RECOVERY_S:.0f} s after a disturbance, off the unspoilt run: tilt/heading deg, m; "
        "% of the time in which a heading is told"
    )
    table = table_of(title, SPOILS)
    for flight, rows in board.items():
        for name, found in rows.items():
            cells = [spoilt_cell(found[how]) if how in found else "" for how in SPOILS]
            table.add_row(flight, name, *cells)
        table.add_section()
    Console(width=WIDTH).print(table)


def show_consistency(found: dict[str, Scores], flights: int) -> None:
    """Print how honest the standard deviations of the Kalman filter are."""
    title = f"NEES of eskf per axis over {flights} simulated flights, expected 1"
    table = Table(box=box.SIMPLE_HEAD, title=title)
    for column in ("", "NEES", "95 % band", "instants in it"):
        table.add_column(column, justify="left" if not column else "right")
    for kind, scores in found.items():
        good = scores["low"] < scores["nees"] < scores["high"]
        band = f"{scores['low']:.2f} to {scores['high']:.2f}"
        nees = coloured(f"{scores['nees']:.2f}", good)
        table.add_row(kind, nees, band, f"{100.0 * scores['inside']:.0f} %")
    Console(width=WIDTH).print(table)


def table_of(title: str, columns: Iterable[str]) -> Table:
    """Begin a table with a row for each flight and estimator."""
    table = Table(box=box.SIMPLE_HEAD, title=title, padding=(0, 0), collapse_padding=True)
    table.add_column("flight", max_width=20, overflow="ellipsis", no_wrap=True)
    table.add_column("estimator", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def coloured(text: str, good: bool) -> str:
    """Mark a text that is good or not."""
    return f"[{'green' if good else 'red'}]{text}[/]"


def cell(scores: Scores, column: str, wanted: Scores) -> str:
    """Write one number, coloured by its target."""
    value = scores.get(column, math.nan)
    if not math.isfinite(value):
        return ""
    text = f"{value:,.0f}" if column in RATES else f"{value:.2f}"
    if column not in wanted:
        return text
    more = column == "samples_per_s"
    return coloured(text, value >= wanted[column] if more else value <= wanted[column])


def share_cell(scores: Scores, column: str) -> str:
    """Write a share of instants."""
    value = scores.get(column, math.nan)
    if not math.isfinite(value):
        return ""
    return coloured(f"{100.0 * value:.0f}", HONEST[0] <= round(value, 2) <= HONEST[1])


def spoilt_cell(off: tuple[float, float, float, float]) -> str:
    """Write one disturbance's remains, coloured by the limits."""
    good = all(a < b for a, b in zip(off[:3], SPOILT_LIMITS, strict=True))
    told = "" if off[3] > FULL_SHARE else f" {100.0 * off[3]:.0f}%"
    return coloured(f"{off[0]:.1f}/{off[1]:.1f} {off[2]:.1f}{told}", good)
