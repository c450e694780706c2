"""Received numeric fields over the last minutes, by aircraft and message; as CSV."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.units import DEG_PER_DEGE7, US_PER_S

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SPAN_US: Final = 300 * US_PER_S
MAX_RATE_HZ: Final = 50
"""Maximum rate; faster messages are thinned, since no strip chart of minutes has more columns."""
LEAST_GAP_US: Final = US_PER_S * 3 // (4 * MAX_RATE_HZ)
"""Least interval, shorter than that of the rate, so that jitter does not drop messages at it."""
MAX_ROWS: Final = SPAN_US // LEAST_GAP_US
ANGLES: Final = {"rad": (math.degrees(1.0), "°"), "rad/s": (math.degrees(1.0), "°/s")}
SHOWN_UNITS: Final = ANGLES | {
    "degE7": (DEG_PER_DEGE7, "°"), "cdeg": (1e-2, "°"), "cm/s": (1e-2, "m/s"),
    "gauss": (100.0, "µT"), "cdegC": (1e-2, "°C"), "us": (1e-6, "s"), "ms": (1e-3, "s"),
}  # fmt: skip
"""Factor and displayed unit of a field, by its MAVLink unit."""
UNIT_TEXTS: Final = {
    "deg": "°", "deg/s": "°/s", "m/s/s": "m/s²", "m/s2": "m/s²", "m/s^2": "m/s²", "uT": "µT",
    "degC": "°C", "us": "µs", "m2": "m²",
}  # fmt: skip
FIRST_ROWS: Final = 256
MAX_KINDS: Final = 200
"""Maximum messages of one aircraft, each instance counted; more are forged."""
MAX_ARRAY: Final = 32
"""Maximum length of an array; longer ones contain files and logs, not quantities."""


def parameter_unit(unit: str) -> tuple[float, str]:
    """Return the factor and the displayed unit of a parameter: degrees for angles."""
    return ANGLES.get(unit, (1.0, UNIT_TEXTS.get(unit, unit)))


def shown_unit(unit: str) -> tuple[float, str]:
    """Return the factor and the displayed unit of a field with a MAVLink unit."""
    return SHOWN_UNITS.get(unit) or parameter_unit(unit)


class FieldHistory:
    """Received fields as columns over time, by aircraft and message."""

    def __init__(self) -> None:
        self._vehicles: dict[int, dict[str, _Columns]] = {}

    def add(self, system_id: int, message: Any, now_us: int) -> None:
        """Store one message."""
        kinds = self._vehicles.setdefault(system_id, {})
        name = _kind_of(message)
        columns = kinds.get(name)
        if columns is None:
            if len(kinds) >= MAX_KINDS:
                return
            columns = kinds[name] = _Columns(message)
        columns.add(message, now_us)

    def discard(self, system_id: int) -> None:
        """Delete the data of an aircraft."""
        self._vehicles.pop(system_id, None)

    def fields(self, system_id: int) -> dict[str, tuple[str, ...]]:
        """Return the fields of each message of an aircraft, in alphabetical order."""
        kinds = self._vehicles.get(system_id, {})
        return {kind: kinds[kind].names for kind in sorted(kinds) if kinds[kind].names}

    def unit(self, system_id: int, name: str) -> str:
        """Return a field's unit as MAVLink writes it; empty if it has none or is unknown."""
        kind, _, field = name.partition(".")
        columns = self._vehicles.get(system_id, {}).get(kind)
        return "" if columns is None else columns.unit(field)

    def series(
        self, system_id: int, name: str, after_us: int = -1, until_us: int | None = None
    ) -> tuple[IntArray, FloatArray]:
        """Return the times, on the panel's clock, and values of a field; empty if never received.

        Its name is that of message and field, such as `BATTERY_STATUS[0].voltages[1]`. The values
        have the unit of the message, and times after the first and up to the second limit.
        """
        kind, _, field = name.partition(".")
        columns = self._vehicles.get(system_id, {}).get(kind)
        if columns is None or field not in columns.names:
            return np.empty(0, np.int64), np.empty(0)
        return columns.column(field, after_us, until_us)


class _Columns:
    """A ring of rows, which grows to hold `SPAN_US`, and never beyond `MAX_ROWS`."""

    def __init__(self, message: Any) -> None:
        self._readers = _readers_of(message)
        self.names = tuple(sorted(self._readers))
        self._index = {name: n for n, name in enumerate(self._readers)}
        self._units: dict[str, str] = getattr(message, "fieldunits_by_name", {})
        self._time_us = np.zeros(FIRST_ROWS, np.int64)
        self._values = np.zeros((FIRST_ROWS, len(self._readers)))
        self._count = 0
        """The newest row is at `(count - 1) % capacity`, the oldest of a full ring after it."""

    def unit(self, field: str) -> str:
        return self._units.get(field.partition("[")[0], "")

    @property
    def capacity(self) -> int:
        return len(self._time_us)

    def add(self, message: Any, now_us: int) -> None:
        if self._count:
            last_us = int(self._time_us[(self._count - 1) % self.capacity])
            if now_us - last_us < LEAST_GAP_US:
                return
        oldest_us = int(self._time_us[self._count % self.capacity])
        is_full = self._count >= self.capacity
        if is_full and self.capacity < MAX_ROWS and now_us - oldest_us <= SPAN_US:
            self._grow(min(2 * self.capacity, MAX_ROWS))
        row = self._count % self.capacity
        self._time_us[row] = now_us
        self._values[row] = [read(message) for read in self._readers.values()]
        self._count += 1

    def column(
        self, field: str, after_us: int, until_us: int | None
    ) -> tuple[IntArray, FloatArray]:
        order = self._order()
        time_us = self._time_us[order]
        newest_us = int(time_us[-1]) if len(time_us) else 0
        begin = np.searchsorted(time_us, max(after_us, newest_us - SPAN_US), "right")
        end = len(time_us) if until_us is None else np.searchsorted(time_us, until_us, "right")
        values = self._values[order[begin:end], self._index[field]]
        return time_us[begin:end], values

    def _order(self) -> IntArray:
        capacity = self.capacity
        if self._count <= capacity:
            return np.arange(self._count)
        return np.arange(self._count - capacity, self._count) % capacity

    def _grow(self, capacity: int) -> None:
        order, more = self._order(), capacity - self.capacity
        self._time_us = np.concatenate([self._time_us[order], np.zeros(more, np.int64)])
        self._values = np.concatenate(
            [self._values[order], np.zeros((more, self._values.shape[1]))]
        )
        self._count = len(order)


def _readers_of(message: Any) -> dict[str, Callable[[Any], float]]:
    """Return functions that read each number in a message, by its name."""
    found: dict[str, Callable[[Any], float]] = {}
    for field in message.fieldnames:
        value = getattr(message, field)
        if isinstance(value, int | float):
            found[field] = attrgetter(field)
        elif isinstance(value, list | tuple) and 0 < len(value) <= MAX_ARRAY:
            for n, item in enumerate(value):
                if isinstance(item, int | float):
                    found[f"{field}[{n}]"] = partial(_item, field, n)
    return found


def _item(field: str, index: int, message: Any) -> float:
    return float(getattr(message, field)[index])


def _kind_of(message: Any) -> str:
    name: str = message.get_type()
    instance = getattr(message, "instance_field", None)
    return name if instance is None else f"{name}[{getattr(message, instance)}]"


def fields_csv(
    series: Mapping[str, tuple[IntArray, FloatArray]], units: Mapping[str, str], zero_unix_us: int
) -> str:
    """Write fields as columns."""
    heads = [f"{name} ({units[name]})" if units.get(name) else name for name in series]
    lines = [",".join(["time_unix_s", *heads])]
    columns = [dict(zip(t.tolist(), v.tolist(), strict=True)) for t, v in series.values()]
    times = [t for t, _ in series.values()]
    for time_us in np.unique(np.concatenate(times)).tolist() if times else []:
        seconds = f"{(zero_unix_us + time_us) / US_PER_S:.6f}"
        lines.append(",".join([seconds, *(_cell(column.get(time_us)) for column in columns)]))
    return "\n".join(lines) + "\n"


def _cell(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.9g}"
