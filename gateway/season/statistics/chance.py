"""How far the lead of one way of fusing over another is from chance, over many flights."""

from collections.abc import Sequence
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
        """Say it in one sentence."""
        change = f"{_percent(self.ratio)} error over {counted(self.flights, 'flight')}"
        if self.p is None or self.low is None or self.high is None:
            return f"{change}, all of one aircraft and day: nothing tells it from chance"
        if self.low == self.high == self.ratio == 1.0:
            return f"the same error on all {self.flights} flights"
        told = "more than chance" if self.p < CHANCE else "it may be chance"
        return (
            f"{change} on {self.units} aircraft-days, 95 % between {_percent(self.low)} and "
            f"{_percent(self.high)}; p = {self.p:.2g}: {told}"
        )


def _percent(ratio: float) -> str:
    return f"{100.0 * (ratio - 1.0):+.1f} %"


def lead_of(
    errors: NDArray[np.float64], others: NDArray[np.float64], groups: Sequence[str]
) -> Lead | None:
    """Compare two errors of the same flights.

    The logarithms of the ratios are averaged over each group; a permutation test over the signs of
    the groups' averages gives p, a bootstrap over the groups the interval.

    Parameters
    ----------
    errors, others : ndarray, shape (F,)
        Positive; flights where one of them is not known are left out.
    groups : sequence of str
        Aircraft and day of each flight.

    Returns
    -------
    Lead or None
        None if no flight knows both.
    """
    known = np.isfinite(errors) & np.isfinite(others) & (errors > 0.0) & (others > 0.0)
    if not known.any():
        return None
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
