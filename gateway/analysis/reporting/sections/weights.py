"""Alpha and beta: the paper's Table I on this flight, next to the paper's own figures."""

from typing import Final

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from gateway.analysis.blending import PAPER_TABLE, WEIGHTS, blend_table, grows
from gateway.analysis.case import Case
from gateway.analysis.reporting import style
from gateway.analysis.reporting.page import Picture, ReportTable, Section

INTERVAL_S: Final = 1.0
"""Fixes a second of the paper's receiver, by the gaps that its figure 13 shows."""
COLOUR_MAP: Final = "cividis_r"


def weights(case: Case) -> Section | None:
    """Build the section; None without GPS."""
    if case.frame is None:
        return None
    thinned = blend_table(case.flight, case.fusion, INTERVAL_S)
    full = blend_table(case.flight, case.fusion, 0.0)
    if not (_is_judged(thinned) and _is_judged(full)):
        return None
    return Section(
        "Alpha and beta: Table I",
        _lead(thinned),
        [
            Picture(
                "table1_heat_map",
                lambda width: _draw_heat_map(thinned, width),
                "Mean error against interpolated GPS, metres, on this flight and in the paper. "
                "Light is good. All four maps have one scale, which is logarithmic.",
            )
        ],
        [
            ReportTable(
                "table1",
                _beside_paper(thinned),
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
        ],
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


def _is_judged(table: pd.DataFrame) -> bool:
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


def _beside_paper(table: pd.DataFrame) -> pd.DataFrame:
    shown = _renamed(table)
    paper = PAPER_TABLE.rename(columns={"north_m": "paper latitude", "east_m": "paper longitude"})
    merged: pd.DataFrame = shown.merge(paper, on=["alpha", "beta"], how="left")
    return merged


def _draw_heat_map(table: pd.DataFrame, width_in: float) -> Figure:
    figure = Figure(figsize=(width_in, 2.5 if width_in >= style.WIDE_IN else 4.2))
    wide = width_in >= style.WIDE_IN
    axes = figure.subplots(1, 4) if wide else figure.subplots(2, 2)
    grids = [
        ("this flight, latitude", table, "north_m"),
        ("this flight, longitude", table, "east_m"),
        ("paper, latitude", PAPER_TABLE, "north_m"),
        ("paper, longitude", PAPER_TABLE, "east_m"),
    ]
    values = {
        title: source.pivot_table(index="alpha", columns="beta", values=column).to_numpy()
        for title, source, column in grids
    }
    every = np.concatenate([grid.ravel() for grid in values.values()])
    scale = LogNorm(float(np.nanmin(every)), float(np.nanmax(every)))
    for panel, (title, grid) in zip(axes.ravel(), values.items(), strict=True):
        panel.imshow(grid, cmap=COLOUR_MAP, norm=scale, origin="lower", aspect="auto")
        for (row, col), value in np.ndenumerate(grid):
            dark = scale(value) > 0.5
            panel.text(
                col, row, f"{value:.1f}", ha="center", va="center",
                color="#ffffff" if dark else "#000000",
            )  # fmt: skip
        panel.set_title(title)
        panel.set(xticks=range(len(WEIGHTS)), yticks=range(len(WEIGHTS)))
        panel.set_xticklabels([f"{weight:g}" for weight in WEIGHTS])
        panel.set_yticklabels([f"{weight:g}" for weight in WEIGHTS])
        panel.grid(visible=False)
        panel.set_xlabel("beta")
    for panel in axes.ravel()[:: 4 if wide else 2]:
        panel.set_ylabel("alpha")
    return figure
