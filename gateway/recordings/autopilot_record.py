"""Convert an autopilot's own log, DataFlash or ULog, to the MAVLink of its vehicle.

Rows of the log produce the messages of the message table; HEARTBEAT, SYS_STATUS, HOME_POSITION and
SYSTEM_TIME are repeated. Modes, parameters and missions come first, as if a station had requested
them.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.message_table import (
    MAX_AGE_US,
    BoundMessage,
    MessageRow,
    MessageTable,
    Values,
)
from gateway.recordings.recorded_clock import Stamper
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle.encoding import Encoder
from gateway.vehicle.plan import MISSION, Item, write_item
from gateway.vehicle_state.senders import FIRST_GROUND_STATION
from gateway.wire.recorded_frames import RecordedFrame

UINT32: Final = 0xFFFFFFFF
BEAT_US: Final = US_PER_S
TEXT_BYTES: Final = 50
LASTING: Final = frozenset({"HOME", "home_position"})
"""Topics whose newest row stays valid until the next one."""
MAX_NAMES: Final = 1 << 14
"""Maximum number of parameters, and of items of a mission, that are stored."""


@dataclass(frozen=True, slots=True)
class LogRow:
    """One row of a log, or a change of the vehicle's state."""

    time_us: int
    """Time since the start of the log."""
    own_us: int
    """Time on the autopilot's clock."""
    topic: str
    instance: int
    values: Values


@dataclass(frozen=True, slots=True)
class Armed:
    """The vehicle was armed or disarmed."""

    is_armed: bool


@dataclass(frozen=True, slots=True)
class Mode:
    """The vehicle changed its mode."""

    custom_mode: int


@dataclass(frozen=True, slots=True)
class Text:
    """A text of the autopilot."""

    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class LoggedParameter:
    """A parameter and its value, a float or a 32-bit integer."""

    name: str
    value: float | int


@dataclass(frozen=True, slots=True)
class LoggedItem:
    """An item of a mission, a fence, or rally points."""

    seq: int
    count: int
    item: Item
    kind: int = MISSION


@dataclass(frozen=True, slots=True)
class Current:
    """The current mission item has changed."""

    seq: int


Event = Armed | Mode | Text | LoggedParameter | LoggedItem | Current
Entry = LogRow | tuple[int, Event]
"""A row, or an event with its time since the start of the log."""


@dataclass(slots=True)
class AutopilotLog:
    """An autopilot's log, opened for reading."""

    table: MessageTable
    entries: Iterator[Entry]
    """Rows and events in the order of time."""
    vehicle_id: int
    autopilot: int
    """A MAV_AUTOPILOT."""
    mav_type: int
    kind: str
    present: frozenset[str]
    """Topics with rows, by their names in the message table."""
    counts: Mapping[str, int]
    """Number of rows by the log's own topic names."""
    unix_us_at_zero: int | None = None
    units: Mapping[tuple[str, str], str] = field(default_factory=dict)
    """Units that the log itself states, by topic and field."""
    primary: Mapping[str, int] = field(default_factory=dict)
    """Instance to use, by topic, where it is not the first."""
    parameters: Mapping[str, float | int] = field(default_factory=dict)
    """Values at the start of the log."""
    defaults: Mapping[str, float] = field(default_factory=dict)
    """Default values of the firmware, if the log contains them."""
    modes: Mapping[int, str] = field(default_factory=dict)
    """Names of the custom modes by number."""
    plans: Mapping[int, tuple[LoggedItem, ...]] = field(default_factory=dict)
    """The mission, fence and rally points at the start of the log, by kind."""
    is_armed: bool = False
    """Whether it was armed at the start of the log."""
    custom_mode: int = 0
    remarks: list[str] = field(default_factory=list)
    """Remarks for the user; complete once all entries are read."""
    why_no_samples: str = ""
    """Reason for the user why no samples of the IMU are found."""

    def unit(self, topic: str, name: str) -> str | None:
        """Return the unit that the log itself states; None if it states none."""
        return self.units.get((topic, name))

    @property
    def beside_id(self) -> int:
        """System id of a second vehicle, which has the states of mavgate."""
        return self.vehicle_id % (FIRST_GROUND_STATION - 1) + 1

    @property
    def is_shown(self) -> bool:
        """Whether there is a row of an attitude, a position or the IMU."""
        return any(topic in self.present for row in self.table.samples for topic in row.of)

    @property
    def lacks(self) -> str:
        """Text for the user on the topics without a counterpart in MAVLink; empty if none."""
        used, counts = self.table.topics, sorted(self.counts.items())
        listed = ", ".join(f"{name} {n}" for name, n in counts if n and name not in used)
        return listed and f"messages without a counterpart in MAVLink: {listed}"


def system_id_of(value: float | None) -> int:
    """Return the system id in a parameter; 1 if it is not valid."""
    return int(value) if value is not None and 1 <= value <= 255 else 1


class NewestRows:
    """The newest rows of a log, and the instance to read them from."""

    def __init__(self, log: AutopilotLog, max_age_us: int = MAX_AGE_US) -> None:
        self.now_us = 0
        self.instance: int | None = None
        """Instance to read; None for the primary one of each topic."""
        self.parameters = dict(log.parameters)
        self._max_age_us, self._health = max_age_us, log.table.health
        self._rows: dict[tuple[str, int], LogRow] = {}
        self._firsts, self._primary = dict(log.primary), dict(log.primary)
        self._primary_fields: dict[str, list[tuple[str, str]]] = {}
        """Topics of several filters by the topic with the number of the filter, and its column."""
        for topic, where in log.table.primary_fields.items():
            name, _, column = where.partition(".")
            self._primary_fields.setdefault(name, []).append((topic, column))

    def add(self, row: LogRow) -> None:
        """Add the next row."""
        topic, instance = row.topic, row.instance
        self.now_us = row.time_us
        self._rows[topic, instance] = row
        if topic not in self._firsts:
            self._firsts[topic] = instance
            self._primary.setdefault(topic, instance)
        for of, column in (
            self._primary_fields.get(topic, ()) if instance == self._firsts[topic] else ()
        ):
            if isinstance(number := row.values.get(column), int):
                self._primary[of] = number

    def has(self, topic: str) -> bool:
        """Return whether there was a row of a topic."""
        return any(name == topic for name, _ in self._rows)

    def primary(self, topic: str) -> int:
        """Return the primary instance of a topic."""
        return self._primary.get(topic, 0)

    def value(self, topic: str, name: str) -> float:
        """Return a field of the newest row; see `ValueOf`."""
        instance = self.instance
        if instance is None:
            instance = self._primary.get(topic, 0)
        row = self._rows.get((topic, instance))
        if row is None or name == "instance":
            return self._other(topic, name, instance)
        if self.now_us - row.time_us > self._max_age_us and topic not in LASTING:
            return NAN
        value = row.values.get(name, NAN)
        return value if isinstance(value, (int, float)) else NAN

    def _other(self, topic: str, name: str, instance: int) -> float:
        """Return a parameter, the bits of the sensors, or the instance."""
        if topic == "PARM":
            number = self.instance or 0
            found = self.parameters.get(name.replace("#", str(number + 1) if number else ""), NAN)
            return float(found)
        if topic == "SENSORS":
            return float(self._sensors(only_healthy=name == "healthy"))
        return float(instance) if name == "instance" else NAN

    def _sensors(self, *, only_healthy: bool) -> int:
        bits = 0
        for (topic, _), row in self._rows.items():
            if not only_healthy or self.now_us - row.time_us <= self._max_age_us:
                bits |= self._health.get(topic, 0)
        return bits


class RecordTranslator:
    """Turn the entries of a log into the frames of its vehicle."""

    def __init__(self, log: AutopilotLog, system_id: int | None = None) -> None:
        self._log = log
        self._encoder = Encoder(system_id or log.vehicle_id)
        self._newest = NewestRows(log)
        self._bound: dict[tuple[str, int], BoundMessage] = {}
        self._by_topic: dict[str, list[MessageRow]] = {}
        self._repeated: list[tuple[MessageRow, BoundMessage]] = []
        for row in log.table.messages:
            first = next((topic for topic in row.of if topic in log.present), None)
            if row.every_s is not None:
                if not row.of or first is not None:
                    bound = log.table.bind(row, row.name, log)
                    self._repeated.append((row, bound))
            elif first is not None:
                self._by_topic.setdefault(first, []).append(row)
        self._due_us = dict.fromkeys(range(len(self._repeated)), 0)
        self._beat_us: int | None = None
        self._own_us = 0
        self._is_armed, self._mode = log.is_armed, log.custom_mode
        self._plans = {kind: {one.seq: one for one in plan} for kind, plan in log.plans.items()}
        self._numbers: dict[str, int] = {name: n for n, name in enumerate(log.parameters)}
        self._texts = 0

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user on the log, as far as it was read."""
        return self._log.remarks

    def introduction(self) -> Iterator[bytes]:
        """Yield the frames with modes, parameters and plans at the start of the log."""
        encoder = Encoder(self._encoder.system_id)
        return (encoder.encode(message).frame for message in self._introduction())

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield the frames at civil times, or at times since the start of the log."""
        stamper = Stamper(self._log.unix_us_at_zero or 0)
        entries = self._log.entries
        first = next(entries, None)
        if first is None:
            return
        begin_us = first.time_us if isinstance(first, LogRow) else first[0]
        for message in self._introduction():
            yield RecordedFrame(stamper.stamp(begin_us), self._encoder.encode(message).frame)
        for entry in chain([first], entries):
            time_us = entry.time_us if isinstance(entry, LogRow) else entry[0]
            for message in self._messages(entry, time_us):
                yield RecordedFrame(stamper.stamp(time_us), self._encoder.encode(message).frame)

    def _messages(self, entry: Entry, time_us: int) -> Iterator[Any]:
        if not isinstance(entry, LogRow):
            yield from self._event(entry[1])
            return
        self._own_us = entry.own_us
        self._newest.add(entry)
        yield from self._repeat(time_us)
        for row in self._by_topic.get(entry.topic, ()):
            bound = self._bound_for(row, entry)
            if bound is not None:
                self._newest.instance = entry.instance if row.each is not None else None
                yield self._packed(bound)
        self._newest.instance = None

    def _bound_for(self, row: MessageRow, entry: LogRow) -> BoundMessage | None:
        """Return the message for a row; None if the row is not of the primary instance."""
        name = row.name
        if row.each is None and entry.instance != self._newest.primary(entry.topic):
            return None
        if row.each:
            if not 0 <= entry.instance < len(row.each):
                return None
            name = row.each[entry.instance]
        key = (row.name, entry.instance)
        if key not in self._bound:
            self._bound[key] = self._log.table.bind(row, name, self._log)
        return self._bound[key]

    def _packed(self, bound: BoundMessage) -> Any:
        times = {"time_boot_ms": self._own_us // 1000, "time_usec": self._own_us}
        return bound.packer(*bound.values(self._newest.value, times))

    def _repeat(self, time_us: int) -> Iterator[Any]:
        """Yield the messages that are due at intervals; a gap in the log is not filled."""
        if self._beat_us is None or time_us >= self._beat_us:
            yield self._heartbeat()
            yield self._system_time(time_us)
            before_us = time_us if self._beat_us is None else self._beat_us
            self._beat_us = max(before_us + BEAT_US, time_us)
        for number, (row, bound) in enumerate(self._repeated):
            is_known = not row.of or any(map(self._newest.has, row.of))
            if time_us < self._due_us[number] or not is_known:
                continue
            interval_us = round((row.every_s or 1.0) * US_PER_S)
            self._due_us[number] = max(self._due_us[number] + interval_us, time_us)
            yield self._packed(bound)

    def _event(self, event: Event) -> Iterator[Any]:
        match event:
            case Armed():
                if event.is_armed != self._is_armed:
                    self._is_armed = event.is_armed
                    yield self._heartbeat()
            case Mode():
                if event.custom_mode != self._mode:
                    self._mode = event.custom_mode
                    yield self._heartbeat()
                    yield mavlink.MAVLink_current_mode_message(0, self._mode, 0)
            case Text():
                yield from self._text(event)
            case LoggedParameter():
                yield from self._change(event)
            case LoggedItem():
                yield from self._item(event)
            case Current():
                total = len(self._plans.get(MISSION, ())) or 0xFFFF
                yield mavlink.MAVLink_mission_current_message(event.seq, total)

    def _change(self, event: LoggedParameter) -> Iterator[Any]:
        if self._newest.parameters.get(event.name) == event.value:
            return
        self._newest.parameters[event.name] = event.value
        if len(self._numbers) < MAX_NAMES:
            self._numbers.setdefault(event.name, len(self._numbers))
        yield self._parameter(event.name, event.value)

    def _heartbeat(self) -> Any:
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self._is_armed else 0
        state = mavlink.MAV_STATE_ACTIVE if self._is_armed else mavlink.MAV_STATE_STANDBY
        custom = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        return mavlink.MAVLink_heartbeat_message(
            self._log.mav_type, self._log.autopilot, custom | armed, self._mode, state, 3
        )

    def _system_time(self, time_us: int) -> Any:
        zero_us = self._log.unix_us_at_zero
        unix_us = 0 if zero_us is None else zero_us + time_us
        return mavlink.MAVLink_system_time_message(unix_us, self._own_us // 1000 & UINT32)

    def _introduction(self) -> Iterator[Any]:
        yield self._heartbeat()
        names = self._log.modes
        for number, (mode, name) in enumerate(names.items(), 1):
            yield mavlink.MAVLink_available_modes_message(
                len(names), number, 0, mode, 0, name.encode()
            )
        for name, value in self._log.parameters.items():
            yield self._parameter(name, value)
        for kind in self._log.plans:
            yield from self._whole_plan(kind)

    def _parameter(self, name: str, value: float) -> Any:
        """Encode a parameter; an integer as its bytes, as PX4 does."""
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int):
            kind = mavlink.MAV_PARAM_TYPE_INT32
            value = struct.unpack("<f", struct.pack("<i", value))[0]
        return mavlink.MAVLink_param_value_message(
            name.encode()[:16], value, kind, len(self._numbers), self._numbers.get(name, 0xFFFF)
        )

    def _text(self, event: Text) -> Iterator[Any]:
        """Encode a text, in chunks if it is long."""
        data = event.text.encode()
        pieces = [data[at : at + TEXT_BYTES] for at in range(0, len(data), TEXT_BYTES)]
        if len(pieces) <= 1:
            yield mavlink.MAVLink_statustext_message(event.severity, data)
            return
        self._texts = self._texts % 0xFFFF + 1
        # If the last chunk is full, an empty one marks the end of the text.
        ended = [*pieces, b""] if len(pieces[-1]) == TEXT_BYTES else pieces
        for number, piece in enumerate(ended):
            yield mavlink.MAVLink_statustext_message(event.severity, piece, self._texts, number)

    def _item(self, event: LoggedItem) -> Iterator[Any]:
        """Add an item to a new or existing plan; yield the plan once it is complete."""
        known = self._plans.setdefault(event.kind, {})
        if known.get(event.seq) == event:
            return
        if event.seq == 0 or any(one.count != event.count for one in known.values()):
            known.clear()
        if len(known) < MAX_NAMES:
            known[event.seq] = event
        if event.count and all(seq in known for seq in range(event.count)):
            self._plans[event.kind] = {seq: known[seq] for seq in range(event.count)}
            yield from self._whole_plan(event.kind)

    def _whole_plan(self, kind: int) -> Iterator[Any]:
        plan = self._plans[kind]
        yield mavlink.MAVLink_mission_count_message(0, 0, len(plan), kind)
        for one in plan.values():
            yield write_item(one.item, one.seq, kind, (0, 0), is_current=False)
