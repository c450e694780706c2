"""Errors over many flights: medians, the best point of a grid, another version; and their page."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from gateway.analysis.case import OUTAGE_S
from gateway.analysis.flight import FloatArray
from gateway.batch.tasks import DRIFT, HELD, FlightResult
from gateway.units import counted

WORSE: Final = 1.05
WORSE_M: Final = 0.05
"""Minimum increase of the error in m, in addition to 5 %, of a flight that counts as worse."""
ALL: Final = "all"
REASONS: Final = {
    "eskf": "it distinguishes manoeuvres from gravity by the GPS velocity, which keeps it level",
    "paper": "it follows the newest fix closely",
}
"""Reason for the lead of an estimator, by its name."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The point of a grid that is best over all flights."""

    winner: int
    """Index of the point with the least mean error."""
    means: FloatArray
    """Shape (P,): geometric mean of the error of each point over all flights."""
    base_mean: float
    """The same mean for the recorded settings; NaN if no flight has all these errors."""


def choose(errors: FloatArray, base: FloatArray) -> Choice:
    """Choose a point from its errors on all flights, shape (F, P); raises ValueError if none has.

    Each flight has the same weight, since a point must suit all of them: the mean is geometric.
    """
    known = np.asarray((np.isfinite(errors) & (errors > 0.0)).all(axis=1))
    if not known.any():
        raise ValueError("no flight has enough fixes to score all of these settings")
    means = np.exp(np.log(errors[known]).mean(axis=0))
    return Choice(int(np.argmin(means)), means, float(np.exp(np.log(base[known]).mean())))


@dataclass(frozen=True, slots=True)
class Versus:
    """Comparison of results with those of another version on the same flights."""

    medians: pd.DataFrame
    """`estimator`, `flights`, `before_m` and `after_m`: median errors at withheld fixes."""
    worse: pd.DataFrame
    """`location`, `estimator`, `before_m` and `after_m` of flights that got worse, worst first."""
    compared: int


def errors_by_group(results: Sequence[FlightResult]) -> pd.DataFrame:
    """Summarise errors at withheld fixes, of all aircraft together and of each aircraft."""
    errors = pd.DataFrame(
        [(r.vehicle, name, m) for r in results for name, m in r.figures.get(HELD, {}).items()],
        columns=["vehicle", "estimator", "m"],
    )
    vehicles = errors["vehicle"].dropna().unique()
    parts = [
        (f"{vehicle:.0f}", errors[errors["vehicle"] == vehicle]) for vehicle in sorted(vehicles)
    ]
    if len(parts) != 1 or errors["vehicle"].isna().any():
        parts.insert(0, (ALL, errors))
    return pd.DataFrame(
        [
            (aircraft, name, len(m), m.median(), m.quantile(0.9), m.max())
            for aircraft, part in parts
            for name, m in part.groupby("estimator")["m"]
        ],
        columns=["aircraft", "estimator", "flights", "median, m", "9 in 10 below, m", "worst, m"],
    )


def why_leads(results: Sequence[FlightResult]) -> str:
    """Describe which estimator leads, by how much, and why; empty if there is only one.

    The lead is at the withheld fixes, which are a second from others. Without GPS, attitude and
    velocity determine the error, so errors there show the origin of the lead.
    """
    ranked = sorted((median, name) for name, median in _medians_m(results, HELD).items())
    if len(ranked) < 2:
        return ""
    (_, best), (_, second) = ranked[:2]
    both = [r for r in results if {best, second} <= r.figures.get(HELD, {}).keys()]
    if not both:
        return ""
    held_m, drift_m = _medians_m(both, HELD), _medians_m(both, DRIFT)
    text = (
        f"{best} leads {second}: median errors of {held_m[best]:.2f} and {held_m[second]:.2f} m "
        f"over {counted(len(both), 'flight')}."
    )
    if not {best, second} <= drift_m.keys():
        return text
    best_m, second_m = drift_m[best], drift_m[second]
    measured = (
        f"after {OUTAGE_S:.0f} s without GPS it is {best_m:.1f} m off, {second} {second_m:.1f} m"
    )
    if best_m < second_m:
        return f"{text} It drifts less: {measured}; {REASONS.get(best, 'its attitude is better')}."
    return f"{text} The lead is in following the GPS, not in drifting less: {measured}."


def _medians_m(results: Sequence[FlightResult], key: str) -> dict[str, float]:
    errors = pd.DataFrame([result.figures.get(key, {}) for result in results])
    return {str(name): float(median) for name, median in errors.median().items()}


def versus(now: Iterable[FlightResult], then: Iterable[FlightResult]) -> Versus:
    """Compare the flights that both results contain, by the digests of their files."""
    before = {old.digest: old.figures[HELD] for old in then if HELD in old.figures}
    both = [new for new in now if HELD in new.figures and new.digest in before]
    changes = pd.DataFrame(
        [
            (new.location, name, before[new.digest][name], after_m)
            for new in both
            for name, after_m in new.figures[HELD].items()
            if name in before[new.digest]
        ],
        columns=["location", "estimator", "before_m", "after_m"],
    )
    medians = (
        changes.groupby("estimator")
        .agg(flights=("location", "size"), before_m=("before_m", "median"),
             after_m=("after_m", "median"))
        .reset_index()
    )  # fmt: skip
    before_m, after_m = changes["before_m"], changes["after_m"]
    worse = changes[(after_m > before_m * WORSE) & (after_m > before_m + WORSE_M)]
    gain = (worse["before_m"] / worse["after_m"]).to_numpy(np.float64)
    worse = worse.iloc[np.argsort(gain, kind="stable")]
    return Versus(medians, worse, len(both))


def flight_table(results: Sequence[FlightResult]) -> pd.DataFrame:
    """Return all results as a table, one row per recording."""
    return pd.DataFrame([_row(result) for result in results])


def write_flights_page(
    results: Sequence[FlightResult], folder: Path, compared: Versus | None
) -> Path:
    """Write the page of many flights, its figure and its tables into a folder."""
    # Imported here: these require the extra `plot`, which the command has checked.
    from gateway.analysis.reporting.page import Fact, Report, ReportTable, Section, write_report

    evaluated = [result for result in results if HELD in result.figures]
    broken = [result for result in results if result.error is not None]
    sections = [
        Section(
            "Errors by aircraft and estimator",
            "Each flight was fused without every fifth fix and scored at those: figures are the "
            f"root mean square errors of the flights, horizontal. {why_leads(evaluated)}".strip(),
            *([_picture(evaluated)] if any(result.figures[HELD] for result in evaluated) else []),
            ReportTable("errors", errors_by_group(evaluated), "Errors at withheld fixes."),
        )
    ]
    if compared is not None:
        sections.append(_versus_section(compared))
    if broken:
        rows = [(_file_name(result.location), result.error) for result in broken]
        failed = ReportTable("failed", pd.DataFrame(rows, columns=["recording", "why"]), "Failed.")
        lead = "These are not in any of the other tables."
        sections.append(Section("Recordings that failed", lead, failed))
    if len(broken) < len(results):
        flights = flight_table([result for result in results if result.error is None])
        # The page is narrow; the distance of a flight is in flights.csv only.
        flights = flights.drop(columns=["failed", "distance, m"])
        table = ReportTable("flight_errors", flights, "Flights.")
        sections.append(Section("Flights", "In the order given.", table))
    seconds = sum(r.figures.get("summary", {}).get("duration, s", 0.0) for r in results)
    facts = [
        Fact(str(len(results) - len(broken)), "flights"),
        Fact(f"{seconds / 3600.0:.1f} h", "recorded"),
        Fact(str(len({result.vehicle for result in evaluated})), "aircraft"),
        Fact(str(len(broken)), "recordings that failed"),
    ]
    description = "Many flights, fused again by every estimator."
    return write_report(Report("Flights", description, facts, sections), folder, jobs=1)


def _file_name(location: str) -> str:
    return location.rsplit("/", 1)[-1]


def _row(result: FlightResult) -> dict[str, Any]:
    summary = result.figures.get("summary", result.figures)
    held = result.figures.get(HELD, {})
    return {
        "recording": _file_name(result.location),
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

    lead = (
        f"Both fused {counted(compared.compared, 'flight')}. A flight is listed as worse where its "
        "error grew by more than 5 % and 5 cm."
    )
    medians = compared.medians.set_axis(["estimator", "flights", "then, m", "now, m"], axis=1)
    tables = [ReportTable("versus", medians, "Median errors at withheld fixes.")]
    if len(compared.worse):
        worse = compared.worse.assign(location=compared.worse["location"].map(_file_name))
        worse.columns = pd.Index(["recording", "estimator", "then, m", "now, m"])
        tables.append(ReportTable("worse", worse, f"{len(worse)} that got worse."))
    return Section("Against the other results", lead, *tables)


def _picture(results: Sequence[FlightResult]) -> Any:
    from matplotlib.ticker import FuncFormatter

    from gateway.analysis.reporting import style
    from gateway.analysis.reporting.estimators import COLOURS, OTHER
    from gateway.analysis.reporting.page import Picture

    errors = [result.figures[HELD] for result in results]
    names = sorted({name for held_m in errors for name in held_m})

    def draw(width_in: float) -> Any:
        figure, (axes,) = style.panels(width_in, 1, 2.6)
        for name in names:
            values = np.sort([held_m[name] for held_m in errors if name in held_m])
            share = np.arange(len(values) + 1) / len(values)
            colour = COLOURS.get(name, OTHER)
            axes.step([values[0], *values], share, where="post", label=name, color=colour)
        axes.set_xlabel("error at withheld fixes, m")
        axes.set_ylabel("share of the flights")
        axes.set_xscale("log")
        decimal = FuncFormatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_major_formatter(decimal)
        axes.xaxis.set_minor_formatter(decimal)
        axes.legend()
        return figure

    caption = "Share of the flights whose error is at most this, by estimator."
    return Picture("error_shares", draw, caption)
