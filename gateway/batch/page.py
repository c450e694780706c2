"""A season as tables and as one page: errors by aircraft and estimator, and what got worse."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from gateway.batch.statistics import FlightErrors, GroupErrors, Versus, errors_by_group
from gateway.batch.tasks import HELD, FlightResult
from gateway.units import counted

ALL: Final = "all"


def errors_of(results: Sequence[FlightResult]) -> list[FlightErrors]:
    """Take the errors out of the results that have some."""
    return [
        FlightErrors(
            result.place, result.digest, result.vehicle, result.began, result.figures[HELD]
        )
        for result in results
        if HELD in result.figures
    ]


def flight_table(results: Sequence[FlightResult]) -> pd.DataFrame:
    """Lay all results out, a row a recording."""
    return pd.DataFrame([_row(result) for result in results])


def group_table(groups: Sequence[GroupErrors]) -> pd.DataFrame:
    """Lay the errors by aircraft and estimator out."""
    return pd.DataFrame(
        [
            (
                ALL if group.vehicle is None else str(group.vehicle),
                group.estimator,
                group.flights,
                group.median_m,
                group.most_m,
                group.worst_m,
            )
            for group in groups
        ],
        columns=["aircraft", "estimator", "flights", "median, m", "9 in 10 below, m", "worst, m"],
    )


def write_season_page(
    results: Sequence[FlightResult], folder: Path, compared: Versus | None
) -> Path:
    """Write the season's page, its figure and its tables into a folder."""
    # They need the extra plot, for which the command has looked.
    from gateway.analysis.reporting.page import Fact, Report, ReportTable, Section, write_report

    errors = errors_of(results)
    broken = [result for result in results if result.error is not None]
    groups = group_table(errors_by_group(errors))
    sections = [
        Section(
            "Errors by aircraft and estimator",
            "Each flight was fused without every fifth fix, which then judged: the figures are the "
            "root mean square errors of the flights, horizontal.",
            [_picture(errors)] if errors else [],
            [ReportTable("errors", groups, "Errors at withheld fixes.")],
        )
    ]
    if compared is not None:
        sections.append(_versus_section(compared))
    if broken:
        sections.append(_failed_section(broken))
    if len(broken) < len(results):
        flights = flight_table([result for result in results if result.error is None])
        # The page is narrow; a flight's distance is in flights.csv.
        table = ReportTable(
            "flight_errors", flights.drop(columns=["failed", "distance, m"]), "Flights."
        )
        sections.append(Section("Flights", "In the order given.", tables=[table]))
    seconds = sum(r.figures.get("summary", {}).get("duration, s", 0.0) for r in results)
    vehicles = {flight.vehicle for flight in errors}
    facts = [
        Fact(str(len(results) - len(broken)), "flights"),
        Fact(f"{seconds / 3600.0:.1f} h", "recorded"),
        Fact(str(len(vehicles)), "aircraft"),
        Fact(str(len(broken)), "recordings that failed"),
    ]
    story = "All flights of a season, fused again by every estimator."
    return write_report(Report("Season", story, facts, sections), folder, jobs=1)


def _row(result: FlightResult) -> dict[str, Any]:
    summary = result.figures.get("summary", result.figures)
    held = result.figures.get(HELD, {})
    return {
        "recording": result.place.rsplit("/", 1)[-1],
        "aircraft": "" if result.vehicle is None else str(result.vehicle),
        "began": result.began or "",
        "duration, s": _number(summary.get("duration, s", summary.get("duration_s"))),
        "distance, m": _number(summary.get("distance flown, m")),
        **{f"{name}, m": _number(error_m) for name, error_m in held.items()},
        "failed": result.error or "",
    }


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _versus_section(compared: Versus) -> Any:
    from gateway.analysis.reporting.page import ReportTable, Section

    leads = pd.DataFrame(
        [(name, lead.text) for name, lead in compared.leads.items()],
        columns=["estimator", "now against then"],
    )
    worse = pd.DataFrame(
        [
            (change.place.rsplit("/", 1)[-1], change.estimator, change.before_m, change.after_m)
            for change in compared.worse
        ],
        columns=["recording", "estimator", "then, m", "now, m"],
    )
    lead = (
        f"Both fused {counted(compared.compared, 'flight')}. A flight is listed as worse where its "
        "error grew by more than 5 % and 5 cm."
    )
    tables = [ReportTable("versus", leads, "Errors of now over those of then.")]
    if compared.worse:
        tables.append(ReportTable("worse", worse, f"{len(worse)} that got worse."))
    return Section("Against the other results", lead, tables=tables)


def _failed_section(broken: Sequence[FlightResult]) -> Any:
    from gateway.analysis.reporting.page import ReportTable, Section

    rows = [(result.place.rsplit("/", 1)[-1], result.error) for result in broken]
    frame = pd.DataFrame(rows, columns=["recording", "why"])
    lead = "They are in none of the other tables."
    return Section("Recordings that failed", lead, tables=[ReportTable("failed", frame, "Failed.")])


def _picture(errors: Sequence[FlightErrors]) -> Any:
    from matplotlib.ticker import FuncFormatter

    from gateway.analysis.reporting import style
    from gateway.analysis.reporting.estimators import COLOURS, OTHER
    from gateway.analysis.reporting.page import Picture

    names = sorted({name for flight in errors for name in flight.held_m})

    def draw(width_in: float) -> Any:
        figure, (axes,) = style.panels(width_in, 1, 2.6)
        for name in names:
            values = np.sort([f.held_m[name] for f in errors if name in f.held_m])
            share = np.arange(len(values) + 1) / len(values)
            axes.step(
                [values[0], *values],
                share,
                where="post",
                label=name,
                color=COLOURS.get(name, OTHER),
            )
        axes.set_xlabel("error at withheld fixes, m")
        axes.set_ylabel("share of the flights")
        axes.set_xscale("log")
        decimal = FuncFormatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_major_formatter(decimal)
        axes.xaxis.set_minor_formatter(decimal)
        axes.legend()
        return figure

    caption = "Share of the flights whose error is at most this, by estimator."
    return Picture("season_errors", draw, caption)
