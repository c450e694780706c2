"""Answers of a live vehicle, collected as they pass between it and ground stations.

| answer                     | source                           | dropped by                     |
| -------------------------- | -------------------------------- | ------------------------------ |
| parameters                 | PARAM_VALUE, the newest of each  | PARAM_SET: that one; another   |
|                            | name                             | checksum, some commands: all   |
| mission, fence, rally      | a whole download, or an upload   | the start of an upload;        |
| points                     | that the vehicle has accepted    | another id or another home     |
| version, metadata          | AUTOPILOT_VERSION,               | another version                |
|                            | COMPONENT_METADATA               |                                |
| files of metadata          | a file that was read completely  | a write by MAVLink FTP         |

All answers are dropped when the vehicle restarts or reports another version. A value or plan that a
station sends is dropped at once and stored again when the vehicle confirms it, so a lost
confirmation does no harm.
"""

import struct
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from gateway.answers.log_answers import ALL_KINDS, PARAM_VALUE, Items, LogAnswers, content_of
from gateway.units import US_PER_S
from gateway.vehicle.plan import KINDS
from gateway.vehicle.services.ftp import (
    ACK,
    WRITING,
    FtpError,
    Opcode,
    Packet,
    decode_packet,
    full_path,
)
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import BOOT_TIME_OFFSETS, boot_time_us, ids_of
from gateway.wire.mavlink_splitter import MavFrame
from gateway.wire.recorded_frames import payload_of

HASH_NAME: Final = "_HASH_CHECK"
"""Name of PX4's checksum of all parameters."""
SHOWN_IDS: Final = ids_of("AUTOPILOT_VERSION", "PROTOCOL_VERSION", "COMPONENT_METADATA")
"""Messages with content that is constant until a restart."""
NOTED_IDS: Final = (
    SHOWN_IDS | BOOT_TIME_OFFSETS.keys() | ids_of("PARAM_VALUE", "MISSION_CURRENT", "HOME_POSITION")
)
"""Messages without a target that are evaluated here."""
MISSION_IDS: Final = ids_of("MISSION_COUNT", "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_ACK")
"""Messages of a vehicle that are part of mission transfers."""
CHANGING: Final = frozenset(
    (
        mavlink.MAV_CMD_PREFLIGHT_STORAGE, mavlink.MAV_CMD_PREFLIGHT_CALIBRATION,
        mavlink.MAV_CMD_PREFLIGHT_SET_SENSOR_OFFSETS, mavlink.MAV_CMD_DO_START_MAG_CAL,
        mavlink.MAV_CMD_DO_ACCEPT_MAG_CAL,
    )
)  # fmt: skip
"""Commands that can change any parameter or mission."""
STORE: Final = (mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1.0)
"""Command and param1 that store the parameters; QGroundControl sends it after a change."""
NO_INDEX: Final = 0xFFFF
"""Index in the PARAM_VALUE by which ArduPilot confirms a setting, and in that of the checksum."""
RESTART_US: Final = 5 * US_PER_S
"""Change of the boot time that indicates a restart, or another vehicle; congestion delays frames by
less."""
FRESH_US: Final = 10 * US_PER_S
"""Maximum time without a boot time; after it, the vehicle may have restarted unnoticed."""
PACKED: Final = "/param.pck"
"""ArduPilot's file that contains all parameters."""
METADATA_FILES: Final = (".json", ".json.xz", ".json.gz", PACKED)
MAX_BYTES: Final = 1_000_000
"""Limit for one vehicle: 1000 parameters take 40 kB, the metadata of PX4 about 300 kB."""
MAX_READS: Final = 8
"""Maximum number of file reads in progress, and of stations whose requests for files are known."""
MAX_ASKED: Final = 64
"""Maximum requests of one station for files that are known; it repeats older ones."""
BURST_ANSWERS: Final = 4096
"""Maximum answers to one request of a burst: a file of a megabyte."""
READING: Final = (Opcode.READ_FILE, Opcode.BURST_READ_FILE)
PARAMETERS: Final = "parameters"

_PLAN_IDS: Final = struct.Struct("<2xH2xIII")
"""Fields of MISSION_CURRENT: number of items, and the ids of mission, fence and rally points."""
_HOME_BYTES: Final = 12
FTP_PAYLOAD: Final = slice(3, 254)
"""Bytes of the payload in FILE_TRANSFER_PROTOCOL."""
SEQUENCE_MASK: Final = 0xFFFF
"""Sequence numbers of MAVLink FTP have 16 bits."""


class Reader(NamedTuple):
    """A station that reads files: its client, and its system and component."""

    client_id: int
    station: tuple[int, int]


def _answers_to(request: Packet, answer: Packet) -> bool:
    """Return whether a packet is an answer to a request, by opcode, number, session and offset."""
    after = (answer.sequence - request.sequence) & SEQUENCE_MASK
    if answer.request_opcode != request.opcode:
        return False
    if request.opcode == Opcode.OPEN_FILE_RO or answer.opcode != ACK:
        return after == 1
    if request.opcode == Opcode.BURST_READ_FILE:
        is_part = 1 <= after <= BURST_ANSWERS and answer.offset >= request.offset
    else:
        is_part = after == 1 and answer.offset == request.offset
    return is_part and answer.session == request.session


@dataclass(slots=True)
class _Reading:
    """A file while a station reads it."""

    path: str
    session: int = -1
    size: int = MAX_BYTES
    chunks: dict[int, bytes] = field(default_factory=dict)

    def content(self) -> bytes | None:
        """Return the whole file; None while some of it is missing."""
        if sum(map(len, self.chunks.values())) < self.size:
            return None
        found = bytearray()
        for begin in sorted(self.chunks):
            if begin > len(found):
                return None
            found[begin:] = self.chunks[begin]
        return bytes(found) if len(found) == self.size else None


class LiveAnswers:
    """Answers that a vehicle has given since its start; see `recorded_vehicle.Answers`."""

    def __init__(self, system_id: int) -> None:
        self.system_id = system_id
        self._ordered: dict[str, bytes] | None = None
        """The parameters in their order; None after a change."""
        self._booted_us: int | None = None
        self._timed_us = 0
        """When a time since boot was last received."""
        self.clear()

    def clear(self) -> None:
        """Drop all answers."""
        self.files: dict[str, bytes] = {}
        """Content by path and query."""
        self.since_us: dict[str, int] = {}
        """When each part became complete, by the name of the part."""
        self._log = LogAnswers()
        self._shown: dict[int, bytes] = {}
        self._home = b""
        self._plan_ids: dict[int, int] = {}
        self._readings: dict[Reader, _Reading] = {}
        self._asked: dict[Reader, deque[Packet]] = {}
        """The newest requests for files, by their sender."""
        self._uploader = (0, 0)
        """System and component of the station that most recently began to upload a mission."""
        self._drop_parameters()

    def is_fresh(self, now_us: int) -> bool:
        """Return whether a restart of the vehicle is ruled out."""
        return self._booted_us is not None and now_us - self._timed_us <= FRESH_US

    @property
    def size(self) -> int:
        """Number of bytes stored."""
        items = [each for kind in KINDS for each in self.mission(kind) or ()]
        reads = [each for one in self._readings.values() for each in one.chunks.values()]
        parts = (self._values.values(), self.files.values(), items, reads, self._log.pending())
        return sum(len(each) for part in parts for each in part)

    def has_message(self, message_id: int) -> bool:
        """Return whether a message is stored."""
        return message_id in self._shown

    def frames(self, message_id: int) -> list[bytes]:
        """Return the frames that answer a request for a message."""
        return [self._shown[message_id]] if message_id in self._shown else []

    def mission(self, kind: int) -> Items | None:
        """Return the frames of a mission's items; None if they are not known."""
        course = self._log.missions.get((self.system_id, kind))
        return None if course is None else course.values[-1]

    def parameters(self) -> dict[str, bytes]:
        """Return the PARAM_VALUE frames by name, in the order of their indices."""
        if self._ordered is None:
            order = sorted(self._values, key=self._indices.__getitem__)
            self._ordered = {name: self._values[name] for name in order}
        return self._ordered

    @property
    def missing(self) -> int | None:
        """Number of unknown parameters; None if none is known yet."""
        return self._count - len(self._values) if self._values else None

    def add(self, frame: MavFrame, now_us: int) -> None:
        """Process a frame of the vehicle."""
        booted_us = boot_time_us(frame, now_us)
        if booted_us is not None:
            if self._booted_us is not None and abs(booted_us - self._booted_us) > RESTART_US:
                self.clear()
            self._booted_us, self._timed_us = booted_us, now_us
        match frame.message_id:
            case mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
                self._add_parameter(frame, now_us)
            case mavlink.MAVLINK_MSG_ID_MISSION_CURRENT:
                self._add_plan_ids(frame)
            case mavlink.MAVLINK_MSG_ID_HOME_POSITION:
                self._add_home(frame)
            case mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL:
                self._add_file(frame, now_us)
            case shown if shown in SHOWN_IDS:
                self._add_shown(frame, now_us)
            case mavlink.MAVLINK_MSG_ID_MISSION_ACK if frame.target != self._uploader:
                # Several stations are uploading; the vehicle accepts the items of one of them.
                pass
            case part if part in MISSION_IDS:
                self._add_mission(frame, now_us, is_upload=False)

    def add_request(self, client_id: int, message: Any, frame: MavFrame, now_us: int) -> None:
        """Process a request from a station to the vehicle."""
        match message.get_type():
            case "PARAM_SET" if message.param_id != HASH_NAME:
                self._values.pop(message.param_id, None)
                self._drop_dependent()
            case "COMMAND_LONG" | "COMMAND_INT" if message.command in CHANGING:
                if (message.command, message.param1) != STORE:
                    self._drop_parameters()
                    self._drop_missions(ALL_KINDS)
            case "FILE_TRANSFER_PROTOCOL":
                self._add_file_request(bytes(message.payload), Reader(client_id, frame.origin))
            case "MISSION_COUNT" | "MISSION_CLEAR_ALL" | "MISSION_WRITE_PARTIAL_LIST":
                self._drop_missions(message.mission_type)
                self._uploader = frame.origin
                self._add_mission(frame, now_us, is_upload=True)
            case "MISSION_ITEM" | "MISSION_ITEM_INT" if frame.origin == self._uploader:
                self._add_mission(frame, now_us, is_upload=True)

    def _drop_missions(self, kind: int) -> None:
        for each in KINDS if kind == ALL_KINDS else (kind,):
            self._log.drop_mission(self.system_id, each)
            self._plan_ids.pop(each, None)
            self.since_us.pop(KINDS.get(each, ""), None)

    def _drop_parameters(self) -> None:
        self._values: dict[str, bytes] = {}
        self._indices: dict[str, int] = {}
        self._count = 0
        self._drop_dependent()
        self.since_us.pop(PARAMETERS, None)

    def _drop_dependent(self) -> None:
        """Drop everything that a changed parameter invalidates."""
        self._ordered = None
        self.hash_frame: bytes | None = None
        """PARAM_VALUE with the checksum of the known parameters."""
        kept = self.files.items()
        self.files = {path: content for path, content in kept if PACKED not in path}
        readings = self._readings.items()
        self._readings = {key: one for key, one in readings if PACKED not in one.path}

    def _add_parameter(self, frame: MavFrame, now_us: int) -> None:
        payload = payload_of(frame.data, PARAM_VALUE.size)
        value, count, index, raw_name, _ = PARAM_VALUE.unpack(payload)
        name = text_of(raw_name)
        if name == HASH_NAME:
            if self.hash_frame is not None and payload_of(self.hash_frame, 4) != value:
                self._drop_parameters()
            self.hash_frame = frame.data
            return
        if index == NO_INDEX:
            index = self._indices.get(name, NO_INDEX)
        if self._indices.get(name, index) != index or self._count not in (0, count):
            # Parameters were enabled or disabled, which changes all indices.
            self._drop_parameters()
        self._count = count
        known = self._values.get(name)
        if known is not None and content_of(known) != content_of(frame.data):
            # Drop the old value first: the new one may exceed the limit.
            del self._values[name]
            self._drop_dependent()
        if index < count and self.size < MAX_BYTES:
            fields = {"param_index": index, "param_count": count}
            kept = edit_frame(frame, fields=fields, drop_signature=True)
            self._values[name], self._indices[name] = (kept or frame).data, index
            self._ordered = None
        if len(self._values) == count:
            self.since_us.setdefault(PARAMETERS, now_us)

    def _add_plan_ids(self, frame: MavFrame) -> None:
        # The dialect lacks the ids; for a vehicle that sends none, the number of items is used.
        count, *ids = _PLAN_IDS.unpack(payload_of(frame.data, _PLAN_IDS.size))
        for kind, number in zip(KINDS, (ids[0] or count, *ids[1:]), strict=True):
            if self._plan_ids.setdefault(kind, number) != number:
                self._drop_missions(kind)

    def _add_home(self, frame: MavFrame) -> None:
        # Item 0 of ArduPilot's missions is the home position.
        home = payload_of(frame.data, _HOME_BYTES)
        if self._home not in (b"", home):
            self._drop_missions(mavlink.MAV_MISSION_TYPE_MISSION)
        self._home = home

    def _add_shown(self, frame: MavFrame, now_us: int) -> None:
        version = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        known = self._shown.get(version)
        is_other = known is not None and payload_of(known, 255) != payload_of(frame.data, 255)
        if frame.message_id == version and is_other:
            self.clear()
        self._shown[frame.message_id] = frame.data
        self.since_us["version"] = now_us

    def _add_mission(self, frame: MavFrame, now_us: int, *, is_upload: bool) -> None:
        before = {kind: self.mission(kind) for kind in KINDS}
        if self.size < MAX_BYTES:
            system, component = frame.origin
            stations = {system << 8 | component} if is_upload else set()
            self._log.add_frame(frame.data, now_us, stations)
        for kind, name in KINDS.items():
            if self.mission(kind) is not before[kind]:
                course = self._log.missions[self.system_id, kind]
                del course.values[:-1], course.times[:-1]
                self._plan_ids.pop(kind, None)
                self.since_us[name] = now_us

    def remove_client(self, client_id: int) -> None:
        """Discard what a client was reading that has gone."""
        readings = self._readings.items()
        self._readings = {key: one for key, one in readings if key.client_id != client_id}
        self._asked = {key: one for key, one in self._asked.items() if key.client_id != client_id}

    def asker(self, frame: MavFrame) -> int | None:
        """Return the client that requested the content of a frame; None if several may have."""
        reader = self._reader(frame.target, _packet_of(frame))
        return None if reader is None else reader.client_id

    def _reader(self, station: tuple[int, int], packet: Packet) -> Reader | None:
        """Return the reader that a packet answers, if no other of the same id may have asked."""
        found = [
            reader
            for reader, asked in self._asked.items()
            if reader.station == station and any(_answers_to(each, packet) for each in asked)
        ]
        if len(found) > 1:
            # Each of them may get the content of the other's file.
            for reader in found:
                self._readings.pop(reader, None)
        return found[0] if len(found) == 1 else None

    def _add_file_request(self, payload: bytes, reader: Reader) -> None:
        packet = decode_packet(payload)
        if packet.opcode in WRITING:
            self.clear()
            return
        if reader not in self._asked and len(self._asked) >= MAX_READS:
            self._readings.pop(next(iter(self._asked)), None)
            self._asked.pop(next(iter(self._asked)))
        self._asked.setdefault(reader, deque(maxlen=MAX_ASKED)).append(packet)
        if packet.opcode == Opcode.OPEN_FILE_RO:
            path = full_path(packet)
            self._readings.pop(reader, None)
            if path.partition("?")[0].endswith(METADATA_FILES) and len(self._readings) < MAX_READS:
                self._readings[reader] = _Reading(path)

    def _add_file(self, frame: MavFrame, now_us: int) -> None:
        packet = _packet_of(frame)
        reader = self._reader(frame.target, packet)
        reading = self._readings.get(reader) if reader is not None else None
        if reader is None or reading is None:
            return
        if packet.request_opcode == Opcode.OPEN_FILE_RO and packet.opcode == ACK:
            reading.session = packet.session
            reading.size = int.from_bytes(packet.data[:4], "little")
            for other, rest in [*self._readings.items()]:
                # The vehicle has opened another file in the session of a station of the same id.
                is_of_same_id = other != reader and other.station == reader.station
                if is_of_same_id and rest.session == packet.session:
                    del self._readings[other]
        elif packet.session != reading.session or packet.request_opcode not in READING:
            return
        elif packet.opcode == ACK and packet.data and self.size < MAX_BYTES:
            reading.chunks[packet.offset] = packet.data
        elif PACKED in reading.path and packet.data[:1] == bytes((FtpError.EOF,)):
            # ArduPilot does not announce the size of a file that it generates while it is read.
            reading.size = sum(map(len, reading.chunks.values()))
        content = reading.content()
        if content:
            self.files[reading.path] = content
            self.since_us["files"] = now_us
            del self._readings[reader]


def _packet_of(frame: MavFrame) -> Packet:
    return decode_packet(payload_of(frame.data, FTP_PAYLOAD.stop)[FTP_PAYLOAD])
