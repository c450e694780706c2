"""Try settings on a flight: every point of a grid, or by an optimiser, on all cores.

Each trial fuses the flight causally, from the samples only. Some GPS fixes are withheld from the
fusion and used to score it, so a filter that only copies its GPS, noise included, gains nothing.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np

from gateway.analysis.blending import SplitFlight, score, thin, withhold
from gateway.analysis.case import ESTIMATORS, setting_keys
from gateway.analysis.flight import Flight, fuse_track
from gateway.printable import UserError
from gateway.recordings.fuse import FusionSettings
from gateway.settings import fields_of

if TYPE_CHECKING:
    import pandas as pd
    from scipy.optimize import OptimizeResult

SHORT: Final = {"alpha": "estimation.paper.alpha_accel", "beta": "estimation.paper.beta_velocity"}
"""Names that the paper uses, for settings."""
ESTIMATOR_KEY: Final = "estimation.estimator"
LARGEST_GRID: Final = 100_000

Value = float | int | str | bool
Values = tuple[Value, ...]
Metric = Literal["held", "interpolated", "reference", "attitude"]
COLUMN_OF: Final[dict[Metric, str]] = {
    "held": "held_m",
    "interpolated": "interpolated_m",
    "reference": "reference_m",
    "attitude": "attitude_deg",
}
_LACKING: Final[dict[Metric, str]] = {
    "held": "withheld fixes",
    "interpolated": "GPS",
    "reference": "reference of the position",
    "attitude": "reference of the attitude",
}
SEED: Final = 1
Scores = dict[str, float]
Trial = tuple[Values, Scores]
WEIGHTS: Final = (0.1, 0.5, 0.9)
"""Values of alpha and of beta in Table I of the paper."""
Run = Callable[[Sequence[Values]], Iterator[tuple[int, Scores]]]


class SweepError(UserError, ValueError):
    """A sweep that cannot be done; the text states the reason."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One setting that is varied."""

    key: str
    """Path from the root of the settings, such as `estimation.paper.alpha_accel`."""
    values: Values


def full_key(name: str) -> str:
    """Return the path of a setting given by its path, the end of its path, or the paper's name."""
    name = SHORT.get(name, name)
    found = [key for key in setting_keys(FusionSettings) if key == name or key.endswith(f".{name}")]
    if not found:
        raise SweepError(f"no setting ends in {name!r}")
    if len(found) > 1 and name not in found:
        raise SweepError(f"{name!r} may be {' or '.join(found)}")
    return name if name in found else found[0]


def parse_axis(name: str, text: str) -> Axis:
    """Parse an axis: `0.1:0.9:9` for nine values from 0.1 to 0.9, or `0.1,0.5` for a list.

    Raises SweepError if the text is neither, or a value is not allowed.
    """
    key = full_key(name)
    parts = text.split(":")
    try:
        values: Values
        if len(parts) == 3:
            steps = np.linspace(float(parts[0]), float(parts[1]), int(parts[2]))
            # Rounded to remove the error of binary floating point.
            values = tuple(float(f"{step:.12g}") for step in steps)
        elif len(parts) == 2:
            values = (float(parts[0]), float(parts[1]))
        else:
            values = tuple(_value(part.strip()) for part in text.split(","))
    except ValueError as error:
        raise SweepError(f"{name}: {text!r} is no low:high:count and no list: {error}") from error
    if not values:
        raise SweepError(f"{name}: {text!r} contains no value")
    for value in values:
        with_value(FusionSettings(), key, value)
    return Axis(key, values)


def grid(axes: Sequence[Axis]) -> list[Values]:
    """List every point of a grid; the first axis varies slowest.

    Raises SweepError if there are too many points.
    """
    size = math.prod(len(axis.values) for axis in axes)
    if size > LARGEST_GRID:
        raise SweepError(f"the grid has {size} points; at most {LARGEST_GRID} are tried")
    return list(itertools.product(*(axis.values for axis in axes)))


def with_value(settings: Any, key: str, value: Value) -> Any:
    """Return settings with one value changed."""
    name, _, rest = key.partition(".")
    if rest:
        section = with_value(getattr(settings, name), rest, value)
        return msgspec.structs.replace(settings, **{name: section})
    field = next(f for f in fields_of(type(settings)) if f.name == name)
    if isinstance(value, float) and value.is_integer() and isinstance(field.default, int):
        value = int(value)
    try:
        checked = msgspec.convert(value, field.type)
    except msgspec.ValidationError as error:
        raise SweepError(f"{name} = {value}: {error}") from error
    return msgspec.structs.replace(settings, **{name: checked})


def with_values(
    fusion: FusionSettings, keys: Sequence[str], values: Sequence[Value]
) -> FusionSettings:
    """Return settings with several values changed; raises SweepError as `with_value`."""
    for key, value in zip(keys, values, strict=True):
        fusion = with_value(fusion, key, value)
    return fusion


def with_estimator_of(fusion: FusionSettings, keys: Sequence[str]) -> FusionSettings:
    """Select the estimator to which the keys belong; raises SweepError if there are several."""
    named = {key.split(".")[1] for key in keys if key.startswith("estimation.")} & set(ESTIMATORS)
    if len(named) > 1:
        raise SweepError(f"one sweep cannot vary several estimators: {', '.join(sorted(named))}")
    return with_value(fusion, ESTIMATOR_KEY, named.pop()) if named else fusion


def _value(text: str) -> Value:
    try:
        return float(text)
    except ValueError:
        return {"true": True, "false": False}.get(text, text)


@dataclass(frozen=True, slots=True)
class Contest:
    """Data for all trials; each process gets a copy."""

    fusion: FusionSettings
    keys: tuple[str, ...]
    split: SplitFlight


def make_contest(
    flight: Flight,
    fusion: FusionSettings,
    keys: Sequence[str],
    hold_out: int = 5,
    interval_s: float = 0.0,
) -> Contest:
    """Prepare a sweep; raises SweepError if the keys belong to several estimators."""
    fusion = with_estimator_of(fusion, keys)
    keep = np.ones(len(flight.fixes), np.bool_)
    if interval_s:
        # Never both: thinned and withheld fixes together would leave gaps, or no fixes.
        keep = thin(flight, interval_s)
    elif hold_out:
        keep = withhold(flight, hold_out)
    return Contest(fusion, tuple(keys), SplitFlight.by(flight, keep))


def score_of(contest: Contest, fusion: FusionSettings) -> Scores:
    """Fuse the flight with given settings, and score it at the fixes of the contest."""
    split = contest.split
    if fusion.estimation.reference != split.fused.fusion.estimation.reference:
        # Scored with the latency of the trial, as the recorded latency would favour itself.
        split = SplitFlight(*(replace(f, fusion=fusion) for f in (split.fused, split.held)))
    return score(fuse_track(split.fused, fusion), split)


def run_trial(contest: Contest, values: Sequence[Value]) -> Scores:
    """Fuse the flight with these values, and score it; see `COLUMN_OF` for the scores."""
    return score_of(contest, with_values(contest.fusion, contest.keys, values))


def blend_table(flight: Flight, fusion: FusionSettings, interval_s: float) -> "pd.DataFrame":
    """Fuse a flight with every pair of the paper's weights, as in Table I."""
    import pandas as pd

    contest = make_contest(flight, fusion, [*SHORT.values()], hold_out=0, interval_s=interval_s)
    return pd.DataFrame(
        [
            {"alpha": alpha, "beta": beta, **run_trial(contest, (alpha, beta))}
            for alpha, beta in itertools.product(WEIGHTS, repeat=2)
        ]
    )


def tabulate(keys: Sequence[str], trials: Sequence[Trial], metric: Metric) -> "pd.DataFrame":
    """Return a table of trials, the best one first."""
    import pandas as pd

    rows = [{**dict(zip(keys, values, strict=True)), **scores} for values, scores in trials]
    table, column = pd.DataFrame(rows), COLUMN_OF[metric]
    if not table[column].notna().any():
        raise SweepError(
            f"the flight has no {_LACKING[metric]} to score by; choose another --metric"
        )
    table = table.dropna(axis="columns", how="all")
    return table.sort_values(column, kind="stable", ignore_index=True)


def best_of(trials: Sequence[Trial], metric: Metric) -> Values:
    """Return the values of the trial with the least error; of several, the first.

    The table is not used, since its numbers are NumPy types.
    """
    column = COLUMN_OF[metric]
    scored = [trial for trial in trials if not math.isnan(trial[1][column])]
    return min(scored, key=lambda trial: trial[1][column])[0]


def idle_axes(contest: Contest, axes: Sequence[Axis]) -> list[str]:
    """Return the settings without effect, such as those of another estimator.

    Each is tried at its first, middle and last value, with all others at their first, and with
    every estimator that is varied.
    """
    # All values of the estimator, the first one of any other setting.
    varied = [axis.values if axis.key == ESTIMATOR_KEY else axis.values[:1] for axis in axes]
    bases = list(itertools.product(*varied))
    found = []
    for k, axis in enumerate(axes):
        tried = {axis.values[0], axis.values[len(axis.values) // 2], axis.values[-1]}
        runs = [
            [run_trial(contest, (*base[:k], value, *base[k + 1 :])) for value in tried]
            for base in bases
        ]
        if len(tried) > 1 and all(_is_alike(run[0], other) for run in runs for other in run):
            found.append(axis.key)
    return found


def _is_alike(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    return all(a[key] == b[key] or math.isnan(a[key] + b[key]) for key in a)


def optimise(
    axes: Sequence[Axis],
    evaluate: Callable[[list[Values]], list[float]],
    generations: int,
    on_generation: Callable[[float], None] = lambda _: None,
) -> Values:
    """Search between the limits of each axis by differential evolution."""
    from scipy.optimize import differential_evolution

    bounds = []
    for axis in axes:
        numbers = {value for value in axis.values if isinstance(value, int | float)}
        if len(numbers) < 2 or not numbers.issuperset(axis.values):
            raise SweepError(f"{axis.key}: an optimiser needs a range low:high")
        bounds.append((min(numbers), max(numbers)))

    def many(_: object, points: Any) -> list[float]:
        scores = evaluate([tuple(float(v) for v in point) for point in points])
        return [math.inf if math.isnan(s) else s for s in scores]

    def report_progress(intermediate_result: "OptimizeResult") -> None:
        # SciPy passes a result only to a parameter of this name.
        on_generation(float(intermediate_result.fun))

    found = differential_evolution(
        lambda _: math.inf, bounds, maxiter=generations, popsize=6, rng=SEED, polish=False,
        updating="deferred", workers=many, callback=report_progress, tol=1e-3,
    )  # fmt: skip
    return tuple(float(v) for v in found.x)
