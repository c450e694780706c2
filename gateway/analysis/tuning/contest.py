"""Settings tried out on a flight: every point of a grid, or by an optimiser.

Each trial fuses the flight causally, from the samples only. Some GPS fixes are withheld from the
fusion to score it: a filter that only copies its GPS, noise included, gains nothing.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import pandas as pd
from scipy.optimize import OptimizeResult, differential_evolution

from gateway.analysis.blending import Judge, judge_of, make_judge, score
from gateway.analysis.flight_arrays import Flight, FlightTrack, FusionSettings
from gateway.analysis.fusion import fuse
from gateway.analysis.interpolation import thin, withhold
from gateway.analysis.metrics import rms, rotation_error, total_error_rad
from gateway.analysis.tuning.axis import (
    ESTIMATOR_KEY,
    Axis,
    SweepError,
    Value,
    Values,
    with_estimator_of,
    with_values,
)

Metric = Literal["held", "interpolated", "reference", "attitude"]
COLUMN_OF: Final[dict[Metric, str]] = {
    "held": "held_m",
    "interpolated": "interpolated_m",
    "reference": "reference_m",
    "attitude": "attitude_deg",
}
SEED: Final = 1

Trial = tuple[Values, Mapping[str, float]]
"""The values that were tried, and their scores."""


@dataclass(frozen=True, slots=True)
class Contest:
    """The data shared by all trials; each process gets a copy."""

    fusion: FusionSettings
    keys: tuple[str, ...]
    judge: Judge


def settings_at(contest: Contest, values: Sequence[Value]) -> FusionSettings:
    """Return the settings with the values of one trial."""
    return with_values(contest.fusion, contest.keys, values)


def make_contest(
    flight: Flight,
    fusion: FusionSettings,
    keys: Sequence[str],
    *,
    hold_out: int = 5,
    interval_s: float = 0.0,
) -> Contest:
    """Prepare a sweep.

    Raises SweepError if the keys belong to several estimators.
    """
    fusion = with_estimator_of(fusion, keys)
    keep = np.ones(len(flight.fixes), np.bool_)
    if interval_s:
        # Not both: applied after one another they leave gaps, or nothing.
        keep = thin(flight, interval_s)
    elif hold_out:
        keep = withhold(flight, hold_out)
    return Contest(fusion, tuple(keys), make_judge(flight, keep))


def score_of(contest: Contest, fusion: FusionSettings) -> dict[str, float]:
    """Fuse the flight with any settings, and score it by the fixes of the contest."""
    judge = rejudged(contest.judge, fusion)
    return _scores(fuse(judge.fused, fusion), judge)


def run_trial(contest: Contest, values: Sequence[Value]) -> dict[str, float]:
    """Fuse the flight with these values, and score it; see `COLUMN_OF` for the scores."""
    return score_of(contest, settings_at(contest, values))


def rejudged(judge: Judge, settings: FusionSettings) -> Judge:
    """Return the judge with a trial's own latency: judged by the recording's, that would win."""
    if settings.estimation.reference == judge.fused.fusion.estimation.reference:
        return judge
    fused, held = (replace(flight, fusion=settings) for flight in (judge.fused, judge.held_flight))
    return judge_of(fused, held)


def tabulate(keys: Sequence[str], trials: Sequence[Trial], metric: Metric) -> pd.DataFrame:
    """Return trials as a table, the best first."""
    rows = [{**dict(zip(keys, values, strict=True)), **scores} for values, scores in trials]
    table = pd.DataFrame(rows)
    column = COLUMN_OF[metric]
    if not table[column].notna().any():
        raise SweepError(
            f"the flight has no {_LACKING[metric]} to score by; choose another --metric"
        )
    table = table.dropna(axis="columns", how="all")
    return table.sort_values(column, kind="stable", ignore_index=True)


def best_of(trials: Sequence[Trial], metric: Metric) -> Values:
    """Return the values of the trial with the least error, the first of equal ones.

    Not from the table, whose numbers are NumPy types.
    """
    judged = COLUMN_OF[metric]
    scored = [trial for trial in trials if not math.isnan(trial[1][judged])]
    return min(scored, key=lambda trial: trial[1][judged])[0]


def idle_axes(contest: Contest, axes: Sequence[Axis]) -> list[str]:
    """Return the settings that change nothing, such as those that the estimator does not use.

    Each is tried at its first, middle and last value, all others at their first, with every
    estimator that is varied.
    """
    estimators = next((axis.values for axis in axes if axis.key == ESTIMATOR_KEY), (None,))
    bases = [
        tuple(name if axis.key == ESTIMATOR_KEY and name else axis.values[0] for axis in axes)
        for name in estimators
    ]
    found = []
    for k, axis in enumerate(axes):
        tried = {axis.values[0], axis.values[len(axis.values) // 2], axis.values[-1]}
        runs = [
            [
                run_trial(contest, (*base[:k], value, *base[k + 1 :]))
                for value in sorted(tried, key=str)
            ]
            for base in bases
        ]
        if len(tried) > 1 and all(_is_alike(run[0], other) for run in runs for other in run):
            found.append(axis.key)
    return found


def _is_alike(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    return all(a[key] == b[key] or math.isnan(a[key] + b[key]) for key in a)


_LACKING: Final[dict[Metric, str]] = {
    "held": "withheld fixes",
    "interpolated": "GPS",
    "reference": "reference of the position",
    "attitude": "reference of the attitude",
}


def optimise(
    axes: Sequence[Axis],
    evaluate: Callable[[list[Values]], list[float]],
    generations: int,
    on_generation: Callable[[float], None] = lambda _: None,
) -> Values:
    """Search between the least and greatest value of each axis by differential evolution."""
    bounds = []
    for axis in axes:
        numbers = [v for v in axis.values if isinstance(v, int | float)]
        if len(numbers) < 2 or len(numbers) < len(axis.values) or min(numbers) == max(numbers):
            raise SweepError(f"{axis.key}: an optimiser needs a range low:high")
        bounds.append((min(numbers), max(numbers)))

    def many(_: object, points: Any) -> list[float]:
        scores = evaluate([tuple(float(v) for v in point) for point in points])
        return [math.inf if math.isnan(s) else s for s in scores]

    def report_progress(intermediate_result: OptimizeResult) -> None:
        on_generation(float(intermediate_result.fun))

    found = differential_evolution(
        lambda _: math.inf, bounds, maxiter=generations, popsize=6, rng=SEED, polish=False,
        updating="deferred", workers=many, callback=report_progress, tol=1e-3,
    )  # fmt: skip
    return tuple(float(v) for v in found.x)


def _scores(track: FlightTrack, judge: Judge) -> dict[str, float]:
    """Return the errors of a track by the columns of `COLUMN_OF` and of `blending.score`."""
    return {**score(track, judge), "attitude_deg": _attitude_deg(track, judge)}


def _attitude_deg(track: FlightTrack, judge: Judge) -> float:
    reference = judge.fused.reference
    if reference is None:
        return math.nan
    error = total_error_rad(rotation_error(track.q_nb, reference.track.q_nb))
    return rms(np.degrees(error[judge.fused.scored]))
