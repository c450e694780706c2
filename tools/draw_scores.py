"""Draw docs/pictures/accuracy.png: how far off the estimators are on every flight.

    python tools/draw_scores.py SCORES.json

The scores are what `score_estimators.py --json` has written.
"""

import argparse
import json
import math
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from gateway.analysis.reporting.estimators import COLOURS
from gateway.analysis.reporting.style import GREEN, MUTED

TARGET = Path(__file__).resolve().parent.parent / "docs" / "pictures" / "accuracy.png"
MARKS = {
    "smoothed": (GREEN, "o"),
    "eskf": (COLOURS["eskf"], "o"),
    "paper": (COLOURS["paper"], "s"),
    "vqf": (MUTED, "D"),
    "textbook": (MUTED, "^"),
}
"""The colours that reports give to our own, grey for other people's."""
PANELS = {
    "total": "attitude, degrees",
    "out10": "position in 10 s without GPS, m",
    "out30": "position in 30 s without GPS, m",
}

Board = dict[str, dict[str, dict[str, float]]]


def draw(panel: plt.Axes, board: Board, score: str) -> None:
    """Draw one score: a line for each flight that has it, a mark for each estimator."""
    flights = [name for name, rows in board.items() if any(score in row for row in rows.values())]
    for name, (colour, marker) in MARKS.items():
        found = [board[flight].get(name, {}).get(score) or math.nan for flight in flights]
        panel.plot(found, range(len(flights)), marker, color=colour, label=name, ms=7)
    panel.set_yticks(range(len(flights)), [_short(flight) for flight in flights])
    panel.set_ylim(len(flights) - 0.5, -0.5)
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.grid(axis="x", which="both", alpha=0.2)
    panel.hlines(range(len(flights)), *panel.get_xlim(), color="#dddddd", lw=1, zorder=0)
    panel.set_title(PANELS[score], loc="left", fontsize=11)


def _short(flight: str) -> str:
    """Keep the first words of a flight's name: they distinguish them."""
    return " ".join(flight.replace("_", " ").split()[:3]).removesuffix(" undisturbed")


def main() -> None:
    """Read, draw, save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scores", type=Path, help="what score_estimators.py --json wrote")
    board: Board = json.loads(parser.parse_args().scores.read_text())["flights"]
    figure, panels = plt.subplot_mosaic(
        [["total", "out10"], ["total", "out30"]], figsize=(11, 5), layout="constrained"
    )
    for score, panel in panels.items():
        draw(panel, board, score)
    handles, labels = panels["total"].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(MARKS), frameon=False)
    figure.savefig(TARGET, dpi=110)
    print(f"wrote {TARGET}")


if __name__ == "__main__":
    main()
