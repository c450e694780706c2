"""Write the report as one self-contained HTML page, and its figures and tables as files."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import jinja2
import matplotlib as mpl
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from gateway.analysis.flight import FloatArray
from gateway.analysis.processes import START, forked
from gateway.analysis.reporting import style
from gateway.output import write_new, written_together
from gateway.printable import figure

PAGE_NAME: Final = "index.html"
Drawn = tuple[Markup, Markup]
"""A picture as embedded in the page, wide and narrow."""
Figures = Mapping[str, Callable[[FloatArray], Any]]
"""Figures of a series of values, by title."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure and its caption."""

    name: str
    draw: Callable[[float], Figure]
    """Function that draws the figure for a width in inches."""
    caption: str


@dataclass(frozen=True, slots=True)
class ReportTable:
    """A table; numbers are shown with `digits` decimals and written with all."""

    name: str
    frame: pd.DataFrame
    caption: str
    digits: int = 2
    strong: tuple[int, ...] = ()
    """Indices of rows to emphasise."""

    def rows(self) -> list[list[str]]:
        """Return the cells as text."""
        return [[self._text(value) for value in row] for row in self.frame.itertuples(index=False)]

    def is_text(self, column: int) -> bool:
        """Return whether a column contains text, which is aligned left."""
        return any(isinstance(value, str) for value in self.frame.iloc[:, column])

    def _text(self, value: object) -> str:
        if isinstance(value, float):
            return figure(value, f"z.{self.digits}f")
        return str(value)


def table_of_series(
    head: str,
    series: Mapping[str, FloatArray],
    figures: Figures,
) -> pd.DataFrame:
    """Return a table with a row of figures for each of some series of values."""
    return pd.DataFrame(
        [
            {head: name, **{title: figure_of(values) for title, figure_of in figures.items()}}
            for name, values in series.items()
        ]
    )


class Section:
    """One topic of the report: a few sentences, then pictures and tables.

    Parts of the sentences in backticks are set as code.
    """

    def __init__(self, title: str, lead: str, *parts: Picture | ReportTable) -> None:
        self.title, self.lead = title, lead
        self.pictures = [part for part in parts if isinstance(part, Picture)]
        self.tables = [part for part in parts if isinstance(part, ReportTable)]

    @property
    def anchor(self) -> str:
        """Anchor of the section in the page's address."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


@dataclass(frozen=True, slots=True)
class Fact:
    """A key figure in the header of the page."""

    value: str
    meaning: str


@dataclass(frozen=True, slots=True)
class Report:
    """The whole page."""

    title: str
    description: str
    facts: list[Fact]
    sections: list[Section]


def write_report(
    report: Report,
    folder: Path,
    on_picture: Callable[[], None] = lambda: None,
    jobs: int | None = None,
) -> Path:
    """Write the page, its figures as SVG and PNG, and its tables as CSV."""
    with written_together(folder) as fresh:
        for section in report.sections:
            for table in section.tables:
                write_new(fresh / f"{table.name}.csv", [table.frame.to_csv(index=False).encode()])
        pictures = [picture for section in report.sections for picture in section.pictures]
        drawn = {}

        def draw(number: int) -> Drawn:
            # A Picture cannot be pickled for another process, only inherited.
            return _drawn(pictures[number], fresh)

        with forked(draw, jobs if START == "fork" else 1) as run:
            for number, both in run(range(len(pictures))):
                drawn[pictures[number].name] = both
                on_picture()
        write_new(fresh / PAGE_NAME, [render_page(report, drawn).encode()])
    return folder / PAGE_NAME


def render_page(report: Report, drawn: dict[str, Drawn]) -> str:
    """Fill the page's template."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("gateway.analysis.reporting", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["prose"] = prose
    return environment.get_template("page.html.j2").render(report=report, drawn=drawn)


def prose(text: str) -> Markup:
    """Escape a text, and set parts in backticks as code."""
    escaped = str(jinja2.filters.do_forceescape(text))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped))


def _drawn(picture: Picture, folder: Path) -> Drawn:
    with mpl.rc_context(style.RC):
        wide = picture.draw(style.WIDE_IN)
        wide_svg = style.to_svg(wide)
        write_new(folder / f"{picture.name}.png", [style.to_png(wide)])
        narrow_svg = style.to_svg(picture.draw(style.NARROW_IN))
    write_new(folder / f"{picture.name}.svg", [style.stand_alone(wide_svg).encode()])
    wide_part, narrow_part = Markup(style.for_page(wide_svg)), Markup(style.for_page(narrow_svg))
    return wide_part, narrow_part
