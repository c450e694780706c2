"""Style of the report's figures, for a light page, a dark page and files.

A figure is drawn once, in the light theme and without background. In the page its colours are
replaced by CSS variables, so the page's theme colours it.
"""

import io
import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from gateway.analysis.flight import FloatArray

BLUE: Final = "#0072b2"
ORANGE: Final = "#e69f00"
GREEN: Final = "#009e73"
RED: Final = "#d55e00"
PINK: Final = "#cc79a7"
SKY: Final = "#56b4e9"
INK: Final = "#1b1f24"
MUTED: Final = "#6a737d"
GRID: Final = "#dfe3e8"

CSS_NAMES: Final = {
    BLUE: "blue", ORANGE: "orange", GREEN: "green", RED: "red", PINK: "pink", SKY: "sky",
    INK: "ink", MUTED: "muted", GRID: "grid",
}  # fmt: skip
"""The colour-blind safe palette of Okabe and Ito, and the greys of the page."""

REFERENCE: Final = INK
"""Colour of the truth or reference in all figures, the same as that of text."""

WIDE_IN: Final = 7.6
NARROW_IN: Final = 3.9
"""Widths of a figure for a desktop page and for a phone, where text must not be scaled down."""

MAX_POINTS: Final = 1500
"""Maximum number of points of a line; a denser one is drawn as its envelope."""

PNG_DPI: Final = 130

RC: Final = {
    "figure.constrained_layout.use": True,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "lines.linewidth": 1.2,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "mavgate",
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


def panels(
    width_in: float, rows: int, row_height_in: float, *, columns: int = 1, share_x: bool = True
) -> tuple[Figure, list[Axes]]:
    """Create a figure of panels, one below the other, or side by side if there is room."""
    if width_in < WIDE_IN:
        rows, columns = rows * columns, 1
    figure = Figure(figsize=(width_in, rows * row_height_in))
    axes = figure.subplots(rows, columns, sharex=share_x, squeeze=False)
    return figure, list(axes.ravel())


def over_time(
    width_in: float, row_height_in: float, labels: Sequence[str]
) -> tuple[Figure, list[Axes]]:
    """Create labelled panels, one below the other, over time in seconds."""
    figure, axes = panels(width_in, len(labels), row_height_in)
    for panel, label in zip(axes, labels, strict=True):
        panel.set_ylabel(label)
    axes[-1].set_xlabel("time (s)")
    return figure, axes


def ground_map(width_in: float, height_in: float, zero: str) -> tuple[Figure, Axes]:
    """Create a map with its origin at a named point."""
    figure = Figure(figsize=(width_in, height_in))
    axes = figure.subplots()
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"east of {zero} (m)", ylabel=f"north of {zero} (m)")
    return figure, axes


def mark_ends(axes: Axes, pos_m: FloatArray) -> None:
    """Mark the start and the end of a track of north and east on a map."""
    axes.plot(pos_m[0, 1], pos_m[0, 0], "^", color=GREEN, ms=7, label="start")
    axes.plot(pos_m[-1, 1], pos_m[-1, 0], "s", color=RED, ms=6, label="end", mfc="none")


def envelope(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Reduce a long line to the minimum and maximum of each interval."""
    stretch = -(-len(x) // (MAX_POINTS // 2))
    if stretch <= 2:
        return x, y
    whole = len(x) // stretch * stretch
    parts = np.where(np.isfinite(y[:whole]), y[:whole], np.nan).reshape(-1, stretch)
    dull = ~np.isfinite(parts).any(axis=1)
    low = np.where(dull, 0, np.argmin(np.where(np.isfinite(parts), parts, np.inf), axis=1))
    high = np.where(dull, 0, np.argmax(np.where(np.isfinite(parts), parts, -np.inf), axis=1))
    index = np.sort(np.column_stack([low, high]), axis=1)
    index = (index + np.arange(len(parts))[:, np.newaxis] * stretch).ravel()
    index = np.append(index, len(x) - 1)
    return x[index], y[index]


def draw(
    axes: Axes, x: FloatArray, y: FloatArray, colour: str, label: str, **style: object
) -> None:
    """Draw a line with a limited number of points."""
    axes.plot(*envelope(x, y), color=colour, label=label, **style)


def legend_above(axes: Axes, columns: int = 4) -> None:
    """Put the legend between title and panel, where it covers nothing."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=columns, borderaxespad=0.1,
        handlelength=1.4, columnspacing=1.2,
    )  # fmt: skip
    title = axes.get_title(loc="left")
    axes.set_title(title, loc="left", pad=20.0)


def legend_outside(figure: Figure, axes: Axes, columns: int) -> None:
    """Put the legend above everything around a panel."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", ncols=columns, handlelength=1.4,
        columnspacing=1.2,
    )  # fmt: skip


def fit_square(axes: Axes, x: FloatArray, y: FloatArray) -> None:
    """Show all points at the same scale in both directions, with a margin of 6 %."""
    spread = max(float(np.ptp(x)), float(np.ptp(y)), 1e-9)
    half = 0.56 * spread
    middle_x, middle_y = 0.5 * float(np.min(x) + np.max(x)), 0.5 * float(np.min(y) + np.max(y))
    axes.set_xlim(middle_x - half, middle_x + half)
    axes.set_ylim(middle_y - half, middle_y + half)
    axes.set_aspect("equal", adjustable="box")


def to_svg(figure: Figure) -> str:
    """Write a figure as an SVG with the colours of the light theme and without background."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    # The layout is computed now, and need not be repeated for the next file.
    figure.set_layout_engine("none")
    return _tidy(buffer.getvalue())


def to_png(figure: Figure) -> bytes:
    """Write a figure as a PNG on a white background."""
    buffer = io.BytesIO()
    figure.dpi = PNG_DPI
    figure.set_facecolor("white")
    # Not `savefig`, which draws twice.
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def stand_alone(svg: str) -> str:
    """Give an SVG of `to_svg` a white background, for any viewer."""
    return svg.replace("<svg ", '<svg style="background: #ffffff" ', 1)


def for_page(svg: str) -> str:
    """Replace the colours of an SVG of `to_svg` by those of the page's theme."""
    svg = svg[svg.index("<svg ") :]
    for colour, name in CSS_NAMES.items():
        svg = svg.replace(colour, f"var(--{name})")
    svg = re.sub(r"(font: [^;\"]*?px) [^;\"]*", r"\1 var(--font)", svg)
    return re.sub(r' (?:width|height)="[0-9.]+pt"', "", svg, count=2)


def _tidy(svg: str) -> str:
    """Remove parts that only matplotlib needs; names of groups are not unique between figures."""
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<g id="[a-zA-Z]+[0-9_]*">', "<g>", svg)
    # A hundredth of a point is below the resolution of screens; texts keep their digits.
    svg = re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d\.\d\d)\d+", r"\1", tag[0]), svg)
    return re.sub(r"\n\s*", "\n", svg)
