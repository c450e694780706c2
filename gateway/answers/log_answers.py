"""The recorded answers of vehicles, and the frames that must not be played.

A tlog contains the answers that the vehicle gave in flight. They are collected while the file is
indexed, each with the time from which it was valid, so that a player can give them again: the
answer valid at the moment played, or the first one if the vehicle sent it only later. A mission or
parameter that a station set in flight does not exist before that.

| answer                       | source                                                   |
| ---------------------------- | -------------------------------------------------------- |
| parameters                   | PARAM_VALUE of the vehicle, the newest of each name      |
| mission, fence, rally points | a whole download, or an upload that the vehicle accepted |
| home, origin, version, modes | the messages of that name                                |

A recording contains both directions of a link. Messages of a vehicle are played. Those of ground
stations, and others that command a vehicle or feed its navigation, are not: they could arm, steer
or mislead a real vehicle with the same id on the link that the recording is played to.
"""

import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

import numpy as np

from gateway.vehicle.plan import KINDS
from gateway.vehicle_state.senders import AUTOPILOT, FIRST_GROUND_STATION, Senders, is_station
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import MESSAGE_IDS, MESSAGE_NAMES, ids_of
from gateway.wire.mavlink_splitter import frame_of, message_id_of, origin_of
from gateway.wire.recorded_frames import Batch, IntArray, fields_of, payload_of
from gateway.wire.vehicle_inputs import REQUESTS, UNADDRESSED_INPUTS

PARAM_VALUE_ID: Final = MESSAGE_IDS["PARAM_VALUE"]
AUTOPILOT_VERSION_ID: Final = MESSAGE_IDS["AUTOPILOT_VERSION"]
HOME_POSITION_ID: Final = MESSAGE_IDS["HOME_POSITION"]
AVAILABLE_MODES_ID: Final = MESSAGE_IDS["AVAILABLE_MODES"]
PARAM_VALUE: Final = struct.Struct("<4sHH16sB")
"""Fields of PARAM_VALUE: value, count, index, name, type."""
_SAME: Final = {HOME_POSITION_ID: 52}
"""Bytes of the payload that contain content, by message; the rest is the time of sending."""
_PARAM_SET: Final = MESSAGE_IDS["PARAM_SET"]
_SET_NAME: Final = slice(6, 22)
"""Bytes of the name in PARAM_SET, after value and target."""
ALL_KINDS: Final = 255
MAX_KEPT: Final = 200_000
"""Maximum number of frames, about 10 MB. A vehicle has some 1000 parameters that rarely change."""
Items = tuple[bytes, ...]
Value = TypeVar("Value")


_FEEDING: Final = UNADDRESSED_INPUTS - ids_of("RADIO_STATUS", "RADIO")
"""Inputs of an autopilot from other components; sent by the autopilot itself, telemetry. The state
of a radio is played: stations show it."""
ANSWERS: Final = np.array(sorted(ids_of(
    "COMMAND_ACK", "MISSION_ACK", "MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT",
    "MISSION_REQUEST", "MISSION_REQUEST_INT", "PARAM_VALUE", "PARAM_ERROR",
    "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "FILE_TRANSFER_PROTOCOL", "LOG_ENTRY", "LOG_DATA",
    "PING", "TIMESYNC",
)))  # fmt: skip
"""Answers to a recorded station; a live station could take them for answers to its requests."""
_LOOKED_AT: Final = np.array(sorted(REQUESTS | _FEEDING))
_KEPT: Final = ids_of(
    "PARAM_VALUE", "GPS_GLOBAL_ORIGIN", "AUTOPILOT_VERSION", "HOME_POSITION", "PROTOCOL_VERSION",
    "AVAILABLE_MODES",
)  # fmt: skip
_MISSION: Final = ids_of(
    "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_ACK"
)
_READ: Final = np.array(sorted(_KEPT | _MISSION | {_PARAM_SET}))


def is_command(frame: bytes, senders: Senders) -> bool:
    """Return whether a frame is a request to a vehicle, or feeds its navigation."""
    message_id, stations = message_id_of(frame), senders.stations
    if message_id in _FEEDING:
        system, component = origin_of(frame)
        return component != senders.vehicle(system).component
    if message_id not in REQUESTS:
        return False
    target = frame_of(frame).target[0]
    return target < FIRST_GROUND_STATION and target not in {s >> 8 for s in stations}


def answers_of(batch: Batch, stations: Set[int]) -> IntArray:
    """Find the records in which a vehicle answers a station, by index."""
    is_station_s = (batch.origins >> 8 >= FIRST_GROUND_STATION) | np.isin(
        batch.origins, list(stations)
    )
    return np.flatnonzero(np.isin(batch.message_ids, ANSWERS) & ~is_station_s)


def telemetry_of(batch: Batch, begin: int, senders: Senders) -> IntArray:
    """Find the records that are not from a station, not requests, and not answers to a station."""
    origins, stations = batch.origins[begin:], senders.stations
    kept = (origins >> 8 < FIRST_GROUND_STATION) & ~np.isin(origins, list(stations))
    kept &= ~np.isin(batch.message_ids[begin:], ANSWERS)
    for i in np.flatnonzero(kept & np.isin(batch.message_ids[begin:], _LOOKED_AT)).tolist():
        kept[i] = not is_command(batch.frame(begin + i), senders)
    found: IntArray = np.flatnonzero(kept) + begin
    return found


@dataclass(slots=True)
class _Course(Generic[Value]):
    """The successive values of something, each with the time from which it was valid."""

    is_set: bool = False
    """Whether the first value was set at its time; otherwise it was valid before as well."""
    times: list[int] = field(default_factory=list)
    values: list[Value] = field(default_factory=list)

    def add(self, time_us: int, value: Value) -> None:
        # Clocks of other recorders may step back; a value recorded later is valid later.
        self.times.append(max(time_us, self.times[-1]) if self.times else time_us)
        self.values.append(value)

    def at(self, time_us: int) -> Value | None:
        number = bisect_right(self.times, time_us) - 1
        return None if number < 0 and self.is_set else self.values[max(number, 0)]


@dataclass(slots=True)
class _Transfer:
    """A mission in transfer: an upload ends with the vehicle's ACK, a download with its items."""

    count: int
    items: dict[int, bytes] = field(default_factory=dict)


class LogAnswers:
    """The answers in one recording of one or several parts."""

    def __init__(self) -> None:
        self.frames: dict[tuple[int, int, bytes], _Course[bytes]] = {}
        """Key: system, message id, and key of the item."""
        self.missions: dict[tuple[int, int], _Course[Items]] = {}
        """Key: system and kind of mission."""
        self.seen: set[tuple[int, int]] = set()
        """System and message id of each message that was seen."""
        self._transfers: dict[tuple[int, int, bool], _Transfer] = {}
        self._set: set[tuple[int, bytes]] = set()
        """Parameters (system, name) that a station has set and whose new value is still to come."""
        self._kept = 0

    def add(self, batch: Batch, senders: Senders) -> None:
        """Process the next records; `senders` must have processed them already."""
        systems = batch.origins >> 8
        vehicles = {each: senders.vehicle(each).component for each in np.unique(systems).tolist()}
        pairs = np.unique(systems << 32 | batch.message_ids)
        self.seen |= {(pair >> 32, pair & 0xFFFFFFFF) for pair in pairs.tolist()}
        for i in np.flatnonzero(np.isin(batch.message_ids, _READ)).tolist():
            if self._kept < MAX_KEPT:
                vehicle, time_us = vehicles[int(systems[i])], int(batch.time_us[i])
                self.add_frame(batch.frame(i), time_us, senders.stations, vehicle)

    def add_frame(
        self, frame: bytes, time_us: int, stations: Set[int] = frozenset(), vehicle: int = AUTOPILOT
    ) -> None:
        """Process one frame: an answer or a part of a mission; others are ignored.

        `vehicle` is the component that is the vehicle of its system.
        """
        message_id, (system, component) = message_id_of(frame), origin_of(frame)
        self.seen.add((system, message_id))
        if message_id in _MISSION:
            self._add_mission(frame, time_us, is_station(system << 8 | component, stations))
        elif message_id == _PARAM_SET:
            name = payload_of(frame, _SET_NAME.stop)[_SET_NAME]
            if len(self._set) < MAX_KEPT:
                self._set.add((frame_of(frame).target[0], name))
        elif message_id in _KEPT and component == vehicle:
            key = _key_of(frame)
            is_set = message_id == PARAM_VALUE_ID and (system, key) in self._set
            self._set.discard((system, key))
            course = self.frames.setdefault((system, message_id, key), _Course(is_set))
            if not course.values or content_of(course.values[-1]) != content_of(frame):
                course.add(time_us, frame)
                self._kept += 1

    def pending(self) -> Iterator[bytes]:
        """Yield the items of missions in transfer."""
        for transfer in self._transfers.values():
            yield from transfer.items.values()

    def drop_mission(self, vehicle: int, kind: int) -> None:
        """Drop a mission, and its transfers in progress."""
        self.missions.pop((vehicle, kind), None)
        for is_upload in (False, True):
            self._transfers.pop((vehicle, kind, is_upload), None)

    def _add_mission(self, frame: bytes, time_us: int, is_upload: bool) -> None:
        vehicle = frame_of(frame).target[0] if is_upload else origin_of(frame)[0]
        name, message = MESSAGE_NAMES[message_id_of(frame)], fields_of(frame)
        kind = message["mission_type"]
        kinds = KINDS if kind == ALL_KINDS else (kind,)
        match name:
            case "MISSION_COUNT":
                self._begin(vehicle, kind, is_upload, message["count"], time_us)
            case "MISSION_CLEAR_ALL" if is_upload:
                for each in kinds:
                    self._begin(vehicle, each, is_upload, 0, time_us)
            case "MISSION_ACK" if not is_upload:
                for each in kinds:
                    transfer = self._transfers.pop((vehicle, each, True), None)
                    if transfer is not None and not message["type"]:
                        self._store(vehicle, each, transfer, time_us, is_set=True)
            case "MISSION_ITEM" | "MISSION_ITEM_INT":
                transfer = self._transfers.get((vehicle, kind, is_upload))
                if transfer is not None and message["seq"] < transfer.count:
                    self._kept += message["seq"] not in transfer.items
                    transfer.items[message["seq"]] = frame
                    if not is_upload:
                        self._store(vehicle, kind, transfer, time_us)

    def _begin(self, vehicle: int, kind: int, is_upload: bool, count: int, time_us: int) -> None:
        if kind not in KINDS:
            return
        transfer = self._transfers[vehicle, kind, is_upload] = _Transfer(count)
        if not is_upload:
            self._store(vehicle, kind, transfer, time_us)

    def _store(
        self, vehicle: int, kind: int, transfer: _Transfer, time_us: int, *, is_set: bool = False
    ) -> None:
        """Store a mission if all its items are there."""
        if len(transfer.items) < transfer.count:
            return
        items = tuple(transfer.items[i] for i in range(transfer.count))
        course = self.missions.setdefault((vehicle, kind), _Course(is_set))
        contents = [payload_of(frame, 255) for frame in items]
        if not course.values or [payload_of(f, 255) for f in course.values[-1]] != contents:
            course.add(time_us, items)


class VehicleAnswers:
    """The answers of one recorded vehicle at the moment played, under its played id."""

    def __init__(
        self, log: LogAnswers, system_id: int, played_as: int, position_us: Callable[[], int]
    ) -> None:
        self._log = log
        self._system_id = system_id
        self.played_as = played_as
        self._position_us = position_us

    def has_message(self, message_id: int) -> bool:
        """Return whether the vehicle ever sent a message."""
        return (self._system_id, message_id) in self._log.seen

    def frames(self, message_id: int) -> list[bytes]:
        """Return the last frames sent before the moment played, else the first ones after it."""
        return [self._edited(frame) for frame in self._recorded(message_id)]

    def _recorded(self, message_id: int) -> list[bytes]:
        present = (
            course.at(self._position_us())
            for (system, kind, _), course in self._log.frames.items()
            if (system, kind) == (self._system_id, message_id)
        )
        return [frame for frame in present if frame is not None]

    def _edited(self, frame: bytes, **fields: int) -> bytes:
        read, system_id = frame_of(frame), self.played_as
        edited = edit_frame(read, system=system_id, fields=fields, drop_signature=True)
        return (edited or read).data

    def mission(self, kind: int) -> Items | None:
        """Return the frames of a mission's items; None if the recording has no such mission."""
        course = self._log.missions.get((self._system_id, kind))
        return None if course is None else course.at(self._position_us())

    def parameters(self) -> dict[str, bytes]:
        """Return the parameters by name, in their order, renumbered without gaps."""
        frames = self._recorded(PARAM_VALUE_ID)
        # A confirmation of PARAM_SET has no index (65535); these parameters come last.
        values = sorted(
            (*PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))[2:4], frame)
            for frame in frames
        )
        return {
            text_of(name): self._edited(frame, param_count=len(values), param_index=number)
            for number, (_, name, frame) in enumerate(values)
        }


def _key_of(frame: bytes) -> bytes:
    """Return a key that distinguishes frames of the same message with different items."""
    message_id = message_id_of(frame)
    if message_id == PARAM_VALUE_ID:
        return bytes(PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))[3])
    if message_id == AVAILABLE_MODES_ID:
        # AVAILABLE_MODES: custom_mode and properties, 4 bytes each, then number and index.
        return payload_of(frame, 10)[9:]
    return b""


def content_of(frame: bytes) -> bytes:
    """Return the bytes of a stored frame that change with its content."""
    message_id = message_id_of(frame)
    if message_id == PARAM_VALUE_ID:
        value, _, _, _, kind = PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))
        return bytes((*value, kind))
    return payload_of(frame, _SAME.get(message_id, 255))
