"""Statistics over many flights and their page: significance, cross-validation, errors."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import bootstrap, permutation_test

from gateway.analysis.case import OUTAGE_S
from gateway.batch.tasks import DRIFT, HELD, FlightResult
from gateway.units import counted

FloatArray = NDArray[np.float64]

RESAMPLES: Final = 9_999
SEED: Final = 1
CONFIDENCE: Final = 0.95
CHANCE: Final = 0.05
"""Significance level: a smaller p is more than chance."""
FOLDS: Final = 10
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
class Lead:
    """Ratio of the errors of one estimator or point of a grid to those of another."""

    flights: int
    units: int
    """Number of aircraft-days: flights of one day share weather and the state of the sensors."""
    ratio: float
    """Geometric mean of the ratio of the errors; below 1, the first one is better."""
    low: float | None
    high: float | None
    """Limits of the ratio's 95 % confidence interval; None for a single unit."""
    p: float | None
    """p-value: share of random signs that give as great a lead; None for a single unit."""

    @property
    def text(self) -> str:
        """Describe the lead in one sentence."""
        change = f"{_percent(self.ratio)} error over {counted(self.flights, 'flight')}"
        if self.p is None or self.low is None or self.high is None:
            return f"{change}, all of one aircraft and day: it cannot be separated from chance"
        if self.low == self.high == self.ratio == 1.0:
            return f"the same error on all {self.flights} flights"
        verdict = "more than chance" if self.p < CHANCE else "it may be chance"
        return (
            f"{change} on {self.units} aircraft-days, 95 % between {_percent(self.low)} and "
            f"{_percent(self.high)}; p = {self.p:.2g}: {verdict}"
        )


def _percent(ratio: float) -> str:
    return f"{100.0 * (ratio - 1.0):+.1f} %"


def lead_of(errors: FloatArray, others: FloatArray, groups: Sequence[str]) -> Lead | None:
    """Compare two errors on the same flights."""
    known = np.isfinite(errors) & np.isfinite(others) & (errors > 0.0) & (others > 0.0)
    if not known.any():
        return None
    # p is from a permutation test over the signs of the groups' averages, the interval from a
    # bootstrap over the groups.
    logs = np.log(errors[known] / others[known])
    labels = np.array(groups)[known]
    units = np.array([logs[labels == label].mean() for label in np.unique(labels)])
    ratio = float(np.exp(units.mean()))
    if len(units) < 2:
        return Lead(len(logs), len(units), ratio, None, None, None)
    low, high, p = ratio, ratio, 1.0
    if np.ptp(units) > 0.0:
        interval = bootstrap(
            (units,), np.mean, n_resamples=RESAMPLES, confidence_level=CONFIDENCE,
            method="percentile", rng=np.random.default_rng(SEED),
        ).confidence_interval  # fmt: skip
        low, high = float(np.exp(interval.low)), float(np.exp(interval.high))
    if np.any(units != 0.0):
        p = float(
            permutation_test(
                (units,), np.mean, permutation_type="samples", n_resamples=RESAMPLES,
                vectorized=True, rng=np.random.default_rng(SEED),
            ).pvalue
        )  # fmt: skip
    return Lead(len(logs), len(units), ratio, low, high, p)


@dataclass(frozen=True, slots=True)
class Choice:
    """Result of a season's sweep."""

    winner: int
    """Index of the point of the grid with the least mean error over all flights."""
    means: FloatArray
    """Shape (P,): geometric mean of the error of each point over all flights."""
    judged: FloatArray
    """Shape (F,): error of each flight with the point chosen by the other folds."""
    folds: int
    stable: int
    """Number of folds without which the same point is chosen."""
    over_base: Lead | None
    """Lead of the points chosen by the other folds over the recorded settings."""
    over_second: Lead | None
    """Lead of the winner over the second point; both were chosen by the same flights."""


def choose(errors: FloatArray, base: FloatArray, groups: Sequence[str]) -> Choice:
    """Choose a point for all flights, and cross-validate the choice."""
    known = np.asarray((np.isfinite(errors) & (errors > 0.0)).all(axis=1))
    if not known.any():
        raise ValueError("no flight has enough fixes to score all of these settings")
    logs = np.where(known[:, np.newaxis], np.log(np.where(known[:, np.newaxis], errors, 1.0)), 0.0)
    fold = folds_of(groups)
    count = int(fold.max()) + 1
    means = logs[known].mean(axis=0)
    ranking = np.argsort(means, kind="stable")
    winner = int(ranking[0])
    chosen = np.full(len(errors), winner)
    stable = 0
    for number in range(count):
        others = known & (fold != number)
        if not others.any():
            continue
        choice = int(np.argmin(logs[others].mean(axis=0)))
        chosen[fold == number] = choice
        stable += choice == winner
    judged = np.where(known, errors[np.arange(len(errors)), chosen], np.nan)
    second = errors[:, int(ranking[1])] if len(ranking) > 1 else None
    return Choice(
        winner=winner,
        means=np.exp(means),
        judged=judged,
        folds=count,
        stable=stable,
        over_base=lead_of(judged, base, groups),
        over_second=None if second is None else lead_of(errors[:, winner], second, groups),
    )


def folds_of(groups: Sequence[str]) -> NDArray[np.int64]:
    """Assign groups to folds of about equal numbers of flights; a single group by flights."""
    labels = list(groups) if len(set(groups)) > 1 else [str(k) for k in range(len(groups))]
    sizes = Counter(labels)
    load = [0] * min(FOLDS, len(sizes))
    fold: dict[str, int] = {}
    for label in sorted(sizes, key=lambda name: (-sizes[name], name)):
        fold[label] = load.index(min(load))
        load[fold[label]] += sizes[label]
    return np.array([fold[label] for label in labels], np.int64)


@dataclass(frozen=True, slots=True)
class Versus:
    """Comparison of a season with the same flights of another version."""

    leads: dict[str, Lead]
    """Lead of the new results over the former ones, by estimator."""
    worse: pd.DataFrame
    """`location`, `estimator`, `before_m` and `after_m` of flights that got worse, worst first."""
    compared: int
    """Number of flights in both results."""


def group_of(result: FlightResult) -> str:
    """Return the name of aircraft and day; flights of a group share weather and sensors' state.

    A flight without a day is a group of its own.
    """
    return f"{result.vehicle} {result.began[:10] if result.began else result.digest}"


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
    errors = [np.array([r.figures[HELD][name] for r in both]) for name in (best, second)]
    lead = lead_of(errors[0], errors[1], [group_of(result) for result in both])
    if lead is None:
        return ""
    text = f"{best} leads {second}: {lead.text}."
    drift_m = _medians_m(both, DRIFT)
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
    """Return the median error of each estimator."""
    names = {name for result in results for name in result.figures.get(key, {})}
    return {
        name: float(
            np.median([r.figures[key][name] for r in results if name in r.figures.get(key, {})])
        )
        for name in names
    }


def versus(now: Iterable[FlightResult], then: Iterable[FlightResult]) -> Versus:
    """Compare the flights that both results contain, by the digests of their files."""
    before = {old.digest: old.figures[HELD] for old in then if HELD in old.figures}
    both = [new for new in now if HELD in new.figures and new.digest in before]
    changes = pd.DataFrame(
        [
            (new.location, group_of(new), name, before[new.digest][name], after_m)
            for new in both
            for name, after_m in new.figures[HELD].items()
            if name in before[new.digest]
        ],
        columns=["location", "group", "estimator", "before_m", "after_m"],
    )
    leads = {
        str(name): lead_of(
            part["after_m"].to_numpy(), part["before_m"].to_numpy(), [*part["group"]]
        )
        for name, part in changes.groupby("estimator")
    }
    before_m, after_m = changes["before_m"], changes["after_m"]
    worse = changes[(after_m > before_m * WORSE) & (after_m > before_m + WORSE_M)]
    gain = (worse["before_m"] / worse["after_m"]).to_numpy(np.float64)
    worse = worse.iloc[np.argsort(gain, kind="stable")]
    return Versus({k: lead for k, lead in leads.items() if lead is not None}, worse, len(both))


def flight_table(results: Sequence[FlightResult]) -> pd.DataFrame:
    """Return all results as a table, one row per recording."""
    return pd.DataFrame([_row(result) for result in results])


def write_season_page(
    results: Sequence[FlightResult], folder: Path, compared: Versus | None
) -> Path:
    """Write the season's page, its figure and its tables into a folder."""
    # Imported here: these require the extra `plot`, which the command has checked.
    from gateway.analysis.reporting.page import Fact, Report, ReportTable, Section, write_report

    judged = [result for result in results if HELD in result.figures]
    broken = [result for result in results if result.error is not None]
    sections = [
        Section(
            "Errors by aircraft and estimator",
            "Each flight was fused without every fifth fix and scored at those: figures are the "
            f"root mean square errors of the flights, horizontal. {why_leads(judged)}".strip(),
            [_picture(judged)] if any(result.figures[HELD] for result in judged) else [],
            [ReportTable("errors", errors_by_group(judged), "Errors at withheld fixes.")],
        )
    ]
    if compared is not None:
        sections.append(_versus_section(compared))
    if broken:
        rows = [(_file_name(result.location), result.error) for result in broken]
        failed = ReportTable("failed", pd.DataFrame(rows, columns=["recording", "why"]), "Failed.")
        lead = "These are not in any of the other tables."
        sections.append(Section("Recordings that failed", lead, tables=[failed]))
    if len(broken) < len(results):
        flights = flight_table([result for result in results if result.error is None])
        # The page is narrow; the distance of a flight is in flights.csv only.
        flights = flights.drop(columns=["failed", "distance, m"])
        table = ReportTable("flight_errors", flights, "Flights.")
        sections.append(Section("Flights", "In the order given.", tables=[table]))
    seconds = sum(r.figures.get("summary", {}).get("duration, s", 0.0) for r in results)
    facts = [
        Fact(str(len(results) - len(broken)), "flights"),
        Fact(f"{seconds / 3600.0:.1f} h", "recorded"),
        Fact(str(len({result.vehicle for result in judged})), "aircraft"),
        Fact(str(len(broken)), "recordings that failed"),
    ]
    description = "All flights of a season, fused again by every estimator."
    return write_report(Report("Season", description, facts, sections), folder, jobs=1)


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

    leads = pd.DataFrame(
        [(name, lead.text) for name, lead in compared.leads.items()],
        columns=["estimator", "new to former error"],
    )
    lead = (
        f"Both fused {counted(compared.compared, 'flight')}. A flight is listed as worse where its "
        "error grew by more than 5 % and 5 cm."
    )
    tables = [ReportTable("versus", leads, "Ratio of the new errors to the former ones.")]
    if len(compared.worse):
        worse = compared.worse.drop(columns="group").assign(
            location=compared.worse["location"].map(_file_name)
        )
        worse.columns = pd.Index(["recording", "estimator", "then, m", "now, m"])
        tables.append(ReportTable("worse", worse, f"{len(worse)} that got worse."))
    return Section("Against the other results", lead, tables=tables)


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
    return Picture("season_errors", draw, caption)
