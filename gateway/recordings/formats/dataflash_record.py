"""Read a DataFlash log as an autopilot's log: rows and events for `dataflash.toml`."""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

from pymavlink.DFReader import DFReader_text
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.autopilot_record import (
    Armed,
    AutopilotLog,
    Current,
    Entry,
    Event,
    LoggedItem,
    LoggedParameter,
    LogRow,
    Mode,
    Text,
)
from gateway.recordings.files import FlightError
from gateway.recordings.formats.dataflash import (
    LogClock,
    Message,
    PrintedDamage,
    each_of,
    instance_of,
    items_of,
    kind_of,
    open_log,
    own_us_of,
    remarks_of,
    sensors_of,
    system_id_of,
    table,
    unix_us_at,
)
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.workshop.extracts import CIRCLES
from gateway.records import NAN
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.vehicle.encoding import int32
from gateway.vehicle.plan import FENCE, MISSION, RALLY, Item

ARMED, DISARMED = 10, 11
"""Event ids in EV."""
ORIGIN, HOME = 0, 1
"""Types of origin in ORGN."""
PLANS: Final = {"CMD": MISSION, "FNCE": FENCE, "RALY": RALLY}
"""Messages with items of plans."""
EVENTS: Final = frozenset({"PARM", "MODE", "ARM", "EV", "STAT", "MSG", *PLANS})
"""Messages that are read for the state at the start of a log."""
EARLY_US: Final = US_PER_S
"""A mode or armed state logged this early is taken as valid from the start of the log."""
GLOBAL_RELATIVE: Final = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
FENCE_COMMANDS: Final = {
    92: mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION,
    93: mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION,
    95: mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT,
    97: mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
    98: mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
}
"""MAVLink command of a fence item, by its type in FNCE."""
RALLY_HAS_FRAME: Final = 4
"""Bit of the flags in RALY; if it is set, the next two bits contain the frame."""
RALLY_FRAMES: Final = {
    0: mavlink.MAV_FRAME_GLOBAL,
    1: GLOBAL_RELATIVE,
    3: mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT,
}
TITLE_BYTES: Final = 1 << 16
"""Bytes at the begin of a text log that are searched for the title line."""
_NOT_IN_WORDS: Final = re.compile(r"[^0-9A-Za-z]")
_FORMER_NAMES: Final = {
    "FLYBYWIREA": "FBWA",
    "FLYBYWIREB": "FBWB",
    "HYBRID": "POSHOLD",
    "STEARING": "STEERING",
}
"""Other names of modes, and the names in the table of modes."""
_FIRMWARE: Final = re.compile(r"(Copter|Plane|Rover|Sub|Blimp|Tracker)\s*V\d", re.IGNORECASE)
_FRAME_TYPES: Final = {
    1: mavlink.MAV_TYPE_QUADROTOR, 2: mavlink.MAV_TYPE_HEXAROTOR, 3: mavlink.MAV_TYPE_OCTOROTOR,
    4: mavlink.MAV_TYPE_OCTOROTOR, 5: mavlink.MAV_TYPE_HEXAROTOR, 6: mavlink.MAV_TYPE_HELICOPTER,
    7: mavlink.MAV_TYPE_TRICOPTER, 8: mavlink.MAV_TYPE_COAXIAL, 9: mavlink.MAV_TYPE_COAXIAL,
    11: mavlink.MAV_TYPE_HELICOPTER, 12: mavlink.MAV_TYPE_DODECAROTOR,
    13: mavlink.MAV_TYPE_HELICOPTER,
}  # fmt: skip
"""MAV_TYPE of a copter, by FRAME_CLASS."""
_SECOND: Final = 2
"""Value of AHRS_EKF_TYPE that selects the second Kalman filter (NKF)."""
_BOAT: Final = 2
"""Value of FRAME_CLASS for a boat."""


def topic_of(known: Any) -> tuple[str, int]:
    """Return topic and instance of a format; CURR in volts and amperes is a former name of BAT."""
    topic, instance = table().aliases.get(known.name, (known.name, 0))
    if topic == "CURR" and "Volt" in known.columns:
        is_scaled = known.format[known.columns.index("Volt")] != "f"
        topic = topic if is_scaled else "BAT"
    return topic, instance


class RowReader:
    """Convert the messages of a log to rows and events."""

    def __init__(self, unused: frozenset[str], modes: Mapping[str, int]) -> None:
        self.clock: LogClock[tuple[str, Message]] = LogClock()
        self._columns: dict[str, set[str]] = {}
        self._own_us = 0
        self._unused = unused
        self._modes = modes
        for source in table().sources:
            self._columns.setdefault(source.topic, set()).add(source.name)
        for where in table().lanes.values():
            topic, _, name = where.partition(".")
            self._columns.setdefault(topic, set()).add(name)
        self._items: dict[int, LoggedItem] = {}
        self.names = {*table().topics, *table().aliases, "ORGN"}
        """Names of the messages that are read."""

    def feed(self, name: str, message: Message) -> list[Entry]:
        """Process the next message."""
        timed = own_us_of(name, message) if _has_time(name, message) else None
        return [
            entry
            for time_us, (kind, one) in self.clock.feed(timed, (name, message))
            for entry in self._entries(time_us, kind, one)
        ]

    def flush(self) -> list[Entry]:
        """Return the entries that are still held at the end of the log."""
        held = self.clock.flush()
        return [entry for time_us, one in held for entry in self._entries(time_us, *one)]

    def _entries(self, time_us: int, name: str, message: Message) -> Iterator[Entry]:
        if _has_time(name, message):
            self._own_us = own_us_of(name, message)
        if (event := self._event(name, message)) is not None:
            yield time_us, event
            if not isinstance(event, LoggedItem):
                return
        if name == "GPS":
            self.clock.utc_us(message)
        topic = topic_of(message.fmt)[0]
        if name == "ORGN":
            topic = "HOME" if message.Type == HOME else name
        if name == "CMD" and message.CNum == 0 and message.Lat:
            topic = "HOME"
        wanted = self._columns.get(topic)
        if wanted and topic not in self._unused:
            values = {key: getattr(message, key) for key in message.fmt.columns if key in wanted}
            yield LogRow(time_us, self._own_us, topic, instance_of(name, message), values)

    def _event(self, name: str, m: Message) -> Event | None:
        match name:
            case "PARM":
                return LoggedParameter(str(m.Name), float(m.Value))
            case "MODE":
                mode = _mode_of(m, self._modes)
                return None if mode is None else Mode(mode)
            case "ARM":
                return Armed(bool(m.ArmState))
            case "EV" if m.Id in (ARMED, DISARMED):
                return Armed(m.Id == ARMED)
            case "STAT" if "Armed" in m.fmt.columns:
                return Armed(bool(m.Armed))
            case "MSG":
                return Text(mavlink.MAV_SEVERITY_INFO, str(m.Message))
            case "ERR":
                why = f"Error of subsystem {m.Subsys}: code {m.ECode}"
                return Text(mavlink.MAV_SEVERITY_WARNING, why)
            case "CMD" | "FNCE" | "RALY":
                return self._item(name, m)
            case "MISE":
                return Current(int(m.CNum))
        return None

    def _item(self, name: str, m: Message) -> Event:
        """Return an item; one that is in the mission already is logged because it is executed."""
        item = _item_of(name, m)
        if item.kind != MISSION:
            return item
        if self._items.get(item.seq) == item and len(self._items) == item.count:
            return Current(item.seq)
        if len(self._items) >= item.count:
            self._items = {}
        self._items[item.seq] = item
        return item


def _has_time(name: str, message: Message) -> bool:
    columns = message.fmt.columns
    return "TimeUS" in columns or "TimeMS" in columns or (kind_of(name) == "GPS" and "T" in columns)


def _mode_of(m: Message, modes: Mapping[str, int]) -> int | None:
    """Return the number of a mode, which a text log may give by name; None if it is unknown."""
    for name in ("ModeNum", "Mode"):
        value = getattr(m, name, None)
        if isinstance(value, int):
            return value
        if isinstance(value, str):
            plain = _NOT_IN_WORDS.sub("", value).upper()
            digits = plain.removeprefix("MODE")
            if digits.isdigit():
                return int(digits)
            if plain in modes:
                return modes[plain]
    return None


def _firmware_of(log: Any, damage: PrintedDamage) -> str:
    """Return the firmware of a log, such as copter; empty if it is unknown.

    It is named in a text, in the title line of a text log, or follows from the names of the modes.
    """
    texts = [str(message.Message) for message in each_of(log, damage, {"MSG"})]
    if isinstance(log, DFReader_text):
        texts.append(bytes(log.data_map[:TITLE_BYTES]).decode("ascii", "replace"))
    named = next((found[1].lower() for text in texts if (found := _FIRMWARE.search(text))), "")
    if named or not isinstance(log, DFReader_text):
        return named
    modes = (getattr(message, "Mode", 0) for message in each_of(log, damage, {"MODE"}))
    words = {_NOT_IN_WORDS.sub("", mode).upper() for mode in modes if isinstance(mode, str)}
    words = {word for word in words if not word.removeprefix("MODE").isdigit()}
    fitting = [kind for kind in table().modes if words and words <= _modes_of(kind).keys()]
    return fitting[0] if len(fitting) == 1 else ""


def _modes_of(firmware: str) -> dict[str, int]:
    """Return the numbers of a firmware's modes by name, in upper case without other characters."""
    known = table().modes.get(firmware, {})
    found = {_NOT_IN_WORDS.sub("", name): int(mode) for mode, name in known.items()}
    return found | {old: found[new] for old, new in _FORMER_NAMES.items() if new in found}


def _item_of(name: str, m: Message) -> LoggedItem:
    """Return an item of a mission, fence, or rally points."""

    def get(name: str) -> float:
        # Always the same NaN object, so that equal items compare equal.
        value = float(getattr(m, name, 0.0))
        return NAN if math.isnan(value) else value

    first, frame = get("Prm1"), int(getattr(m, "Frame", GLOBAL_RELATIVE))
    if name == "FNCE":
        command = FENCE_COMMANDS.get(m.Type, 0)
        first = get("Radius") if command in CIRCLES else get("Count")
        frame = mavlink.MAV_FRAME_GLOBAL
    elif name == "RALY":
        command, flags = mavlink.MAV_CMD_NAV_RALLY_POINT, int(getattr(m, "Flags", 0))
        frame = RALLY_FRAMES.get(flags >> 3 & 3, frame) if flags & RALLY_HAS_FRAME else frame
    else:
        command = int(m.CId)
    item = Item(
        frame, command, 1, (first, get("Prm2"), get("Prm3"), get("Prm4")),
        int32(get("Lat") * DEGE7_PER_DEG), int32(get("Lng") * DEGE7_PER_DEG), get("Alt"),
    )  # fmt: skip
    seq, count = (m.CNum, m.CTot) if name == "CMD" else (m.Seq, m.Tot)
    return LoggedItem(int(seq), int(count), item, PLANS[name])


def open_record(path: Path, options: ReadOptions) -> AutopilotLog:
    """Open a DataFlash log as the record of its autopilot; raises FlightError if it is empty."""
    damage = PrintedDamage()
    log = open_log(path, options, damage)
    counts = _counts_of(log)
    present = {topic_of(known)[0] for known in log.formats.values() if counts.get(known.name)}
    unused = _other_filter(log, present)
    found = AutopilotLog(
        table=table(),
        entries=iter(()),
        vehicle_id=options.system_id or system_id_of(log.params),
        autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mav_type=mavlink.MAV_TYPE_GENERIC,
        kind=_firmware_of(log, damage),
        present=frozenset(present - unused | {"PARM", "SENSORS", "HOME"}),
        counts=counts,
        units=_units_of(log),
        primary=sensors_of(log, damage) | dict(options.sensors),
        defaults=dict(getattr(log, "param_defaults", {})),
    )
    modes = _modes_of(found.kind)
    _set_begin(path, found, _begin_of(log, damage, modes))
    reader = RowReader(frozenset(unused), modes)

    # Not `found` itself: the reference cycle would keep the log open.
    remarks = found.remarks

    def entries() -> Iterator[Entry]:
        with contextlib.closing(log):
            yield from items_of(log, damage, reader)
            remarks.extend(f"{path}: {text}" for text in remarks_of(log, damage, reader.clock))

    stream = entries()
    head: list[Entry] = []
    while not (head and isinstance(head[-1], LogRow)) and (entry := next(stream, None)):
        head.append(entry)
    if not head or not present & {"ATT", "IMU", "POS", "GPS"}:
        raise FlightError(f"{path}: has no ATT, POS, GPS or IMU, so there is nothing to play")
    found.unix_us_at_zero = unix_us_at(log, reader.clock.zero_us or 0)
    found.entries = chain(head, stream)
    return found


def _counts_of(log: Any) -> dict[str, int]:
    if isinstance(log, DFReader_text):
        return {name: n for name, n in log.counts.items() if name in log.formats}
    return {name: log.counts[kind] for name, kind in log.name_to_id.items()}


def _units_of(log: Any) -> dict[tuple[str, str], str]:
    """Return the units that FMTU states, by topic and field."""
    found = {}
    for known in log.formats.values():
        topic = topic_of(known)[0]
        for name, unit in zip(known.columns, known.units or (), strict=False):
            if unit:
                found[topic, name] = unit
    return found


def _other_filter(log: Any, present: set[str]) -> set[str]:
    """Return the topics of the Kalman filter that runs in addition to the one in use."""
    second = {name for name in present if name.startswith("NKF")}
    third = {name for name in present if name.startswith("XKF")}
    if not second or not third:
        return set()
    return third if log.params.get("AHRS_EKF_TYPE") == _SECOND else second


def _begin_of(log: Any, damage: PrintedDamage, modes: Mapping[str, int]) -> list[tuple[int, Event]]:
    """Read the events of a log up to the first damage, and rewind the log."""
    reader, entries = RowReader(frozenset(table().topics), modes), []
    for message in each_of(log, damage, set(EVENTS)):
        entries += reader.feed(message.get_type(), message)
    entries += reader.flush()
    return [entry for entry in entries if not isinstance(entry, LogRow)]


def _set_begin(path: Path, found: AutopilotLog, entries: list[tuple[int, Event]]) -> None:
    """Set parameters, mission, type and state at the start of a log."""
    begin_us = entries[0][0] if entries else 0
    early_us = begin_us + EARLY_US
    parameters: dict[str, float | int] = {}
    items: dict[tuple[int, int], dict[int, LoggedItem]] = {}
    for _, event in entries:
        if isinstance(event, LoggedParameter):
            parameters.setdefault(event.name, event.value)
        elif isinstance(event, LoggedItem):
            items.setdefault((event.kind, event.count), {}).setdefault(event.seq, event)
    found.parameters = parameters
    plans: dict[int, tuple[LoggedItem, ...]] = {}
    for (kind, count), known in items.items():
        if len(known) == count:
            plans.setdefault(kind, tuple(known[seq] for seq in sorted(known)))
    found.plans = plans
    modes = [event for time_us, event in entries if isinstance(event, Mode) and time_us <= early_us]
    found.custom_mode = modes[0].custom_mode if modes else 0
    armed = [(time_us, event) for time_us, event in entries if isinstance(event, Armed)]
    if armed:
        found.is_armed = armed[0][1].is_armed == (armed[0][0] <= early_us)
    else:
        found.is_armed = True
        found.remarks.append(
            f"{path}: does not state whether it was armed; assumed armed throughout"
        )
    _set_type(found)


def _set_type(found: AutopilotLog) -> None:
    firmware, frame = found.kind, int(found.parameters.get("FRAME_CLASS", 0))
    kind = table().vehicle_types.get(firmware, mavlink.MAV_TYPE_GENERIC)
    if firmware == "copter":
        kind = _FRAME_TYPES.get(frame, kind)
    elif firmware == "rover" and frame == _BOAT:
        kind = mavlink.MAV_TYPE_SURFACE_BOAT
    found.mav_type = kind
    found.modes = {int(mode): name for mode, name in table().modes.get(firmware, {}).items()}
