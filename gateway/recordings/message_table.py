"""Convert fields of an autopilot's own log to those of MAVLink messages, by a table.

The tables are `formats/dataflash.toml` and `formats/ulog.toml`. For example, the message

    [messages.VFR_HUD]
    of = ["POS", "GPS"]
    groundspeed = ["hypot(XKF1.VN m/s, XKF1.VE m/s)", "GPS.Spd m/s", 0]

is sent for each row of the first topic of `of` that the log contains. A field gets the first of its
values that is known: `TOPIC.FIELD unit`, a function of such values, or a number. Units are
converted to those of the MAVLink definition; a unit that the log itself states has priority over
the table's. `*100` instead of a unit is a factor, `copter: ` before a value restricts it to a kind
of vehicle, and `PARM.NAME` is a parameter, where `#` is the number of the instance, from 2 on.

With `each` a message is sent for every instance of its topic, by the names in that list, or by its
own name if the list is empty. With `every_s` it is repeated at that interval, from the newest rows.

A section such as `[samples.gps]` gives, in the same way, the columns of a table for the samples
that are fused: they keep the resolution of the log.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, Final, Protocol

import msgspec

from gateway.geometry.atmosphere import pressure_at_height
from gateway.geometry.quaternion import from_euler, to_euler
from gateway.recordings.columns import unit_of
from gateway.records import NAN, ImuFlags
from gateway.units import DEG_PER_DEGE7, PA_PER_HPA, RAD_PER_DEG, STANDARD_GRAVITY_MPS2
from gateway.vehicle.encoding import MessagePacker
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS

UNITS: Final[dict[str, tuple[str, float]]] = {
    "rad": ("angle", 1.0), "deg": ("angle", RAD_PER_DEG), "cdeg": ("angle", RAD_PER_DEG * 1e-2),
    "degE7": ("angle", RAD_PER_DEG * DEG_PER_DEGE7),
    "1e-7 deg": ("angle", RAD_PER_DEG * DEG_PER_DEGE7), "degE5": ("angle", RAD_PER_DEG * 1e-5),
    "degheading": ("angle", RAD_PER_DEG), "deglatitude": ("angle", RAD_PER_DEG),
    "deglongitude": ("angle", RAD_PER_DEG),
    "rad/s": ("rate", 1.0), "deg/s": ("rate", RAD_PER_DEG), "mrad/s": ("rate", 1e-3),
    "m": ("length", 1.0), "cm": ("length", 1e-2), "mm": ("length", 1e-3),
    "m/s": ("speed", 1.0), "cm/s": ("speed", 1e-2), "mm/s": ("speed", 1e-3),
    "m/s/s": ("acceleration", 1.0), "m/s^2": ("acceleration", 1.0),
    "mG": ("acceleration", STANDARD_GRAVITY_MPS2 * 1e-3),
    "V": ("voltage", 1.0), "cV": ("voltage", 1e-2), "mV": ("voltage", 1e-3),
    "A": ("current", 1.0), "cA": ("current", 1e-2), "mA": ("current", 1e-3),
    "Ah": ("charge", 1.0), "mAh": ("charge", 1e-3),
    "W.h": ("energy", 1.0), "hJ": ("energy", 100.0 / 3600.0),
    "Pa": ("pressure", 1.0), "hPa": ("pressure", 100.0),
    "degC": ("temperature", 1.0), "cdegC": ("temperature", 1e-2),
    "Gauss": ("field", 1.0), "gauss": ("field", 1.0), "mGauss": ("field", 1e-3),
    "mgauss": ("field", 1e-3), "uT": ("field", 1e-2),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "µs": ("time", 1e-6),
    "ratio": ("share", 1.0), "%": ("share", 1e-2), "d%": ("share", 1e-3), "c%": ("share", 1e-4),
}  # fmt: skip
"""Quantity and factor to SI of each unit, by its name in MAVLink, in the logs or in tables."""
TURN: Final = 2.0 * math.pi
MAX_AGE_US: Final = 3_000_000
"""Maximum age of a row whose values are used in a message."""
_EKF_FLAGS: Final = 0x3FF
"""Bits that are the same in ArduPilot's filter status and in EKF_STATUS_REPORT."""
_LANDED, _IN_AIR = 1, 2
"""Values of MAV_LANDED_STATE."""
WRAPPED: Final = frozenset({"compass", "course", "heading"})
OPTIONAL: Final = frozenset({"valid", "new", "pressure_at", "clipping"})
"""Functions of which only the first value must be known."""
NOT_NEW: Final = 0x7FFFFFFF
"""Value of a time relative to PX4's sample that means "no new value"."""
LEAST_PA: Final = 2000.0
"""Minimum pressure; smaller values are in hPa, as in `sensor_baro` before PX4 1.14. No aircraft
flies that high."""
Values = Mapping[str, Any]
ValueOf = Callable[[str, str], float]
"""Returns a field of the newest row of a topic; NaN if there is none, or it is too old."""
Read = Callable[[ValueOf], float]
_CALL: Final = re.compile(r"(?:(?P<kind>\w+): )?(?:(?P<function>\w+)\()?(?P<values>[^()]*)\)?")
_VALUE: Final = re.compile(
    r"(?P<topic>\w+)\.(?P<name>[\w\[\].#]+)(?: (?:\*(?P<factor>[-\d.e]+)|(?P<unit>\S+)))?"
)
UINT32, UINT64 = (1 << 32) - 1, (1 << 64) - 1
TIMES: Final = ("time_boot_ms", "time_usec")


def _quaternion(part: int) -> Callable[..., float]:
    def read(roll: float, pitch: float, yaw: float) -> float:
        q = from_euler(roll, pitch, yaw)
        return math.copysign(q[part], q[part] * q[0]) if part else abs(q[0])

    return read


def _euler(part: int) -> Callable[..., float]:
    return lambda w, x, y, z: to_euler((w, x, y, z))[part]


def _clipping(accel: float, gyro: float) -> float:
    accel_flag = ImuFlags.ACCEL_CLIPPED if accel else ImuFlags(0)
    return accel_flag | (ImuFlags.GYRO_CLIPPED if gyro > 0 else ImuFlags(0))


FUNCTIONS: Final[dict[str, Callable[..., float]]] = {
    "up": lambda down: -down,
    "hypot": math.hypot,
    "north": lambda speed, course: speed * math.cos(course),
    "east": lambda speed, course: speed * math.sin(course),
    "compass": lambda angle: angle % TURN,
    "signed": lambda angle: math.remainder(angle, TURN),
    "course": lambda north, east: math.atan2(east, north) % TURN,
    "from": lambda north, east: math.atan2(-east, -north),
    "q1": _quaternion(0), "q2": _quaternion(1), "q3": _quaternion(2), "q4": _quaternion(3),
    "roll": _euler(0), "pitch": _euler(1), "yaw": _euler(2),
    "heading": lambda w, x, y, z: to_euler((w, x, y, z))[2] % TURN,
    "remaining": lambda used, capacity: max(1 - used / capacity, 0) if capacity > 0 else NAN,
    "ekf_flags": lambda status: int(status) & _EKF_FLAGS,
    "landed": lambda landed: _LANDED if landed else _IN_AIR,
    "measured": lambda value: value if value >= 0 else NAN,
    "known": lambda value: value if value > 0 else NAN,
    "minus": lambda value, other: value - other,
    "valid": lambda value, is_valid: NAN if is_valid == 0 else value,
    "new": lambda value, age: NAN if age == NOT_NEW else value,
    "pressure": lambda value: value * PA_PER_HPA if value < LEAST_PA else value,
    "pressure_at": lambda height, age=0: NAN if age == NOT_NEW else pressure_at_height(height),
    "clipping": _clipping,
}  # fmt: skip
"""Functions of SI values; `compass`, `course` and `heading` are angles from north in [0, 2π)."""


class LogFacts(Protocol):
    """The facts of a log that binding a table requires."""

    kind: str
    """Kind of vehicle, as in the table: copter, plane, rover …; empty if it is not known."""

    @property
    def present(self) -> frozenset[str]:
        """Topics that have rows."""
        ...

    def unit(self, topic: str, name: str) -> str | None:
        """Return the unit that the log itself states; None if it states none."""
        ...


@dataclass(frozen=True, slots=True)
class LogField:
    """A field of a log's topic, and its unit according to the table."""

    topic: str
    name: str
    quantity: str
    factor: float
    """Factor to SI, or to the field's own scale if it has no unit."""

    @classmethod
    def parse(cls, text: str) -> "LogField":
        """Parse `TOPIC.FIELD unit`; raises ValueError for any other text."""
        found = _VALUE.fullmatch(text)
        if found is None or (found["unit"] or "ratio") not in UNITS:
            raise ValueError(f"{text!r} is not TOPIC.FIELD with a known unit")
        quantity, factor = UNITS[found["unit"]] if found["unit"] else ("", 1.0)
        return cls(found["topic"], found["name"], quantity, float(found["factor"] or factor))

    def factor_in(self, log: LogFacts) -> float:
        """Return the factor to SI of the unit that the log states, or else of the table's."""
        stated = UNITS.get(log.unit(self.topic, self.name) or "")
        is_same = stated is not None and stated[0] == self.quantity
        return stated[1] if stated is not None and is_same else self.factor


@dataclass(frozen=True, slots=True)
class Value:
    """One of the alternative values of a field: a number, a source, or a function of sources."""

    sources: tuple[LogField, ...] = ()
    function: str = ""
    kind: str = ""
    """Kind of vehicle to which the value is restricted; empty for all."""
    number: float = 0.0

    @classmethod
    def parse(cls, given: str | float) -> "Value":
        """Parse a value; raises ValueError if it is malformed."""
        if not isinstance(given, str):
            return cls(number=given)
        found = _CALL.fullmatch(given)
        function = (found and found["function"]) or ""
        if found is None or (function and function not in FUNCTIONS):
            raise ValueError(f"{given!r} is not a value")
        texts = [text for text in found["values"].split(", ") if text]
        return cls(tuple(map(LogField.parse, texts)), function, found["kind"] or "")

    def bind(self, log: LogFacts, factor: float) -> Read | None:
        """Return a reader with a factor to SI; None if the log cannot contain the value."""
        if self.kind not in ("", log.kind):
            return None
        if not self.sources:
            return lambda _: self.number
        needed = 1 if self.function in OPTIONAL else len(self.sources)
        if any(one.topic not in log.present for one in self.sources[:needed]):
            return None
        parts = [(one.topic, one.name, one.factor_in(log)) for one in self.sources]
        if not self.function:
            ((topic, name, scale),) = parts
            scale /= factor if self.sources[0].quantity else 1.0
            return lambda value_of: value_of(topic, name) * scale
        return _call(self.function, parts, needed, factor)


def _call(name: str, parts: Sequence[tuple[str, str, float]], needed: int, factor: float) -> Read:
    function, turn = FUNCTIONS[name], round(TURN / factor) if name in WRAPPED else 0

    def read(value_of: ValueOf) -> float:
        values = [value_of(topic, name) * scale for topic, name, scale in parts]
        if not all(map(math.isfinite, values[:needed])):
            return NAN
        found = function(*values) / factor
        # A value within half a unit of the full turn would be rounded to it.
        return found - turn if turn and turn > 1 and round(found) >= turn else found

    return read


def first_known(reads: Iterable[Read], value_of: ValueOf) -> float:
    """Return the first value that is known; otherwise the last one, which is not finite."""
    value = NAN
    for read in reads:
        value = read(value_of)
        if math.isfinite(value):
            break
    return value


class MessageRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A message of a table."""

    name: str
    of: tuple[str, ...]
    each: tuple[str, ...] | None
    every_s: float | None
    fields: dict[str, tuple[Value, ...]]


@dataclass(frozen=True, slots=True)
class BoundMessage:
    """A message of a table, bound to a log and an instance."""

    name: str
    packer: MessagePacker
    reads: tuple[tuple[bool, tuple[Read, ...]], ...]
    """For each element in the order of the definition: whether it is an integer; its readers."""

    def values(self, value_of: ValueOf, times: Mapping[str, int]) -> list[float]:
        """Return the values of all elements; an unknown one is NaN, or 0 for an integer."""
        found: list[float] = []
        for is_whole, reads in self.reads:
            value = first_known(reads, value_of) if reads else 0.0
            if is_whole:
                value = round(value) if math.isfinite(value) else 0
            found.append(value)
        for at, name, greatest in self.timed:
            found[at] = times[name] & greatest
        return found

    timed: tuple[tuple[int, str, int], ...] = ()
    """Index of each field with the time of the row, its name, and the maximum of its type."""


@dataclass(frozen=True, slots=True)
class MessageTable:
    """The table of one autopilot."""

    messages: tuple[MessageRow, ...]
    samples: tuple[MessageRow, ...] = ()
    """Columns of a table by the kind of sample: imu, mag, baro, gps, nav."""
    aliases: dict[str, tuple[str, int]] = field(default_factory=dict)
    """Topic and instance by former topic name."""
    primary_fields: dict[str, str] = field(default_factory=dict)
    """Topics of several filters; value: the field with the number of the filter in use."""
    health: dict[str, int] = field(default_factory=dict)
    """Bits of MAV_SYS_STATUS_SENSOR by topic."""
    known: frozenset[str] = frozenset()
    """Topics that are used for other purposes than fields: modes, texts, parameters."""
    modes: dict[str, dict[str, str]] = field(default_factory=dict)
    """Names by custom mode, by kind of vehicle."""
    vehicle_types: dict[str, int] = field(default_factory=dict)
    nav_states: dict[str, tuple[str, int, int]] = field(default_factory=dict)
    """PX4's navigation states: name, main mode and sub mode."""

    @property
    def topics(self) -> frozenset[str]:
        """All topics in use, by their names in the log."""
        used = {t for one in self.messages for t in one.of} | self.known | {*self.health}
        used |= {source.topic for source in self.sources}
        used |= {where.partition(".")[0] for where in self.primary_fields.values()}
        return frozenset(used | {old for old, (new, _) in self.aliases.items() if new in used})

    @property
    def sources(self) -> Iterator[LogField]:
        """All fields in use."""
        for one in (*self.messages, *self.samples):
            for values in one.fields.values():
                for value in values:
                    yield from value.sources

    @property
    def sampled(self) -> frozenset[str]:
        """The topics of the samples, and those with the number of their filter."""
        used = {
            source.topic
            for row in self.samples
            for values in row.fields.values()
            for value in values
            for source in value.sources
        }
        return frozenset(
            used
            | {self.primary_fields[one].partition(".")[0] for one in used & {*self.primary_fields}}
        )

    @property
    def columns(self) -> dict[str, set[str]]:
        """Columns in use by topic."""
        found: dict[str, set[str]] = {}
        for source in self.sources:
            found.setdefault(source.topic, set()).add(source.name)
        for where in self.primary_fields.values():
            topic, _, name = where.partition(".")
            found.setdefault(topic, set()).add(name)
        return found

    def bind(self, row: MessageRow, name: str, log: LogFacts) -> BoundMessage:
        """Bind a message to a log, under a name for an instance."""
        definition: Any = DEFINITIONS[MESSAGE_IDS[name]]
        lengths = dict(zip(definition.ordered_fieldnames, definition.array_lengths, strict=True))
        types = dict(zip(definition.fieldnames, definition.fieldtypes, strict=True))
        reads: list[tuple[bool, tuple[Read, ...]]] = []
        timed: list[tuple[int, str, int]] = []
        for one in definition.fieldnames:
            unit = definition.fieldunits_by_name.get(one, "")
            factor = UNITS[unit][1] if unit in UNITS else 1.0
            if one in TIMES and one not in row.fields:
                timed.append((len(reads), one, UINT32 if types[one] == "uint32_t" else UINT64))
            for number in range(lengths[one] or 1):
                given = row.fields.get(f"{one}.{number}", ()) + row.fields.get(one, ())
                reads.append((types[one] != "float", _bound(given, log, factor)))
        return BoundMessage(name, MessagePacker(definition), tuple(reads), tuple(timed))


def bind_columns(
    row: MessageRow, columns: Sequence[str], log: LogFacts
) -> dict[str, tuple[Read, ...]]:
    """Bind a sample to a log: the readers of each of its columns."""
    return {
        name: _bound(row.fields[name], log, UNITS[unit][1] if unit else 1.0)
        for name in columns
        for unit in (unit_of(name),)
        if name in row.fields
    }


def _bound(given: Sequence[Value], log: LogFacts, factor: float) -> tuple[Read, ...]:
    return tuple(read for value in given if (read := value.bind(log, factor)))


@cache
def table_of(name: str) -> MessageTable:
    """Read the table of a format; raises ValueError if it has an error."""
    raw = msgspec.toml.decode((files("gateway.recordings.formats") / f"{name}.toml").read_bytes())
    messages, samples = (
        tuple(_message(name, dict(row)) for name, row in raw[section].items())
        for section in ("messages", "samples")
    )
    aliases = {old: (topic, int(n)) for old, (topic, n) in raw.get("aliases", {}).items()}
    primary_fields = {
        topic: where for where, topics in raw.get("primary_fields", {}).items() for topic in topics
    }
    return MessageTable(
        messages, samples, aliases, primary_fields, raw.get("health", {}),
        frozenset(raw.get("also_used", ())), raw.get("modes", {}), raw.get("vehicle_types", {}),
        {state: tuple(given) for state, given in raw.get("nav_states", {}).items()},
    )  # fmt: skip


def _message(name: str, row: dict[str, Any]) -> MessageRow:
    of, each, every_s = row.pop("of", []), row.pop("each", None), row.pop("every_s", None)
    fields = {}
    for key, given in row.items():
        parts = given if isinstance(given, list) else [given]
        fields[key] = tuple(map(Value.parse, parts))
    of = [of] if isinstance(of, str) else of
    return MessageRow(name, tuple(of), None if each is None else tuple(each), every_s, fields)
