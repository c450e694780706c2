"""Read a DataFlash log as an autopilot's log: rows and events for `dataflash.toml`.

All is in body FRD and NED. Of several sensors of a kind one is used. Firmware before 3.3 counts
milliseconds (TimeMS; T in GPS) and names the second sensor IMU2, GPS2 and so on.
"""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Set
from datetime import UTC, datetime
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.gps_time import GPS_EPOCH_UNIX_US, LEAPS_KNOWN_UNTIL_US, WEEK_US, unix_us_of_gps
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
from gateway.recordings.formats.dataflash import DataFlash, Message
from gateway.recordings.message_table import table_of
from gateway.recordings.recorded_clock import LogClock
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.workshop.extracts import CIRCLES
from gateway.records import NAN
from gateway.units import DEGE7_PER_DEG, FIX_2D, US_PER_S, counted
from gateway.vehicle.encoding import int32
from gateway.vehicle.plan import FENCE, MISSION, RALLY, Item

table: Final = partial(table_of, "dataflash")
TIME_COLUMNS: Final = frozenset({"TimeUS", "TimeMS"})
INSTANCES: Final = frozenset({"I", "C", "Instance", "Inst", "IMU"})
"""Columns with the number of a sensor, filter or battery."""
SENSORS: Final = {
    "IMU": ("AccX", "AccY", "AccZ"),
    "MAG": ("MagX", "MagY", "MagZ"),
    "BARO": ("Press",),
    "GPS": ("Status",),
}
"""Kinds of sensor with several instances; value: columns that are not all zero if it has data."""
IMU_COLUMNS: Final = frozenset({*SENSORS["IMU"], "GyrX", "GyrY", "GyrZ"})
ROLLOVER_US: Final = 1024 * WEEK_US
FIRST_LOG_US: Final = 1_262_304_000 * US_PER_S - GPS_EPOCH_UNIX_US
"""The year 2010, as GPS time: the format is not older, so a receiver with an earlier date has a
wrong week number, which restarts every 1024 weeks."""
MAX_LOOKED_AT: Final = 20_000
"""Messages of a kind that are searched for the first sensor with data: an hour of GPS."""
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


def _in_era(gps_us: int) -> int:
    """Add the multiple of 1024 weeks that a GPS receiver lacks."""
    lost = -(-(FIRST_LOG_US - gps_us) // ROLLOVER_US) if gps_us < FIRST_LOG_US else 0
    return gps_us + lost * ROLLOVER_US


class _Kind:
    """The messages of one name: their topic, their columns that are used, and their time."""

    def __init__(self, form: Any) -> None:
        self.topic, self._instance = table().aliases.get(form.name, (form.name, 0))
        if self.topic == "CURR" and "Volt" in form.columns:
            # In volts and amperes it is a former name of BAT.
            is_scaled = form.format[form.columns.index("Volt")] != "f"
            self.topic = self.topic if is_scaled else "BAT"
        columns = {*form.columns}
        self.numbers = [c for c in form.columns if c in INSTANCES or c == form.instance_field]
        self.time = next(
            (name for name in ("TimeUS", "T", "TimeMS") if name in columns
             and (name != "T" or self.topic == "GPS")),
            None,
        )  # fmt: skip
        self.units = {
            c: unit for c, unit in zip(form.columns, form.units or (), strict=False) if unit
        }

    def own_us(self, message: Message) -> int | None:
        """Return a message's time on the autopilot's clock; None if it has none."""
        if self.time is None:
            return None
        return int(getattr(message, self.time)) * (1 if self.time == "TimeUS" else 1000)

    def instance(self, message: Message) -> int:
        """Return the number of the sensor, filter or battery in a message, from 0."""
        found = (getattr(message, column) for column in self.numbers)
        number = next((value for value in found if isinstance(value, int)), 0)
        return number or self._instance


class RowReader:
    """Convert the messages of a log to rows and events."""

    def __init__(self, topics: frozenset[str], modes: Mapping[str, int] | None = None) -> None:
        self.clock: LogClock[tuple[str, Message]] = LogClock()
        self.is_rolled_over = False
        """Whether a receiver's week number has rolled over."""
        self.is_beyond_leaps = False
        """Whether a date is later than the time up to which leap seconds are known."""
        self._topics, self._modes = topics & table().columns.keys(), modes
        former = {old for old, (new, _) in table().aliases.items() if new in topics}
        self.names = {*topics, *former} | (set() if modes is None else {"ORGN"})
        """Names of the messages that are read."""
        self._kinds: dict[str, _Kind] = {}
        self._columns: dict[tuple[str, str], list[str]] = {}
        self._own_us = 0
        self._items: dict[int, LoggedItem] = {}

    def feed(self, name: str, message: Message) -> list[Entry]:
        """Process the next message."""
        timed = self._kind(name, message).own_us(message)
        return [
            entry
            for time_us, (kind, one) in self.clock.feed(timed, (name, message))
            for entry in self._entries(time_us, kind, one)
        ]

    def flush(self) -> list[Entry]:
        """Return the entries that are still held at the end of the log."""
        held = self.clock.flush()
        return [entry for time_us, one in held for entry in self._entries(time_us, *one)]

    def _kind(self, name: str, message: Message) -> _Kind:
        found = self._kinds.get(name)
        if found is None:
            found = self._kinds[name] = _Kind(message.fmt)
            wanted = table().columns
            for topic in {found.topic, "HOME", name}:
                names = wanted.get(topic, ())
                self._columns[name, topic] = [c for c in message.fmt.columns if c in names]
        return found

    def _entries(self, time_us: int, name: str, message: Message) -> Iterator[Entry]:
        kind = self._kind(name, message)
        own_us = kind.own_us(message)
        self._own_us = self._own_us if own_us is None else own_us
        if self._modes is not None and (event := self._event(name, message)) is not None:
            yield time_us, event
            if not isinstance(event, LoggedItem):
                return
        topic = kind.topic
        if (name == "ORGN" and message.Type == HOME) or (
            name == "CMD" and message.CNum == 0 and message.Lat
        ):
            topic = "HOME"
        if topic in self._topics:
            values = {column: getattr(message, column) for column in self._columns[name, topic]}
            if topic == "GPS":
                values |= self._times_of(message)
            yield LogRow(time_us, self._own_us, topic, kind.instance(message), values)

    def _times_of(self, fix: Message) -> dict[str, int]:
        """Return the time of week of a fix, and its civil time; firmware before 3.3 has TimeMS."""
        week = getattr(fix, "GWk", 0) or getattr(fix, "Week", 0)
        week_ms = getattr(fix, "GMS", getattr(fix, "TimeMS", None))
        if week_ms is None:
            return {}
        found = {"week_ms": int(week_ms)}
        if week and fix.Status >= FIX_2D:
            counted_us = week * WEEK_US + found["week_ms"] * 1000
            found["utc_us"] = unix_us_of_gps(_in_era(counted_us))
            self.is_rolled_over |= counted_us < FIRST_LOG_US
            self.is_beyond_leaps |= found["utc_us"] > LEAPS_KNOWN_UNTIL_US
        return found

    def remarks(self) -> Iterator[str]:
        """Yield remarks for the user on the times of a log that was read."""
        if self.clock.leaps:
            yield f"its clock jumped forward {counted(self.clock.leaps, 'time')}"
        if self.clock.restarts:
            restarts = counted(self.clock.restarts, "time")
            yield f"the autopilot restarted {restarts}; its times continue"
        if self.is_rolled_over:
            yield "its GPS receiver counts 1024 weeks too few; its dates are corrected"
        if self.is_beyond_leaps:
            known = datetime.fromtimestamp(LEAPS_KNOWN_UNTIL_US / US_PER_S, UTC)
            yield f"its dates assume no leap second since {known:%d %B %Y}"

    def _event(self, name: str, m: Message) -> Event | None:
        match name:
            case "PARM":
                return LoggedParameter(str(m.Name), float(m.Value))
            case "MODE":
                mode = _mode_of(m, self._modes or {})
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


def _firmware_of(log: DataFlash) -> str:
    """Return the firmware of a log, such as copter; empty if it is unknown.

    It is named in a text, in the title line of a text log, or follows from the names of the modes.
    """
    texts = [*(str(message.Message) for message in log.each_of({"MSG"})), log.title]
    named = next((found[1].lower() for text in texts if (found := _FIRMWARE.search(text))), "")
    if named or not log.is_text:
        return named
    modes = (getattr(message, "Mode", 0) for message in log.each_of({"MODE"}))
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


def open_record(path: Path, options: ReadOptions, *, sampled: bool = False) -> AutopilotLog:
    """Open a DataFlash log as the record of its autopilot, or only its samples."""
    log, known = DataFlash(path, options), table()
    forms = {form.name: _Kind(form) for form in log.log.formats.values()}
    counts = log.counts
    present = {
        kind.topic
        for name, kind in forms.items()
        if counts.get(name) and not _lacking(kind.topic, log.columns[name])
    }
    unused = _other_filter(log, present)
    chosen = _sensors_of(log) | dict(options.sensors)
    found = AutopilotLog(
        table=known,
        entries=iter(()),
        vehicle_id=options.system_id or log.system_id,
        autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mav_type=mavlink.MAV_TYPE_GENERIC,
        kind="" if sampled else _firmware_of(log),
        present=frozenset(present - unused | {"PARM", "SENSORS", "HOME"}),
        counts=counts,
        units={(k.topic, c): unit for k in forms.values() for c, unit in k.units.items()},
        primary=chosen | {"GPA": chosen["GPS"]},
        defaults=dict(getattr(log.log, "param_defaults", {})),
        remarks=[f"{path}: uses {kind} {n + 1}" for kind, n in chosen.items() if n],
    )
    modes = None if sampled else _modes_of(found.kind)
    if modes is not None:
        _set_begin(path, found, _begin_of(log, modes))
    topics = (known.sampled if sampled else known.topics) - unused
    _begin(path, found, log, RowReader(topics, modes))
    return found


def _begin(path: Path, found: AutopilotLog, log: DataFlash, reader: RowReader) -> None:
    """Begin to read the entries of a log, up to the first row."""
    # Not `found` itself: the reference cycle would keep the log open.
    remarks = found.remarks

    def entries() -> Iterator[Entry]:
        with contextlib.closing(log.log):
            yield from log.items_of(reader.names, reader.feed)
            yield from reader.flush()
            texts = [*log.damage(reader.clock.dropped), *reader.remarks()]
            remarks.extend(f"{path}: {text}" for text in texts)

    stream, head = entries(), list[Entry]()
    while not (head and isinstance(head[-1], LogRow)) and (entry := next(stream, None)):
        head.append(entry)
    if not head or not isinstance(head[-1], LogRow):
        found.present = frozenset()
    found.unix_us_at_zero = _unix_us_at(log, reader.clock.zero_us or 0)
    found.entries = chain(head, stream)
    is_undecoded = any("cannot be decoded" in text for text in log.damage(reader.clock.dropped))
    found.why_no_samples = _why_no_samples(log.columns, is_undecoded=is_undecoded)


def _unix_us_at(log: DataFlash, own_us: int) -> int | None:
    """Return the civil time at a time of the autopilot's clock; None without GPS time.

    It is derived from the first GPS week and time, to which pymavlink applies the present number
    of leap seconds.
    """
    clock = log.log.clock
    if not clock.timebase:
        return None
    zero_us = round((clock.timebase - clock._gpsTimeToTime(0, 0)) * US_PER_S)  # noqa: SLF001
    return unix_us_of_gps(_in_era(zero_us + own_us))


def _lacking(topic: str, columns: Set[str]) -> Set[str]:
    """Return the columns without which samples or fixes of a format cannot be used."""
    if topic == "GPS":
        return {"Lat", "Lng"} - columns
    if topic != "IMU":
        return frozenset()
    return IMU_COLUMNS - columns | ({"TimeUS"} if columns.isdisjoint(TIME_COLUMNS) else set())


def _why_no_samples(formats: Mapping[str, set[str]], *, is_undecoded: bool) -> str:
    if not formats.keys() - {"FMT"}:
        return "it has no list of formats (FMT), without which its messages cannot be decoded"
    for name, columns in formats.items():
        topic = table().aliases.get(name, (name, 0))[0]
        if topic == "IMU" and (lacking := _lacking(topic, columns)):
            return (
                f"its {name} messages cannot be decoded: they have no {', '.join(sorted(lacking))}"
                ", as in a log of sdlog2, PX4's logger before ULog, which is not supported"
            )
    if is_undecoded:
        return "none of its IMU messages can be decoded"
    return "contains no IMU messages, so there is nothing to fuse"


def _sensors_of(log: DataFlash) -> dict[str, int]:
    """Find the first sensor of each kind that has data; for GPS, a fix."""
    found: dict[str, int] = {}
    kinds: dict[str, _Kind] = {}
    for kind, columns in SENSORS.items():
        names = {kind, *(name for name, (of, _) in table().aliases.items() if of == kind)}
        least = FIX_2D if kind == "GPS" else 0.0
        seen: set[int] = set()
        for message in islice(log.each_of(names), MAX_LOOKED_AT):
            values = (getattr(message, column, 0) for column in columns)
            if any(isinstance(v, int | float) and abs(v) >= least and v != 0 for v in values):
                name = message.get_type()
                kinds[name] = kinds.get(name) or _Kind(message.fmt)
                seen.add(kinds[name].instance(message))
            if 0 in seen:
                break
        found[kind] = min(seen, default=0)
    return found


def _other_filter(log: DataFlash, present: set[str]) -> set[str]:
    """Return the topics of the Kalman filter that runs in addition to the one in use."""
    second = {name for name in present if name.startswith("NKF")}
    third = {name for name in present if name.startswith("XKF")}
    if not second or not third:
        return set()
    return third if log.log.params.get("AHRS_EKF_TYPE") == _SECOND else second


def _begin_of(log: DataFlash, modes: Mapping[str, int]) -> list[tuple[int, Event]]:
    """Read the events of a log up to the first damage, and rewind the log."""
    reader, entries = RowReader(frozenset(), modes), []
    for message in log.each_of(set(EVENTS)):
        entries += reader.feed(message.get_type(), message)
    entries += reader.flush()
    return [entry for entry in entries if not isinstance(entry, LogRow)]


def _set_begin(path: Path, found: AutopilotLog, entries: list[tuple[int, Event]]) -> None:
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
