"""The answers of a recording to ground stations, and the frames that must not be played.

A tlog holds the answers that the vehicle gave in flight. They are collected while the file is
indexed, each with the time from which it was valid, so that a player can give them again: as of
the moment that is played, or the first one for what the vehicle sent only later. A mission or a
parameter that a station set in flight did not exist before.

| what                         | where from                                               |
| ---------------------------- | -------------------------------------------------------- |
| parameters                   | PARAM_VALUE of the vehicle, the newest of each name      |
| mission, fence, rally points | a whole download, or an upload that the vehicle accepted |
| home, origin, version, modes | the messages of that name                                |

A recording holds both directions of a link. Messages of a vehicle are played; those of ground
stations, and any others that command a vehicle or feed its navigation, could arm, steer or mislead
a real vehicle with the same id on the link that it is played to.
"""

import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

import numpy as np

from gateway.recordings.senders import AUTOPILOT, FIRST_GROUND_STATION, Senders, is_station
from gateway.recordings.status_texts import text_of
from gateway.recordings.tlog import Batch, fields_of, payload_of
from gateway.recordings.tlog_scan import IntArray
from gateway.vehicle.plan import KINDS
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import MESSAGE_IDS, MESSAGE_NAMES, TARGET_OFFSETS, ids_of
from gateway.wire.mavlink_splitter import frame_of, message_id_of, origin_of

PARAM_VALUE_ID: Final = MESSAGE_IDS["PARAM_VALUE"]
AUTOPILOT_VERSION_ID: Final = MESSAGE_IDS["AUTOPILOT_VERSION"]
HOME_POSITION_ID: Final = MESSAGE_IDS["HOME_POSITION"]
AVAILABLE_MODES_ID: Final = MESSAGE_IDS["AVAILABLE_MODES"]
PARAM_VALUE: Final = struct.Struct("<4sHH16sB")
"""PARAM_VALUE: value, count, index, name, type."""
_SAME: Final = {HOME_POSITION_ID: 52}
"""How much of the payload must be equal to be no change; the rest is the time of sending."""
_PARAM_SET: Final = MESSAGE_IDS["PARAM_SET"]
_SET_NAME: Final = slice(6, 22)
"""Of PARAM_SET: behind the value and the target."""
ALL_KINDS: Final = 255
MAX_KEPT: Final = 200_000
"""Frames; some 10 MB. A vehicle has a thousand parameters that change now and then."""
Items = tuple[bytes, ...]
Value = TypeVar("Value")


_REPORTS: Final = ids_of(
    "COMMAND_ACK", "MISSION_ACK", "PARAM_ERROR", "MOUNT_STATUS", "CAMERA_STATUS",
    "CAMERA_FEEDBACK", "GIMBAL_REPORT", "GIMBAL_TORQUE_CMD_REPORT",
    "GIMBAL_DEVICE_ATTITUDE_STATUS", "OPEN_DRONE_ID_BASIC_ID", "OPEN_DRONE_ID_LOCATION",
    "OPEN_DRONE_ID_AUTHENTICATION", "OPEN_DRONE_ID_SELF_ID", "OPEN_DRONE_ID_SYSTEM",
    "OPEN_DRONE_ID_OPERATOR_ID", "OPEN_DRONE_ID_MESSAGE_PACK",
)  # fmt: skip
"""Messages with a target that request nothing of it."""
_ASKING: Final = TARGET_OFFSETS.keys() - _REPORTS
_FEEDING: Final = ids_of(
    "GPS_RTCM_DATA", "GPS_INPUT", "HIL_CONTROLS", "HIL_RC_INPUTS_RAW", "HIL_SENSOR",
    "HIL_GPS", "HIL_OPTICAL_FLOW", "HIL_ACTUATOR_CONTROLS", "HIL_STATE_QUATERNION",
    "GLOBAL_VISION_POSITION_ESTIMATE", "VISION_POSITION_ESTIMATE", "VISION_SPEED_ESTIMATE",
    "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY", "LANDING_TARGET",
    "OBSTACLE_DISTANCE", "OBSTACLE_DISTANCE_3D", "DISTANCE_SENSOR", "OPTICAL_FLOW",
    "OPTICAL_FLOW_RAD", "FOLLOW_TARGET", "TERRAIN_DATA",
)  # fmt: skip
"""Inputs of an autopilot from other components; when it sends them itself they are telemetry."""
ANSWERS: Final = np.array(sorted(ids_of(
    "COMMAND_ACK", "MISSION_ACK", "MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT",
    "MISSION_REQUEST", "MISSION_REQUEST_INT", "PARAM_VALUE", "PARAM_ERROR",
    "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "FILE_TRANSFER_PROTOCOL", "LOG_ENTRY", "LOG_DATA",
    "PING", "TIMESYNC",
)))  # fmt: skip
"""Answers to a station that asked in flight: one of today could take them for its own."""
_LOOKED_AT: Final = np.array(sorted(_ASKING | _FEEDING))
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
    if message_id not in _ASKING:
        return False
    target = frame_of(frame).target[0]
    return target < FIRST_GROUND_STATION and target not in {s >> 8 for s in stations}


def answers_of(batch: Batch, stations: Set[int]) -> IntArray:
    """Find the records in which a vehicle answers a station."""
    is_station_s = (batch.origins >> 8 >= FIRST_GROUND_STATION) | np.isin(
        batch.origins, list(stations)
    )
    return np.flatnonzero(np.isin(batch.message_ids, ANSWERS) & ~is_station_s)


def telemetry_of(batch: Batch, begin: int, senders: Senders) -> IntArray:
    """Find the records that are neither from a station, nor requests, nor answers to one."""
    origins, stations = batch.origins[begin:], senders.stations
    kept = (origins >> 8 < FIRST_GROUND_STATION) & ~np.isin(origins, list(stations))
    kept &= ~np.isin(batch.message_ids[begin:], ANSWERS)
    for i in np.flatnonzero(kept & np.isin(batch.message_ids[begin:], _LOOKED_AT)).tolist():
        kept[i] = not is_command(batch.frame(begin + i), senders)
    found: IntArray = np.flatnonzero(kept) + begin
    return found


@dataclass(slots=True)
class _Course(Generic[Value]):
    """A value that changes: since when each of its values is valid."""

    is_set: bool = False
    """Whether the first value was set when it became valid; else it was so before."""
    times: list[int] = field(default_factory=list)
    values: list[Value] = field(default_factory=list)

    def add(self, time_us: int, value: Value) -> None:
        # Clocks of other recorders may go back; a value recorded later is valid later.
        self.times.append(max(time_us, self.times[-1]) if self.times else time_us)
        self.values.append(value)

    def at(self, time_us: int) -> Value | None:
        number = bisect_right(self.times, time_us) - 1
        return None if number < 0 and self.is_set else self.values[max(number, 0)]


@dataclass(slots=True)
class _Transfer:
    """A mission in transfer: an upload waits for the vehicle's ACK, a download for its items."""

    count: int
    items: dict[int, bytes] = field(default_factory=dict)


class LogAnswers:
    """The answers in one recording, of any number of parts."""

    def __init__(self) -> None:
        self.frames: dict[tuple[int, int, bytes], _Course[bytes]] = {}
        """By system, message id, and key of the item."""
        self.missions: dict[tuple[int, int], _Course[Items]] = {}
        """By system and kind."""
        self.seen: set[tuple[int, int]] = set()
        """System and id of each message."""
        self._transfers: dict[tuple[int, int, bool], _Transfer] = {}
        self._set: set[tuple[int, bytes]] = set()
        """Parameters that a station has set, by system and name, until their value comes."""
        self._kept = 0

    def add(self, batch: Batch, senders: Senders) -> None:
        """Use the next records, after `senders` has."""
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
        """Use one frame: an answer or a part of a mission; others are ignored.

        `vehicle` is the component of its system that is the vehicle.
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
        """Drop a mission, and what is in transfer of it."""
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
        """Keep a mission that is complete."""
        if len(transfer.items) < transfer.count:
            return
        items = tuple(transfer.items[i] for i in range(transfer.count))
        course = self.missions.setdefault((vehicle, kind), _Course(is_set))
        contents = [payload_of(frame, 255) for frame in items]
        if not course.values or [payload_of(f, 255) for f in course.values[-1]] != contents:
            course.add(time_us, items)


class VehicleAnswers:
    """The answers of one vehicle of a recording at the played moment, under its played id."""

    def __init__(
        self, log: LogAnswers, system_id: int, played_as: int, position_us: Callable[[], int]
    ) -> None:
        self._log = log
        self._system_id = system_id
        self.played_as = played_as
        self._position_us = position_us

    def has_message(self, message_id: int) -> bool:
        """Return whether the vehicle sent a message at all."""
        return (self._system_id, message_id) in self._log.seen

    def frames(self, message_id: int) -> list[bytes]:
        """Return the frames that were sent last before the moment, or else first after it."""
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
        """Return the frames of the items of a mission; None if the recording has none."""
        course = self._log.missions.get((self._system_id, kind))
        return None if course is None else course.at(self._position_us())

    def parameters(self) -> dict[str, bytes]:
        """Return the parameters by name, in their order, numbered so that the list is complete."""
        frames = self._recorded(PARAM_VALUE_ID)
        # Answers to a setting carry no index (65535); they come last.
        values = sorted(
            (*PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))[2:4], frame)
            for frame in frames
        )
        return {
            text_of(name): self._edited(frame, param_count=len(values), param_index=number)
            for number, (_, name, frame) in enumerate(values)
        }


def _key_of(frame: bytes) -> bytes:
    """Return a key of frames of one message that hold different items."""
    message_id = message_id_of(frame)
    if message_id == PARAM_VALUE_ID:
        return bytes(PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))[3])
    if message_id == AVAILABLE_MODES_ID:
        # AVAILABLE_MODES: custom_mode and properties, 4 bytes each, then number and index.
        return payload_of(frame, 10)[9:]
    return b""


def content_of(frame: bytes) -> bytes:
    """Return the bytes of a kept frame that change with its content."""
    message_id = message_id_of(frame)
    if message_id == PARAM_VALUE_ID:
        value, _, _, _, kind = PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))
        return bytes((*value, kind))
    return payload_of(frame, _SAME.get(message_id, 255))
