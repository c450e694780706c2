"""Read a ULog as an autopilot's log: rows and events for `ulog.toml`.

Of several topics with a kind of data, or instances of a topic, the first with data is used.
Positions are in 1e-7 degrees or, in newer logs, in degrees. All is in body FRD and NED.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from statistics import median_low
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
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
    system_id_of,
)
from gateway.recordings.columns import LARGEST_WHOLE
from gateway.recordings.formats.ulog import NEEDED, load
from gateway.recordings.message_table import table_of
from gateway.recordings.recorded_clock import FIRST_CIVIL_US, logged_times, sound_times
from gateway.recordings.recorded_table import ReadOptions
from gateway.units import FIX_2D, US_PER_S, counted
from gateway.wire.vehicle_types import CLASSES

table: Final = partial(table_of, "ulog")
Topic = Mapping[str, NDArray[Any]]
Instance = tuple[str, int]
"""Name of a topic, and the number of its instance, from 0."""
IMU: Final = "sensor_combined"
GPS: Final = "vehicle_gps_position"
SOURCES: Final = {
    "IMU": (IMU,),
    "MAG": ("vehicle_magnetometer", IMU),
    "BARO": ("vehicle_air_data", "sensor_baro", IMU),
    "GPS": (GPS, "sensor_gps"),
}
"""Topics for each kind of sensor, the preferred one first."""
DATA: Final = {
    "IMU": tuple(f"accelerometer_m_s2[{axis}]" for axis in range(3)),
    "MAG": tuple(f"magnetometer_ga[{axis}]" for axis in range(3)),
    "BARO": ("baro_pressure_pa", "pressure", "baro_alt_meter"),
}
"""Fields of which not all are zero if a sensor has data; a receiver has some if it has a fix."""
ARMED: Final = 2
"""Value of arming_state in vehicle_status."""
FIRMWARE: Final = 0
"""Kind of default parameters: those of the firmware, independent of the vehicle."""
STATUS: Final = "vehicle_status"
_KINDS: Final = {"plane": "plane", "vtol": "vtol", "rover": "rover", "boat": "rover", "sub": "sub"}
"""Kind of vehicle by its class; all others are copters."""


def custom_mode_of(nav_state: int) -> int:
    """Return PX4's custom mode of a navigation state; 0 for an unknown one."""
    _, main, sub = table().nav_states.get(str(nav_state), ("", 0, 0))
    return main << 16 | sub << 24


def open_record(path: Path, options: ReadOptions, *, sampled: bool = False) -> AutopilotLog:
    """Open a ULog as the record of its autopilot, or only its samples."""
    wanted = table().sampled if sampled else table().topics
    log, remarks = load(path, options, [*wanted, "sensor_gps"] if sampled else None)
    topics, odd = _topics_of(log, wanted)
    topics, primary, chosen = _chosen(topics, dict(options.sensors))
    remarks += [*chosen, *odd]
    begins = [int(topic["timestamp"][0]) for topic in topics.values() if len(topic["timestamp"])]
    zero_us = min(begins, default=0)
    boot_us, mav_type = _boot_us(topics), _type_of(log, topics)
    events = _events_of(log, topics)
    first = {type(event): event for _, event in reversed(events)}
    names = {name for (name, _), topic in topics.items() if len(topic["timestamp"])}
    lost = log._missing_message_ids  # noqa: SLF001
    formats = f", and the formats of {counted(len(lost), 'topic')} are lost" if lost else ""
    states = table().nav_states.items()
    return AutopilotLog(
        table=table(),
        entries=_entries(topics, events, zero_us),
        vehicle_id=options.system_id or system_id_of(log.initial_parameters.get("MAV_SYS_ID")),
        autopilot=mavlink.MAV_AUTOPILOT_PX4,
        mav_type=mav_type,
        kind=_KINDS.get(CLASSES.get(mav_type, ""), "copter"),
        present=frozenset({"SENSORS"} | names),
        counts=_counts_of(log),
        unix_us_at_zero=None if boot_us is None else boot_us + zero_us,
        primary=primary,
        parameters=_parameters(log.initial_parameters),
        defaults=_parameters(log.get_default_parameters(FIRMWARE)),
        modes={custom_mode_of(int(state)): name for state, (name, *_) in states},
        is_armed=getattr(first.get(Armed), "is_armed", False),
        custom_mode=getattr(first.get(Mode), "custom_mode", 0),
        remarks=[f"{path}: {remark}" for remark in remarks],
        why_no_samples="; it ".join([f"contains no {IMU}, the IMU's samples{formats}", *remarks]),
    )


def _counts_of(log: Any) -> Counter[str]:
    counts: Counter[str] = Counter()
    for data in log.data_list:
        counts[data.name] += len(data.data.get("timestamp", ()))
    return counts


def _topics_of(log: Any, wanted: frozenset[str]) -> tuple[dict[Instance, Topic], list[str]]:
    """Return the topics that are read, in order of time; also remarks on the others."""
    found: dict[Instance, Topic] = {}
    left_out, dropped = set(), 0
    for data in reversed(log.data_list):
        if data.name not in wanted and data.name not in table().aliases:
            continue
        columns = _used_columns(data.data)
        if _lacks(data.name, columns):
            left_out.add(data.name)
        else:
            found[data.name, data.multi_id] = columns
    topics: dict[Instance, Topic] = {}
    times = logged_times([columns["timestamp"] for columns in found.values()])
    for (instance, columns), time_us in zip(found.items(), times, strict=True):
        sound, order = sound_times(time_us)
        timed = {**columns, "timestamp": time_us}
        topics[instance] = {name: c[order] for name, c in timed.items()}
        dropped += int(np.count_nonzero(~sound))
    remarks = []
    if left_out:
        names = ", ".join(sorted(left_out))
        remarks.append(f"lacks fields that PX4 documents for {names}; left out")
    if dropped:
        remarks.append(f"left out {counted(dropped, 'row')} with an impossible time")
    return topics, remarks


def _chosen(
    topics: dict[Instance, Topic], wanted: Mapping[str, int]
) -> tuple[dict[Instance, Topic], dict[str, int], list[str]]:
    """Leave out the topics of a kind of sensor that are not the first with data.

    Also return the instance to use by topic, and remarks for the user.
    """
    kept, primary, remarks = dict(topics), dict[str, int](), list[str]()
    for kind, names in SOURCES.items():
        number = wanted.get(kind)
        found = [
            one
            for name in names
            for one in sorted(topics)
            if one[0] == name and number in (None, one[1])
        ]
        default = found[0] if found and kind in ("IMU", "GPS") else None
        chosen = next((one for one in found if _has_data(kind, topics[one])), default)
        for one in list(kept):
            if one[0] in names and (chosen is None or one[0] != chosen[0]):
                rest = {k: v for k, v in kept.pop(one).items() if k not in DATA.get(kind, ())}
                if one[0] == IMU and kind != "IMU":
                    kept[one] = rest
        if chosen is not None:
            primary[chosen[0]] = chosen[1]
            if chosen != (found[0][0], 0):
                other = f" of {chosen[0]}" if chosen[0] != found[0][0] else ""
                remarks.append(f"uses {kind} {chosen[1] + 1}{other}")
        elif number is not None:
            primary |= dict.fromkeys(names, number)
            remarks.append(f"has no {kind} {number + 1}")
    named = {(GPS if name == "sensor_gps" else name, k): t for (name, k), t in kept.items()}
    primary[GPS] = primary.pop("sensor_gps", primary.get(GPS, 0))
    return named, primary, remarks


def _has_data(kind: str, topic: Topic) -> bool:
    if kind == "GPS":
        return bool((topic.get("fix_type", np.array([FIX_2D])) >= FIX_2D).any())
    fields = [topic[name] for name in DATA[kind] if name in topic]
    return any(bool((np.isfinite(values) & (values != 0)).any()) for values in fields)


def _lacks(name: str, topic: Topic) -> bool:
    is_timed = "timestamp" in topic and topic["timestamp"].dtype.kind in "iu"
    fields = NEEDED.get(name, ())
    return not is_timed or not all(any(field in topic for field in one) for one in fields)


def _used_columns(topic: Mapping[str, Any]) -> Topic:
    """Leave out columns that are not numeric, or that nothing uses."""
    used = _used()
    return {
        name: column
        for name, column in topic.items()
        if name in used and column.dtype.kind in "iubf"
    }


@cache
def _used() -> frozenset[str]:
    known = table()
    primary_fields = {where.partition(".")[2] for where in known.primary_fields.values()}
    others = {"timestamp", "timestamp_time_relative", "nav_state", "arming_state", "system_type"}
    return frozenset({source.name for source in known.sources} | primary_fields | others)


def _boot_us(topics: Mapping[Instance, Topic]) -> int | None:
    """Return the civil time at zero of the autopilot's clock, from its fixes; None without any."""
    for (name, _), gps in topics.items():
        if name == GPS and "time_utc_usec" in gps:
            utc_us = gps["time_utc_usec"].astype(np.int64)
            own_us = gps["timestamp"].astype(np.int64)
            own_us += gps.get("timestamp_time_relative", np.int64(0))
            is_civil = (utc_us > FIRST_CIVIL_US) & (utc_us < LARGEST_WHOLE)
            if is_civil.any():
                return int(median_low((utc_us - own_us)[is_civil].tolist()))
    return None


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
    """Yield rows and events in order of time; at equal times, topics that send messages last.

    Of these, the samples that are fused are in their order, in which they complete rows.
    """
    sent = {name for row in table().messages for name in row.of}
    last = {name: n for n, row in enumerate(table().samples, 1) for name in row.of}
    streams = sorted(
        topics.items(), key=lambda one: (one[0][0] in sent, last.get(one[0][0], 0), one[0])
    )
    if not streams:
        return
    times = np.concatenate([topic["timestamp"].astype(np.int64) for _, topic in streams])
    numbers = np.repeat(np.arange(len(streams)), [len(t["timestamp"]) for _, t in streams])
    order = np.argsort(times, kind="stable")
    rows = [_rows(topic) for _, topic in streams]
    end_us = int(times.max()) + US_PER_S
    waiting = iter([(min(time_us, end_us), event) for time_us, event in events])
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
