"""Statistics over many flights: chance, cross-validation, errors of the estimators."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, permutation_test

from gateway.units import counted

RESAMPLES: Final = 9_999
SEED: Final = 1
CONFIDENCE: Final = 0.95
CHANCE: Final = 0.05
"""A smaller p is more than chance."""


@dataclass(frozen=True, slots=True)
class Lead:
    """How much smaller the errors of one are than those of the other."""

    flights: int
    units: int
    """Aircraft-days: flights of one day share their weather and their sensors' state."""
    ratio: float
    """Geometric mean of one error over the other; below 1 is better."""
    low: float | None
    high: float | None
    """Where the ratio is with 95 % confidence; None for a single unit."""
    p: float | None
    """How often signs drawn by lot give as great a lead; None for a single unit."""

    @property
    def text(self) -> str:
        """Describe it in one sentence."""
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


def lead_of(
    errors: NDArray[np.float64], others: NDArray[np.float64], groups: Sequence[str]
) -> Lead | None:
    """Compare two errors of the same flights."""
    known = np.isfinite(errors) & np.isfinite(others) & (errors > 0.0) & (others > 0.0)
    if not known.any():
        return None
    # A permutation test over the signs of the groups' averages gives p, a bootstrap over the
    # groups the interval.
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


FOLDS: Final = 10

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Choice:
    """Result of a season's sweep."""

    winner: int
    """Point of the grid with the least mean error over all flights."""
    means: FloatArray
    """Shape (P,): geometric mean of the error of each point over all flights."""
    judged: FloatArray
    """Shape (F,): error of each flight with the point that the other folds chose."""
    folds: int
    stable: int
    """Folds without which the same point wins."""
    over_base: Lead | None
    """Lead of the other folds' choice over the settings that the flights came with."""
    over_second: Lead | None
    """Lead of the winner over the second; both were chosen by the same flights."""


def choose(errors: FloatArray, base: FloatArray, groups: Sequence[str]) -> Choice:
    """Choose a point for all flights, and judge the choosing."""
    known = np.asarray((np.isfinite(errors) & (errors > 0.0)).all(axis=1))
    if not known.any():
        raise ValueError("no flight can judge all of these settings: they hold too few fixes")
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
    """Deal groups out to folds of about equal numbers of flights; with one group, flights."""
    labels = list(groups) if len(set(groups)) > 1 else [str(k) for k in range(len(groups))]
    sizes = Counter(labels)
    load = [0] * min(FOLDS, len(sizes))
    fold: dict[str, int] = {}
    for label in sorted(sizes, key=lambda name: (-sizes[name], name)):
        fold[label] = load.index(min(load))
        load[fold[label]] += sizes[label]
    return np.array([fold[label] for label in labels], np.int64)


WORSE: Final = 1.05
WORSE_M: Final = 0.05
"""A flight counts as worse if its error grew by more than 5 % and 5 cm."""


@dataclass(frozen=True, slots=True)
class FlightErrors:
    """The errors of one flight."""

    place: str
    digest: str
    vehicle: int | None
    began: str | None
    held_m: Mapping[str, float]
    """At withheld fixes, by estimator."""

    @property
    def group(self) -> str:
        """Aircraft and day; a flight without a day is a group of its own."""
        return group_of(self.vehicle, self.began, self.digest)


@dataclass(frozen=True, slots=True)
class GroupErrors:
    """The errors of one estimator on the flights of one aircraft."""

    vehicle: int | None
    """None for all aircraft together."""
    estimator: str
    flights: int
    median_m: float
    most_m: float
    """Nine flights in ten are better."""
    worst_m: float


@dataclass(frozen=True, slots=True)
class Change:
    """One flight, fused by two versions."""

    place: str
    estimator: str
    before_m: float
    after_m: float

    @property
    def is_worse(self) -> bool:
        """Whether it got worse by more than rounding and luck."""
        return self.after_m > self.before_m * WORSE and self.after_m > self.before_m + WORSE_M


@dataclass(frozen=True, slots=True)
class Versus:
    """A season against the same flights of another version."""

    leads: dict[str, Lead]
    """Of now over then, by estimator."""
    worse: list[Change]
    """The worst first."""
    compared: int
    """Flights that both have."""


def group_of(vehicle: int | None, began: str | None, digest: str) -> str:
    """Name the aircraft and day of a flight, which share weather and the state of the sensors."""
    return f"{vehicle} {began[:10] if began else digest}"


def errors_by_group(flights: Iterable[FlightErrors]) -> list[GroupErrors]:
    """Sum errors up: all aircraft together first, then each."""
    found: dict[tuple[int | None, str], list[float]] = defaultdict(list)
    vehicles: set[int | None] = set()
    for flight in flights:
        vehicles.add(flight.vehicle)
        for estimator, error_m in flight.held_m.items():
            found[flight.vehicle, estimator].append(error_m)
            if flight.vehicle is not None:
                found[None, estimator].append(error_m)
    if len(vehicles) == 1:
        found = {key: errors for key, errors in found.items() if key[0] is not None} or found
    return [
        GroupErrors(
            vehicle,
            estimator,
            len(errors),
            float(np.median(errors)),
            float(np.quantile(errors, 0.9)),
            max(errors),
        )
        for (vehicle, estimator), errors in sorted(
            found.items(), key=lambda entry: (entry[0][0] or 0, entry[0][1])
        )
    ]


def versus(now: Iterable[FlightErrors], then: Iterable[FlightErrors]) -> Versus:
    """Compare the flights that both have, by the digests of their files."""
    before = {flight.digest: flight for flight in then}
    both = [(flight, before[flight.digest]) for flight in now if flight.digest in before]
    leads: dict[str, Lead] = {}
    changes: list[Change] = []
    for estimator in sorted(
        {name for flight, old in both for name in flight.held_m if name in old.held_m}
    ):
        pairs = [(f, o) for f, o in both if estimator in f.held_m and estimator in o.held_m]
        after = np.array([flight.held_m[estimator] for flight, _ in pairs])
        old = np.array([flight.held_m[estimator] for _, flight in pairs])
        lead = lead_of(after, old, [flight.group for flight, _ in pairs])
        if lead is not None:
            leads[estimator] = lead
        changes += [
            Change(f.place, estimator, o.held_m[estimator], f.held_m[estimator]) for f, o in pairs
        ]
    worse = [change for change in changes if change.is_worse]
    return Versus(leads, sorted(worse, key=lambda c: c.before_m / c.after_m), len(both))
