"""The recorded answers of vehicles, and the frames that must not be played.

A tlog contains the answers that the vehicle gave in flight. They are collected while the file is
indexed, each with the time from which it was valid, so that a player can give them again: the
answer valid at the moment played, or the first one if the vehicle sent it only later. A mission or
parameter that a station set in flight does not exist before that.

| answer                       | source                                                   |
| ---------------------------- | -------------------------------------------------------- |
| parameters                   | PARAM_VALUE, the newest of each name                     |
| mission, fence, rally points | a whole download, or an upload that the vehicle accepted |
| messages sent on request     | the newest of each kind and number: home, modes, cameras |
| telemetry                    | the newest that was played                               |

Each component of a system has answers of its own.

Missions: a MISSION_ACK confirms the upload whose items are complete, else an earlier
MISSION_CLEAR_ALL of the same station. So a script that sends MISSION_CLEAR_ALL and MISSION_COUNT at
once gets two of them.

| message              | clear pending   | upload pending                                 |
| -------------------- | --------------- | ---------------------------------------------- |
| MISSION_CLEAR_ALL    | begins          | ends                                           |
| MISSION_COUNT        | unchanged       | begins without items                           |
| WRITE_PARTIAL_LIST   | unchanged       | begins with the other items, if they are known |
| ACK of acceptance    | ends; is stored | if complete, ends and is stored instead        |
| ACK of a refusal     | ends            | if complete and no clear was pending, ends     |

A recording contains both directions of a link. Messages of a vehicle are played. Those of ground
stations, and others that command a vehicle or feed its navigation, are not: they could arm, steer
or mislead a real vehicle with the same id on the link that the recording is played to.
"""

import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, field
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.plan import KINDS
from gateway.vehicle.requested_messages import DISTINGUISHED_BY
from gateway.vehicle_state.senders import AUTOPILOT, FIRST_GROUND_STATION, Senders, is_station
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import (
    BOOT_TIME_BYTES,
    BOOT_TIME_OFFSETS,
    HEARTBEAT_ID,
    MESSAGE_IDS,
    MESSAGE_NAMES,
    ids_of,
)
from gateway.wire.mavlink_splitter import frame_of, message_id_of, origin_of
from gateway.wire.recorded_frames import Batch, IntArray, fields_of, payload_of
from gateway.wire.vehicle_inputs import REQUESTS, UNADDRESSED_INPUTS

PARAM_VALUE_ID: Final = MESSAGE_IDS["PARAM_VALUE"]
AUTOPILOT_VERSION_ID: Final = MESSAGE_IDS["AUTOPILOT_VERSION"]
HOME_POSITION_ID: Final = MESSAGE_IDS["HOME_POSITION"]
PARAM_VALUE: Final = struct.Struct("<4sHH16sB")
"""Fields of PARAM_VALUE: value, count, index, name, type."""
_SAME: Final = {HOME_POSITION_ID: 52}
"""Bytes of the payload that contain content, by message; the rest is the time of sending."""
_PARAM_SET: Final = MESSAGE_IDS["PARAM_SET"]
_SET_NAME: Final = slice(6, 22)
"""Bytes of the name in PARAM_SET, after value and target."""
ALL_KINDS: Final = 255
_DOWNLOAD: Final = -1
MAX_KEPT: Final = 200_000
"""Maximum number of frames, about 10 MB. A vehicle has some 1000 parameters that rarely change."""
MAX_TRANSFERS: Final = 64
"""Maximum number of transfers of missions in progress."""
DOWNLOADED_BY_FTP: Final = mavlink.MAV_COMP_ID_MISSIONPLANNER
"""Component under which MAVProxy records the parameters of a vehicle that it read from a file."""
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
    "AVAILABLE_MODES", "MISSION_CHECKSUM", "CAMERA_INFORMATION", "CAMERA_SETTINGS",
    "STORAGE_INFORMATION", "CAMERA_IMAGE_CAPTURED", "VIDEO_STREAM_INFORMATION",
    "VIDEO_STREAM_STATUS", "CAMERA_THERMAL_RANGE", "FLIGHT_INFORMATION",
    "GIMBAL_MANAGER_INFORMATION", "GIMBAL_DEVICE_INFORMATION",
)  # fmt: skip
"""Messages that a vehicle sends on request, or when they change."""
_NOT_REQUESTED: Final = frozenset({*ANSWERS.tolist(), 395, MESSAGE_IDS["COMPONENT_METADATA"]})
"""Answers to requests of other kinds, and messages that name files, which a recording lacks: the
latter include COMPONENT_INFORMATION (395), a message that the dialects lack."""
_MISSION: Final = ids_of(
    "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_ACK",
    "MISSION_WRITE_PARTIAL_LIST",
)  # fmt: skip
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


class _TransferKey(NamedTuple):
    vehicle: int
    kind: int
    """Kind of mission."""
    station: int
    """System of the station that uploads; `_DOWNLOAD` for downloads."""


@dataclass(slots=True)
class _Transfer:
    """Transfers of a mission between a vehicle and a station."""

    is_cleared: bool = False
    """Whether a station has requested to clear it, and the vehicle has not answered yet."""
    count: int | None = None
    """Number of items of the upload or download; None if there is none."""
    items: dict[int, bytes] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether all items are there."""
        return self.count is not None and len(self.items) >= self.count

    def begin(self, count: int | None, items: dict[int, bytes] | None = None) -> None:
        self.count, self.items = count, items or {}


class LogAnswers:
    """The answers in one recording of one or several parts."""

    def __init__(self) -> None:
        self.frames: dict[tuple[int, int], dict[bytes, _Course[bytes]]] = {}
        """Key: sender (system << 8 | component) and message id, and the key of the item."""
        self.missions: dict[tuple[int, int], _Course[Items]] = {}
        """Key: system and kind of mission."""
        self.seen: set[tuple[int, int]] = set()
        """Sender and message id of each message that was seen."""
        self._vehicles: dict[int, int] = {}
        self._transfers: dict[_TransferKey, _Transfer] = {}
        self._set: set[tuple[int, bytes]] = set()
        """Parameters (system, name) that a station has set and whose new value is still to come."""
        self._kept = 0

    def vehicle_of(self, system_id: int) -> int:
        """Return the sender (system << 8 | component) that is the vehicle of a system."""
        return system_id << 8 | self._vehicles.get(system_id, AUTOPILOT)

    def components(self, system_id: int) -> list[int]:
        """Return the components of a system that sent heartbeats, the vehicle first."""
        vehicle = self.vehicle_of(system_id) & 0xFF
        found = {
            origin & 0xFF for origin, message_id in self.seen
            if origin >> 8 == system_id and message_id == HEARTBEAT_ID
        }  # fmt: skip
        return [vehicle, *sorted(found - {vehicle})]

    def add(self, batch: Batch, senders: Senders) -> None:
        """Process the next records; `senders` must have processed them already."""
        systems = batch.origins >> 8
        for system in np.unique(systems).tolist():
            self._vehicles[system] = senders.vehicle(system).component
        pairs = np.unique(batch.origins << 32 | batch.message_ids)
        self.seen |= {(pair >> 32, pair & 0xFFFFFFFF) for pair in pairs.tolist()}
        companions = {
            origin
            for origin, (_, autopilot) in senders.heartbeats.items()
            if autopilot == mavlink.MAV_AUTOPILOT_INVALID
        }
        for i in np.flatnonzero(np.isin(batch.message_ids, _READ)).tolist():
            if self._kept < MAX_KEPT:
                time_us = int(batch.time_us[i])
                self.add_frame(batch.frame(i), time_us, senders.stations | companions)

    def add_frame(self, frame: bytes, time_us: int, stations: Set[int] = frozenset()) -> None:
        """Process one frame: an answer or a part of a mission; others are ignored.

        `stations` are the senders that upload missions.
        """
        message_id, (system, component) = message_id_of(frame), origin_of(frame)
        origin = system << 8 | component
        self.seen.add((origin, message_id))
        if message_id in _MISSION:
            self._add_mission(frame, time_us, is_upload=is_station(origin, stations))
        elif message_id == _PARAM_SET:
            name = payload_of(frame, _SET_NAME.stop)[_SET_NAME]
            if len(self._set) < MAX_KEPT:
                self._set.add((frame_of(frame).target[0], name))
        elif message_id in _KEPT:
            is_parameter, key = message_id == PARAM_VALUE_ID, key_of(frame)
            if is_parameter and component == DOWNLOADED_BY_FTP:
                origin = self.vehicle_of(system)
            is_set = is_parameter and (system, key) in self._set
            self._set.discard((system, key))
            courses = self.frames.setdefault((origin, message_id), {})
            course = courses.setdefault(key, _Course(is_set))
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
        for key in self._keys(vehicle, kind):
            del self._transfers[key]

    def _keys(self, vehicle: int, kind: int) -> list[_TransferKey]:
        """Return the keys of the transfers of a mission, the newest last."""
        return [key for key in self._transfers if (key.vehicle, key.kind) == (vehicle, kind)]

    def _add_mission(self, frame: bytes, time_us: int, *, is_upload: bool) -> None:
        name, message = MESSAGE_NAMES[message_id_of(frame)], fields_of(frame)
        sender, target = origin_of(frame)[0], frame_of(frame).target[0]
        vehicle, station = (target, sender) if is_upload else (sender, _DOWNLOAD)
        kind = message["mission_type"]
        for each in KINDS if kind == ALL_KINDS else (kind,):
            if each not in KINDS:
                continue
            if name == "MISSION_ACK":
                if not is_upload:
                    self._confirm(vehicle, each, target, time_us, is_accepted=not message["type"])
                continue
            transfer = self._transfer(vehicle, each, station)
            if name == "MISSION_CLEAR_ALL":
                transfer.is_cleared = is_upload
                transfer.begin(None)
            elif name == "MISSION_COUNT":
                transfer.begin(message["count"])
            elif name == "MISSION_WRITE_PARTIAL_LIST":
                self._begin_part(transfer, vehicle, each, message)
            elif transfer.count is not None and message["seq"] < transfer.count:
                self._kept += message["seq"] not in transfer.items
                transfer.items[message["seq"]] = frame
            if not is_upload and transfer.is_complete:
                self._store(vehicle, each, transfer, time_us)

    def _transfer(self, vehicle: int, kind: int, station: int) -> _Transfer:
        key = _TransferKey(vehicle, kind, station)
        if key not in self._transfers and len(self._transfers) >= MAX_TRANSFERS:
            del self._transfers[next(iter(self._transfers))]
        return self._transfers.setdefault(key, _Transfer())

    def _begin_part(self, transfer: _Transfer, vehicle: int, kind: int, message: Any) -> None:
        """Begin an upload of some items, if the others are known."""
        known = self.missions.get((vehicle, kind))
        first, last = message["start_index"], message["end_index"]
        if known is None or not 0 <= first <= last < len(known.values[-1]):
            return
        items = dict(enumerate(known.values[-1]))
        kept = {seq: item for seq, item in items.items() if not first <= seq <= last}
        transfer.begin(len(items), kept)

    def _confirm(
        self, vehicle: int, kind: int, station: int, time_us: int, *, is_accepted: bool
    ) -> None:
        """Process the vehicle's answer to an upload or to clearing a mission."""
        transfer = self._transfers.get(_TransferKey(vehicle, kind, station))
        if transfer is None and not station:
            # It is addressed to all; the newest upload is meant.
            uploads = [key for key in self._keys(vehicle, kind) if key.station != _DOWNLOAD]
            transfer = self._transfers[uploads[-1]] if uploads else None
        if transfer is None:
            return
        was_cleared, transfer.is_cleared = transfer.is_cleared, False
        if transfer.is_complete and (is_accepted or not was_cleared):
            if is_accepted:
                self._store(vehicle, kind, transfer, time_us, is_set=True)
            transfer.begin(None)
        elif was_cleared and is_accepted:
            self._store(vehicle, kind, _Transfer(count=0), time_us, is_set=True)

    def _store(
        self, vehicle: int, kind: int, transfer: _Transfer, time_us: int, *, is_set: bool = False
    ) -> None:
        """Store a mission, if it is another than before."""
        items = tuple(transfer.items[i] for i in range(transfer.count or 0))
        course = self.missions.setdefault((vehicle, kind), _Course(is_set))
        contents = [payload_of(frame, 255) for frame in items]
        if not course.values or [payload_of(f, 255) for f in course.values[-1]] != contents:
            course.add(time_us, items)


class VehicleAnswers:
    """The answers of one recorded component at the moment played, under its played id.

    `component` is by default the vehicle of its system. `newest` returns the frames played last, by
    sender (system << 8 | component) and message id.
    """

    def __init__(
        self,
        log: LogAnswers,
        system_id: int,
        played_as: int,
        position_us: Callable[[], int],
        component: int | None = None,
        newest: Callable[[int, int], list[bytes]] = lambda _origin, _message_id: [],
    ) -> None:
        self._log = log
        self._system_id = system_id
        self._component = component
        self.played_as = played_as
        self._position_us = position_us
        self._newest = newest

    @property
    def _origin(self) -> int:
        vehicle = self._log.vehicle_of(self._system_id)
        return vehicle if self._component is None else self._system_id << 8 | self._component

    def has_message(self, message_id: int) -> bool:
        """Return whether the component ever sent a message that can be requested."""
        return message_id not in _NOT_REQUESTED and (self._origin, message_id) in self._log.seen

    def frames(self, message_id: int) -> list[bytes]:
        """Return the last frames sent before the moment played, else the first ones after it.

        Of telemetry, these are the last ones played.
        """
        if message_id in _NOT_REQUESTED:
            return []
        found = [self._edited(frame) for frame in self._recorded(message_id)]
        return found or self._newest(self.played_as << 8 | self._origin & 0xFF, message_id)

    def _recorded(self, message_id: int) -> list[bytes]:
        courses = self._log.frames.get((self._origin, message_id), {}).values()
        present = (course.at(self._position_us()) for course in courses)
        return [frame for frame in present if frame is not None]

    def _edited(self, frame: bytes, **fields: int) -> bytes:
        read, system_id = frame_of(frame), self.played_as
        edited = edit_frame(read, system=system_id, fields=fields, drop_signature=True)
        return (edited or read).data

    def mission(self, kind: int) -> Items | None:
        """Return the frames of a mission's items; None if the recording has no such mission."""
        course = self._log.missions.get((self._system_id, kind))
        is_vehicle = self._origin == self._log.vehicle_of(self._system_id)
        return None if course is None or not is_vehicle else course.at(self._position_us())

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


def key_of(frame: bytes) -> bytes:
    """Return a key that distinguishes frames of one message and sender with different items."""
    message_id = message_id_of(frame)
    if message_id == PARAM_VALUE_ID:
        return bytes(PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))[3])
    names = DISTINGUISHED_BY.get(message_id)
    if names is None:
        return b""
    fields = fields_of(frame)
    return repr([fields[name] for name in names]).encode()


def content_of(frame: bytes) -> bytes:
    """Return the bytes of a stored frame that change with its content."""
    message_id = message_id_of(frame)
    if message_id == PARAM_VALUE_ID:
        value, _, _, _, kind = PARAM_VALUE.unpack(payload_of(frame, PARAM_VALUE.size))
        return bytes((*value, kind))
    payload = payload_of(frame, _SAME.get(message_id, 255))
    at = BOOT_TIME_OFFSETS.get(message_id, 255)
    return payload[:at] + payload[at + BOOT_TIME_BYTES :]
