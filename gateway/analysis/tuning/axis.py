"""The settings that a sweep varies, and their values."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import numpy as np

from gateway.analysis.case import ESTIMATORS
from gateway.analysis.flight_arrays import FusionSettings
from gateway.settings import Settings, fields_of

SHORT: Final = {
    "alpha": "estimation.paper.alpha_accel",
    "beta": "estimation.paper.beta_velocity",
}
"""The paper's own names."""
ESTIMATOR_KEY: Final = "estimation.estimator"
LARGEST_GRID: Final = 100_000

Value = float | int | str | bool
Values = tuple[Value, ...]


class SweepError(ValueError):
    """A sweep that cannot be done; the text says why."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One setting that is varied."""

    key: str
    """Path from the root of the settings, such as `estimation.paper.alpha_accel`."""
    values: Values


def full_key(name: str) -> str:
    """Find a setting by its path, the end of its path, or the paper's name."""
    name = SHORT.get(name, name)
    found = [key for key in _leaves(FusionSettings, "") if key == name or key.endswith(f".{name}")]
    if not found:
        raise SweepError(f"no setting ends in {name!r}")
    if len(found) > 1 and name not in found:
        raise SweepError(f"{name!r} may be {' or '.join(found)}")
    return name if name in found else found[0]


def parse_axis(name: str, text: str) -> Axis:
    """Read an axis: `0.1:0.9:9` for nine values from 0.1 to 0.9, or `0.1,0.5` for a list.

    Raises SweepError if the text is neither, or a value is not allowed.
    """
    key = full_key(name)
    parts = text.split(":")
    try:
        values: Values
        if len(parts) == 3:
            steps = np.linspace(float(parts[0]), float(parts[1]), int(parts[2]))
            # Rounded to the digits that a person would write.
            values = tuple(float(f"{step:.12g}") for step in steps)
        elif len(parts) == 2:
            values = (float(parts[0]), float(parts[1]))
        else:
            values = tuple(_value(part.strip()) for part in text.split(","))
    except ValueError as error:
        raise SweepError(f"{name}: {text!r} is no low:high:count and no list: {error}") from error
    if not values:
        raise SweepError(f"{name}: {text!r} holds no value")
    for value in values:
        with_value(FusionSettings(), key, value)
    return Axis(key, values)


def grid(axes: Sequence[Axis]) -> list[Values]:
    """List every point of a grid; the first axis varies slowest.

    Raises SweepError if there are too many.
    """
    size = math.prod(len(axis.values) for axis in axes)
    if size > LARGEST_GRID:
        raise SweepError(f"the grid has {size} points; at most {LARGEST_GRID} are tried")
    return list(itertools.product(*(axis.values for axis in axes)))


def with_value(settings: Any, key: str, value: Value) -> Any:
    """Return settings with one value changed."""
    name, _, rest = key.partition(".")
    if rest:
        return msgspec.structs.replace(
            settings, **{name: with_value(getattr(settings, name), rest, value)}
        )
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
    """Return settings with values changed by key; raises SweepError as `with_value`."""
    for key, value in zip(keys, values, strict=True):
        fusion = with_value(fusion, key, value)
    return fusion


def with_estimator_of(fusion: FusionSettings, keys: Sequence[str]) -> FusionSettings:
    """Choose the estimator that the keys belong to, if to one; raises SweepError if to several."""
    named = {key.split(".")[1] for key in keys if key.startswith("estimation.")} & set(ESTIMATORS)
    if len(named) > 1:
        raise SweepError(f"one sweep cannot vary several estimators: {', '.join(sorted(named))}")
    return with_value(fusion, ESTIMATOR_KEY, named.pop()) if named else fusion


def _leaves(kind: type[Settings], prefix: str) -> Iterator[str]:
    for field in fields_of(kind):
        if field.section:
            yield from _leaves(field.section, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}"


def _value(text: str) -> Value:
    try:
        return float(text)
    except ValueError:
        return {"true": True, "false": False}.get(text, text)
