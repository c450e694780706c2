"""Received data of an aircraft over the last minutes: numeric fields, also as CSV; samples."""

import math
from array import array
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Mapping
from functools import partial
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.units import DEG_PER_DEGE7, US_PER_S
from gateway.wire.mavlink_splitter import message_id_of

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SPAN_US: Final = 300 * US_PER_S
MAX_RATE_HZ: Final = 50
"""Maximum rate; faster messages are thinned, since no strip chart of minutes has more columns."""
LEAST_GAP_US: Final = US_PER_S * 3 // (4 * MAX_RATE_HZ)
"""Least interval, shorter than that of the rate, so that jitter does not drop messages at it."""
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
MAX_KINDS: Final = 200
"""Maximum messages of one aircraft, each instance counted; more are forged."""
MAX_ARRAY: Final = 32
"""Maximum length of an array; longer ones contain files and logs, not quantities."""
FUSED_SPAN_US: Final = 180 * US_PER_S
MAX_FRAMES: Final = 40_000
"""Maximum frames: three minutes at 200 a second; less at a higher rate."""
SENSOR_MESSAGES: Final = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    }
)

TimedFrames = list[tuple[int, bytes]]
"""Frames with the time at which each was received, µs on the panel's clock."""


def parameter_unit(unit: str) -> tuple[float, str]:
    """Return the factor and the displayed unit of a parameter: degrees for angles."""
    return ANGLES.get(unit, (1.0, UNIT_TEXTS.get(unit, unit)))


def shown_unit(unit: str) -> tuple[float, str]:
    """Return the factor and the displayed unit of a field with a MAVLink unit."""
    return SHOWN_UNITS.get(unit) or parameter_unit(unit)


class FieldHistory:
    """Received fields of one aircraft as columns over time, by message."""

    def __init__(self) -> None:
        self._kinds: dict[str, _Columns] = {}

    def add(self, message: Any, now_us: int) -> None:
        """Store one message."""
        name = _kind_of(message)
        if name not in self._kinds:
            if len(self._kinds) >= MAX_KINDS:
                return
            self._kinds[name] = _Columns(message)
        self._kinds[name].add(message, now_us)

    def fields(self) -> dict[str, tuple[str, ...]]:
        """Return the fields of each message, in alphabetical order."""
        kinds = sorted(self._kinds.items())
        return {kind: columns.names for kind, columns in kinds if columns.names}

    def unit(self, name: str) -> str:
        """Return a field's unit as MAVLink writes it; empty if it has none or is unknown."""
        kind, _, field = name.partition(".")
        return self._kinds[kind].unit(field) if kind in self._kinds else ""

    def series(
        self, name: str, after_us: int = -1, until_us: int | None = None
    ) -> tuple[IntArray, FloatArray]:
        """Return the times, on the panel's clock, and values of a field; empty if never received.

        Its name is that of message and field, such as `BATTERY_STATUS[0].voltages[1]`. The values
        have the unit of the message, and times after the first and up to the second limit.
        """
        kind, _, field = name.partition(".")
        columns = self._kinds.get(kind)
        if columns is None or field not in columns.names:
            return np.empty(0, np.int64), np.empty(0)
        return columns.column(field, after_us, until_us)


class _Columns:
    """Rows of the last `SPAN_US`, and up to a quarter more, so that they are seldom moved."""

    def __init__(self, message: Any) -> None:
        self._readers = _readers_of(message)
        self.names = tuple(sorted(self._readers))
        self._index = {name: n for n, name in enumerate(self._readers)}
        self._units: dict[str, str] = getattr(message, "fieldunits_by_name", {})
        self._time_us = array("q")
        self._values = array("d")
        """Row after row."""

    def unit(self, field: str) -> str:
        return self._units.get(field.partition("[")[0], "")

    def add(self, message: Any, now_us: int) -> None:
        times_us = self._time_us
        if times_us and now_us - times_us[-1] < LEAST_GAP_US:
            return
        times_us.append(now_us)
        self._values.extend(read(message) for read in self._readers.values())
        if now_us - times_us[0] > SPAN_US * 5 // 4:
            old = bisect_left(times_us, now_us - SPAN_US)
            del times_us[:old], self._values[: old * len(self._readers)]

    def column(
        self, field: str, after_us: int, until_us: int | None
    ) -> tuple[IntArray, FloatArray]:
        time_us = np.array(self._time_us)
        begin = np.searchsorted(time_us, max(after_us, time_us[-1] - SPAN_US), "right")
        end = len(time_us) if until_us is None else np.searchsorted(time_us, until_us, "right")
        values = np.array(self._values[self._index[field] :: len(self._readers)])
        return time_us[begin:end], values[begin:end]


def _readers_of(message: Any) -> dict[str, Callable[[Any], float]]:
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


class SampleMemory:
    """Sensor frames of one aircraft."""

    def __init__(self) -> None:
        self.frames: deque[tuple[int, bytes]] = deque(maxlen=MAX_FRAMES)
        """The oldest first, with the time at which each was received."""

    def add(self, message: Any, now_us: int) -> None:
        """Store a message, if it is a sensor's."""
        if message.get_msgId() not in SENSOR_MESSAGES:
            return
        self.frames.append((now_us, bytes(message.get_msgbuf())))
        while self.frames[0][0] < now_us - FUSED_SPAN_US:
            self.frames.popleft()

    def collected(self, span_s: float, rate_hz: float) -> float:
        """Return the collected share of a span up to the newest sample at a rate, at most 1."""
        newest_us = self.frames[-1][0] if self.frames else 0
        counts, first_us = Counter[int](), dict[int, int]()
        for time_us, frame in reversed(self.frames):
            if newest_us - time_us > (span_s + 1.0) * US_PER_S:
                break
            kind = message_id_of(frame)
            counts[kind] += 1
            first_us[kind] = time_us
        shares = (
            min(count / (span_s * rate_hz), (newest_us - first_us[kind]) / US_PER_S / span_s)
            for kind, count in counts.items()
        )
        return min(1.0, max(shares, default=0.0))
