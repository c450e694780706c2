"""One set of settings for many flights, judged only by flights that did not choose it."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.season.statistics.chance import Lead, lead_of

FOLDS: Final = 10

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Choice:
    """What a season's sweep found."""

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
    """Lead of what the other folds chose over the settings that the flights came with."""
    over_second: Lead | None
    """Lead of the winner over the second; both were chosen by the same flights."""


def choose(errors: FloatArray, base: FloatArray, groups: Sequence[str]) -> Choice:
    """Choose a point for all flights, and judge the choosing.

    Parameters
    ----------
    errors : ndarray, shape (F, P)
        Of each flight with each point.
    base : ndarray, shape (F,)
        Of each flight with the settings that it came with.
    groups : sequence of str
        Aircraft and day of each flight: flights of one group stay in one fold.

    Returns
    -------
    Choice

    Raises
    ------
    ValueError
        If no flight knows the errors of all points.
    """
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
    """Deal groups out to folds of about equal numbers of flights; with one group, flights.

    Returns
    -------
    ndarray, shape (F,)
        Number of the fold of each flight.
    """
    labels = list(groups) if len(set(groups)) > 1 else [str(k) for k in range(len(groups))]
    sizes = Counter(labels)
    load = [0] * min(FOLDS, len(sizes))
    fold: dict[str, int] = {}
    for label in sorted(sizes, key=lambda name: (-sizes[name], name)):
        fold[label] = load.index(min(load))
        load[fold[label]] += sizes[label]
    return np.array([fold[label] for label in labels], np.int64)
