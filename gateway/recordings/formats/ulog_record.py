"""Read a ULog as an autopilot's log: rows and events for `ulog.toml`."""

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.autopilot_record import (
    Armed,
    AutopilotLog,
    Entry,
    Event,
    LoggedParameter,
    LogRow,
    Mode,
    Text,
)
from gateway.recordings.files import FlightError
from gateway.recordings.formats.ulog import (
    SOURCES,
    Instance,
    Topic,
    damage_of,
    first_with_data,
    in_order,
    instances_of,
    load,
    system_id_of,
    unix_us_at_boot,
)
from gateway.recordings.message_table import MessageTable, read_table
from gateway.recordings.recorded_table import ReadOptions
from gateway.units import counted

ARMED: Final = 2
"""Value of arming_state in vehicle_status."""
FIRMWARE: Final = 0
"""Kind of default parameters: those of the firmware, independent of the vehicle."""
STATUS: Final = "vehicle_status"
SHOWN: Final = (
    "vehicle_attitude",
    "vehicle_global_position",
    "vehicle_local_position",
    *SOURCES["GPS"],
)
"""Topics of which at least one is required to show anything."""
_KINDS: Final = {
    mavlink.MAV_TYPE_FIXED_WING: "plane", mavlink.MAV_TYPE_GROUND_ROVER: "rover",
    mavlink.MAV_TYPE_SURFACE_BOAT: "rover", mavlink.MAV_TYPE_SUBMARINE: "sub",
} | dict.fromkeys(range(19, 26), "vtol")  # fmt: skip
"""Kind of vehicle by MAV_TYPE; all others are copters."""


@cache
def table() -> MessageTable:
    """Return the table of ULog."""
    return read_table((files("gateway.recordings.formats") / "ulog.toml").read_bytes())


def custom_mode_of(nav_state: int) -> int:
    """Return PX4's custom mode of a navigation state; 0 for an unknown one."""
    _, main, sub = table().nav_states.get(str(nav_state), ("", 0, 0))
    return main << 16 | sub << 24


def open_record(path: Path, options: ReadOptions) -> AutopilotLog:
    """Open a ULog as the record of its autopilot; raises FlightError if it is empty."""
    log, unread, before = load(path, options, None)
    counts: Counter[str] = Counter()
    topics: dict[Instance, Topic] = {}
    dropped = 0
    for data in reversed(log.data_list):
        counts[data.name] += len(data.data["timestamp"])
        if data.name in table().topics:
            columns = _used_columns(data.data)
            topics[data.name, data.multi_id], count = in_order(columns)
            dropped += count
    topics, primary = _with_fixes(topics, dict(options.sensors).get("GPS"))
    present = {name for (name, _), topic in topics.items() if len(topic["timestamp"])}
    if not present & {*SHOWN}:
        raise FlightError(f"{path}: has none of {', '.join(SHOWN)}, so there is nothing to play")
    zero_us = min(int(t["timestamp"][0]) for t in topics.values() if len(t["timestamp"]))
    boot_us, mav_type = _boot_us(topics), _type_of(log, topics)
    events = _events_of(log, topics)
    first = {type(event): event for _, event in reversed(events)}
    odd = [f"left out {counted(dropped, 'row')} with an impossible time"] if dropped else []
    remarks = [*before.remarks, *damage_of(log, unread), *odd]
    return AutopilotLog(
        table=table(),
        entries=_entries(topics, events, zero_us),
        vehicle_id=options.system_id or system_id_of(log),
        autopilot=mavlink.MAV_AUTOPILOT_PX4,
        mav_type=mav_type,
        kind=_KINDS.get(mav_type, "copter"),
        present=frozenset(present | {"SENSORS"}),
        counts=counts,
        unix_us_at_zero=None if boot_us is None else boot_us + zero_us,
        primary=primary,
        parameters=_parameters(log.initial_parameters),
        defaults=_parameters(log.get_default_parameters(FIRMWARE)),
        modes={
            custom_mode_of(int(state)): name for state, (name, *_) in table().nav_states.items()
        },
        is_armed=getattr(first.get(Armed), "is_armed", False),
        custom_mode=getattr(first.get(Mode), "custom_mode", 0),
        remarks=[f"{path}: {remark}" for remark in remarks],
    )


def _with_fixes(
    topics: dict[Instance, Topic], wanted: int | None
) -> tuple[dict[Instance, Topic], dict[str, int]]:
    """Leave out the topic of GPS receivers that has no fixes; return the instance to use, too."""
    gps = first_with_data("GPS", topics, instances_of("GPS", topics, wanted))
    if gps is None:
        return topics, {} if wanted is None else dict.fromkeys(SOURCES["GPS"], wanted)
    others = {*SOURCES["GPS"]} - {gps[0]}
    return {one: topic for one, topic in topics.items() if one[0] not in others}, dict([gps])


def _used_columns(topic: Mapping[str, Any]) -> Topic:
    """Leave out columns that are not numeric, or that no message uses."""
    used = _used()
    return {
        name: column
        for name, column in topic.items()
        if column.dtype.kind in "iubf" and (name in used or name == "timestamp")
    }


@cache
def _used() -> frozenset[str]:
    lanes = {where.partition(".")[2] for where in table().lanes.values()}
    others = {"nav_state", "arming_state", "system_type", "time_utc_usec"}
    return frozenset(
        {source.name for source in table().sources} | lanes | others | {"timestamp_time_relative"}
    )


def _boot_us(topics: Mapping[Instance, Topic]) -> int | None:
    found = (
        unix_us_at_boot(topic) for (name, _), topic in topics.items() if name in SOURCES["GPS"]
    )
    return next((us for us in found if us is not None), None)


def _type_of(log: Any, topics: Mapping[Instance, Topic]) -> int:
    """Return the MAV_TYPE in the vehicle's status, otherwise the one in its parameters."""
    status = topics.get((STATUS, 0), {})
    seen = status.get("system_type")
    if seen is not None and len(seen) and 0 < int(seen[-1]) <= 255:
        return int(seen[-1])
    known = log.initial_parameters.get("MAV_TYPE", mavlink.MAV_TYPE_GENERIC)
    return known if isinstance(known, int) and 0 <= known <= 255 else mavlink.MAV_TYPE_GENERIC


def _parameters(known: Mapping[str, Any]) -> dict[str, float | int]:
    return {
        name: value
        for name, value in known.items()
        if isinstance(value, int | float) and abs(value) < 1 << 31
    }


def _events_of(log: Any, topics: Mapping[Instance, Topic]) -> list[tuple[int, Event]]:
    """Return the events, at times of the autopilot's clock and in their order."""
    found: list[tuple[int, Event]] = []
    status = topics.get((STATUS, 0), {})
    if "nav_state" in status and "arming_state" in status:
        columns = (status[name].tolist() for name in ("timestamp", "nav_state", "arming_state"))
        last = None
        for time_us, nav_state, arming in zip(*columns, strict=True):
            if (nav_state, arming) != last:
                found.append((time_us, Mode(custom_mode_of(nav_state))))
                found.append((time_us, Armed(arming == ARMED)))
            last = (nav_state, arming)
    tagged = (text for texts in log.logged_messages_tagged.values() for text in texts)
    for text in (*log.logged_messages, *tagged):
        severity = text.log_level - ord("0")
        if 0 <= severity <= mavlink.MAV_SEVERITY_DEBUG:
            found.append((int(text.timestamp), Text(severity, str(text.message))))
    for time_us, name, value in log.changed_parameters:
        if isinstance(value, int | float) and abs(value) < 1 << 31:
            found.append((int(time_us), LoggedParameter(name, value)))
    return sorted(found, key=lambda one: one[0])


def _entries(
    topics: Mapping[Instance, Topic], events: list[tuple[int, Event]], zero_us: int
) -> Iterator[Entry]:
    """Yield rows and events in order of time; at equal times, topics that send messages last."""
    sent = {name for row in table().messages for name in row.of}
    streams = sorted(topics.items(), key=lambda one: (one[0][0] in sent, one[0]))
    if not streams:
        return
    times = np.concatenate([topic["timestamp"].astype(np.int64) for _, topic in streams])
    numbers = np.repeat(np.arange(len(streams)), [len(t["timestamp"]) for _, t in streams])
    order = np.argsort(times, kind="stable")
    rows = [_rows(topic) for _, topic in streams]
    waiting = iter(events)
    event = next(waiting, None)
    for time_us, number in zip(times[order].tolist(), numbers[order].tolist(), strict=True):
        while event is not None and event[0] <= time_us:
            yield max(event[0] - zero_us, 0), event[1]
            event = next(waiting, None)
        name, instance = streams[number][0]
        yield LogRow(time_us - zero_us, time_us, name, instance, next(rows[number]))
    while event is not None:
        yield max(event[0] - zero_us, 0), event[1]
        event = next(waiting, None)


def _rows(topic: Topic) -> Iterator[Mapping[str, Any]]:
    columns = [column.tolist() for column in topic.values()]
    return (dict(zip(topic, row, strict=True)) for row in zip(*columns, strict=True))
