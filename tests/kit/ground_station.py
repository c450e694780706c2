"""A scripted ground station: it asks the pure vehicle, on a clock of its own, over a lossy link.

The clients of the mission, parameter and file protocols work with any station that has the same
verbs, such as the one of the end-to-end tests.
"""

import math
import struct
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.vehicle.recorded_vehicle import RecordedVehicle
from gateway.vehicle.service import Action
from gateway.vehicle.services.ftp import ACK, Opcode, Packet, decode_packet
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock
from tests.kit.records import sample_at, state_at

OWN_MESSAGES = {
    300: ("PROTOCOL_VERSION", 217),
    397: ("COMPONENT_METADATA", 182),
    435: ("AVAILABLE_MODES", 134),
    436: ("CURRENT_MODE", 193),
    512: ("CONTROL_STATUS", 21),
}
"""Messages that pymavlink's dialect lacks: name, and the CRC_EXTRA published with the standard."""


class Foreign:
    """A message that pymavlink cannot decode, with its CRC checked here."""

    def __init__(self, frame: bytes) -> None:
        self.number = int.from_bytes(frame[7:10], "little")
        self.kind, extra = OWN_MESSAGES[self.number]
        self.payload = frame[10 : 10 + frame[1]].ljust(255, b"\0")
        crc = mavlink.x25crc(bytearray(frame[1 : 10 + frame[1]]) + bytes([extra])).crc
        assert crc == struct.unpack_from("<H", frame, 10 + frame[1])[0]

    def get_type(self) -> str:
        return self.kind


def decode(found: Iterable[Any]) -> list[Any]:
    """Decode the frames among some actions with a parser of its own; all must be well-formed."""
    parser = mavlink.MAVLink(None)
    messages: list[Any] = []
    for action in found:
        if not isinstance(action, Outgoing):
            continue
        if action.frame[0] == mavlink.PROTOCOL_MARKER_V2 and action.message_id in OWN_MESSAGES:
            message: Any = Foreign(action.frame)
            number = message.number
        else:
            message = parser.decode(bytearray(action.frame))
            number = message.get_msgId()
            assert not message.get_type().startswith("UNKNOWN")
        assert number == action.message_id
        messages.append(message)
    return messages


def of_kind(found: Iterable[Any], *kinds: str) -> list[Any]:
    """Return the messages of some kinds, among messages or among actions with their frames."""
    found = list(found)
    messages = decode(found) or [each for each in found if hasattr(each, "get_type")]
    return [m for m in messages if not kinds or m.get_type() in kinds]


def kinds(found: Iterable[Any]) -> list[str]:
    return [message.get_type() for message in of_kind(found)]


def texts(found: Iterable[Any]) -> list[str]:
    """Return the texts of STATUSTEXT, with their chunks joined."""
    joined: list[str] = []
    for message in of_kind(found, "STATUSTEXT"):
        if message.chunk_seq:
            joined[-1] += message.text
        else:
            joined.append(message.text)
    return joined


def results(found: Iterable[Any]) -> list[int]:
    """Return the results of COMMAND_ACK."""
    return [message.result for message in of_kind(found, "COMMAND_ACK")]


class GroundStation:
    """One client of one vehicle."""

    slice_s = 0.05
    patience = 1
    """Slices of time before it asks again."""

    def __init__(
        self,
        vehicle: Vehicle | RecordedVehicle,
        clock: ManualClock,
        *,
        client_id: int = 7,
        system_id: int = 255,
        trusted: bool = True,
        version: int = 2,
        loses: Callable[[str, Any], bool] = lambda *_: False,
    ) -> None:
        self.vehicle: Any = vehicle
        self.clock = clock
        self.client_id = client_id
        self.target = (vehicle.system_id, 1)
        self.trusted = trusted
        self.version = version
        self.loses = loses
        """Whether a message is lost: the way ("up" to the vehicle or "down") and the message."""
        self.mav = mavlink.MAVLink(None, system_id, 190)
        self.inbox: list[Any] = []
        self.actions: list[Action] = []
        """What the vehicle asked of the gateway."""
        self.frames: list[Outgoing] = []
        """Every frame that its requests led to, whomever it is for."""

    def other(self, client_id: int = 8, **changes: Any) -> "GroundStation":
        """Return another client of the same vehicle."""
        return GroundStation(self.vehicle, self.clock, client_id=client_id, **changes)

    def frame(self, message: Any) -> bytes:
        data = message.pack(self.mav, force_mavlink1=self.version == 1)
        self.mav.seq = (self.mav.seq + 1) % 256
        return bytes(data)

    def send(self, message: Any) -> list[Any]:
        """Send one message; return the messages that come back at once."""
        if self.loses("up", message):
            return []
        return self.send_bytes(self.frame(message))

    def send_bytes(self, frame: bytes) -> list[Any]:
        incoming = Incoming(self.client_id, frame, self.trusted)
        return self.receive(self.vehicle.handle(incoming, self.clock.now_us))

    def receive(self, actions: Iterable[Action]) -> list[Any]:
        actions = list(actions)
        frames = [action for action in actions if isinstance(action, Outgoing)]
        self.actions += [action for action in actions if not isinstance(action, Outgoing)]
        self.frames += frames
        mine = decode(frame for frame in frames if frame.client_id in (None, self.client_id))
        found = [message for message in mine if not self.loses("down", message)]
        self.inbox += found
        return found

    def wait(self, seconds: float) -> list[Any]:
        """Let time pass, polling the vehicle when it is due."""
        found = []
        end_us = self.clock.now_us + round(seconds * 1e6)
        while (due_us := self.vehicle.next_due_us()) is not None and due_us <= end_us:
            self.clock.now_us = max(self.clock.now_us, due_us)
            found += self.receive(self.vehicle.poll(self.clock.now_us))
        self.clock.now_us = end_us
        return found

    def fly(
        self,
        seconds: float,
        rate_hz: float = 200.0,
        motion: Callable[[float], dict[str, Any]] = lambda _: {},
        only: Container[int] = range(1 << 24),
        **state: Any,
    ) -> list[Any]:
        """Feed the vehicle IMU samples; return the messages that reach this client.

        `motion` returns what differs in a sample at a time in s; `only` has the numbers of the
        messages that are decoded, `state` what differs in the estimator's output.
        """
        found: list[Action] = []
        for _ in range(round(seconds * rate_hz)):
            now_us = self.clock.advance(1.0 / rate_hz)
            sample = sample_at(now_us, **motion(now_us * 1e-6))
            found += self.vehicle.on_state(state_at(now_us, **state), sample, now_us)
            found += self.vehicle.poll(now_us)
        return self.receive(
            each for each in found if not isinstance(each, Outgoing) or each.message_id in only
        )

    def ask(self, message: Any, *kinds: str, retries: int = 5, timeout_s: float = 1.0) -> list[Any]:
        """Send until one of the kinds comes back, as ground stations do; the answers since."""
        for _ in range(retries):
            found = self.send(message)
            if not of_kind(found, *kinds):
                found += self.wait(timeout_s)
            if answers := of_kind(found, *kinds):
                return answers
        raise AssertionError(f"no {' or '.join(kinds)} after {retries} tries")

    def command(
        self, number: int, *params: float, target: tuple[int, int] | None = None
    ) -> list[Any]:
        return self.send(command(number, *params, target=target or self.target))

    def request(self, message_id: int, index: int = 0) -> list[Any]:
        return self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id, index)

    def set_parameter(
        self, name: str, value: float, kind: int = mavlink.MAV_PARAM_TYPE_REAL32
    ) -> list[Any]:
        """Set a parameter."""
        return self.send(
            mavlink.MAVLink_param_set_message(*self.target, name.encode(), value, kind)
        )

    @property
    def broadcasts(self) -> set[str]:
        """Kinds of message that went to all."""
        return set(kinds(frame for frame in self.frames if frame.client_id is None))

    def of(self, kind: type[Action]) -> list[Any]:
        return [action for action in self.actions if isinstance(action, kind)]

    @property
    def requested_intervals(self) -> list[ClientInterval]:
        return self.of(ClientInterval)


def to_vehicle(name: str, *fields: Any, target: tuple[int, int] = (1, 1)) -> Any:
    """Return a message to a vehicle, such as MISSION_COUNT."""
    return getattr(mavlink, f"MAVLink_{name.lower()}_message")(*target, *fields)


def command(number: int, *params: float, target: tuple[int, int] = (1, 1)) -> Any:
    padded = [*params, *[0.0] * (7 - len(params))]
    return mavlink.MAVLink_command_long_message(*target, number, 0, *padded)


def command_int(number: int, x: int, y: int, z: float, frame: int = 5) -> Any:
    """Return a COMMAND_INT; frame 5 is the global one with integers."""
    return to_vehicle("COMMAND_INT", frame, number, 0, 0, 0, 0, 0, 0, x, y, z)


@dataclass
class Ready:
    """What QGroundControl knows of a vehicle when its initial connection is complete."""

    modes: list[str]
    parameters: dict[str, float]
    plans: tuple[int, int, int] = (0, 0, 0)
    """Number of items of mission, fence and rally points."""
    cameras: list[int] = field(default_factory=list)
    """Components that sent CAMERA_INFORMATION."""


def qgroundcontrol(station: Any, *, one_by_one: bool = True) -> Ready:
    """Ask what QGroundControl asks, in the order of its state machine, with its patience.

    Releases before 2026 request the modes `one_by_one`, and are not ready until the last one has
    come or one was refused; newer ones request all of them, and wait for the last one. Of an
    ArduPilot with files, the parameters are first requested as a file.
    """
    version = _request(station, 148, "AUTOPILOT_VERSION")
    assert _request(station, 300, "PROTOCOL_VERSION") is not None, "QGroundControl uses MAVLink 1"
    modes = _load_modes(station, one_by_one=one_by_one)
    if _request(station, 397, "COMPONENT_METADATA") is None:
        assert _request(station, 395, "COMPONENT_INFORMATION") is None
    if version is not None and version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_FTP:
        path = b"@PARAM/param.pck?withdefaults=1"
        packet = Packet(1, 0, Opcode.OPEN_FILE_RO, len(path), 0, 0, 0, path)
        station.ask(ftp_message(packet, station.target), "FILE_TRANSFER_PROTOCOL", timeout_s=0.05)
    parameters = load_parameters(station)
    plans = [_load_plan(station, kind) for kind in ((0, 1, 2) if station.version == 2 else (0,))]
    cameras = [
        component for component in range(100, 106)
        if any(m.get_srcComponent() == component for m in of_kind(station.inbox, "HEARTBEAT"))
        and _request(station, 259, "CAMERA_INFORMATION", component=component)
    ]  # fmt: skip
    _request(station, 280, "GIMBAL_MANAGER_INFORMATION")
    mission, fence, rally = *plans, *[0] * (3 - len(plans))
    return Ready(modes, parameters, (mission, fence, rally), cameras)


def _load_modes(station: Any, *, one_by_one: bool) -> list[str]:
    names: dict[int, str] = {}
    index, count = 0, 255
    while index < count:
        answer = _request(station, 435, "AVAILABLE_MODES", index + 1 if one_by_one else 0)
        found = of_kind(station.inbox, "AVAILABLE_MODES")
        names |= {m.payload[9]: bytes(m.payload[11:46]).rstrip(b"\0").decode() for m in found}
        if answer is None:
            break
        assert not one_by_one or answer.payload[9] == index + 1
        index, count = max(names), answer.payload[8]
    return list(names.values())


def _load_plan(station: Any, kind: int) -> int:
    listing = to_vehicle("MISSION_REQUEST_LIST", kind, target=station.target)
    count = station.ask(listing, "MISSION_COUNT", timeout_s=0.05)[-1].count
    for seq in range(count):
        request = to_vehicle("MISSION_REQUEST_INT", seq, kind, target=station.target)
        items = station.ask(request, "MISSION_ITEM_INT", timeout_s=0.05)
        assert items[-1].seq == seq
    station.send(to_vehicle("MISSION_ACK", 0, kind, target=station.target))
    return int(count)


def _request(
    station: Any, message_id: int, kind: str, index: int = 0, component: int = 1
) -> Any | None:
    """Ask for a message until it comes; None if it is refused."""
    found: list[Any] = []
    target = (station.target[0], component)
    for _ in range(8):
        request = command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id, index, target=target)
        found += station.send(request)
        for _ in range(station.patience):
            if any(results(found)):
                return None
            if {"COMMAND_ACK", kind} <= set(kinds(found)):
                return of_kind(found, kind)[-1]
            found += station.wait(station.slice_s)
    raise AssertionError(f"{kind} never came")


def load_parameters(station: Any) -> dict[str, float]:
    """List all, then ask for each missing one by its index; the values by name."""
    listing = mavlink.MAVLink_param_request_list_message(station.target[0], 0)
    first, *_ = station.ask(listing, "PARAM_VALUE", timeout_s=0.05)
    count = first.param_count

    def had() -> dict[int, Any]:
        return {m.param_index: m for m in of_kind(station.inbox, "PARAM_VALUE")}

    quiet_s = 0.0
    while len(had()) < count and quiet_s < 0.1:
        fresh = "PARAM_VALUE" in kinds(station.wait(station.slice_s))
        quiet_s = 0.0 if fresh else quiet_s + station.slice_s
    for _ in range(20 * count):
        # What comes next may be another one: still of the list, or asked for before.
        if not (missing := set(range(count)) - set(had())):
            break
        read = to_vehicle("PARAM_REQUEST_READ", b"", min(missing), target=station.target)
        station.ask(read, "PARAM_VALUE", retries=20, timeout_s=0.01)
    assert set(had()) == set(range(count))
    return {m.param_id: m.param_value for m in had().values()}


MISSION, FENCE, RALLY, ALL = 0, 1, 2, 255
ITEM_COMMANDS = {MISSION: 16, FENCE: 5001, RALLY: 5100}
"""Waypoint, vertex of a polygon, rally point."""


def item(seq: int, kind: int = MISSION, **changes: Any) -> Any:
    fields: dict[str, Any] = {
        "target_system": 1,
        "target_component": 1,
        "seq": seq,
        "frame": mavlink.MAV_FRAME_GLOBAL_INT,
        "command": ITEM_COMMANDS[kind],
        "current": 0,
        "autocontinue": 1,
        "param1": 1.5,
        "param2": 0.0,
        "param3": 0.0,
        "param4": math.nan,
        "x": 471_000_000 + 1000 * seq,
        "y": -87_000_000 - 1000 * seq,
        "z": 600.0 + seq,
        "mission_type": kind,
    }
    return mavlink.MAVLink_mission_item_int_message(**(fields | changes))


def count(number: int, kind: int = MISSION) -> Any:
    return to_vehicle("MISSION_COUNT", number, kind)


def request_item(seq: int, kind: int = MISSION) -> Any:
    return to_vehicle("MISSION_REQUEST_INT", seq, kind)


def upload(station: Any, items: list[Any], kind: int = MISSION) -> int | None:
    """Upload as a ground station does: answer each request; the result of the ACK, if one comes."""
    wanted = ("MISSION_REQUEST_INT", "MISSION_ACK")
    found = station.ask(count(len(items), kind), *wanted)
    for _ in range(100 + 20 * len(items)):
        if found and found[-1].get_type() == "MISSION_ACK":
            return int(found[-1].type)
        found = station.send(items[found[-1].seq]) if found else station.wait(0.25)
        found = of_kind(found, *wanted)
    return None


def download(station: Any, kind: int = MISSION) -> list[Any]:
    listing = to_vehicle("MISSION_REQUEST_LIST", kind)
    [first, *_] = station.ask(listing, "MISSION_COUNT", retries=20)
    assert first.mission_type == kind
    items: dict[int, Any] = {}
    for _ in range(20 * first.count):
        if (seq := len(items)) == first.count:
            break
        # An item that was asked for twice is answered twice.
        asked = request_item(seq, kind)
        for m in station.ask(asked, "MISSION_ITEM_INT", retries=20, timeout_s=0.25):
            if m.seq == seq:
                items[seq] = m
    assert list(items) == list(range(first.count))
    station.send(to_vehicle("MISSION_ACK", mavlink.MAV_MISSION_ACCEPTED, kind))
    return list(items.values())


def content(message: Any) -> tuple[Any, ...]:
    """Return what an item means, without its target."""
    floats = (message.param1, message.param2, message.param3, message.z)
    assert math.isnan(message.param4)
    return (message.seq, message.frame, message.command, message.autocontinue, message.x,
            message.y, *floats, message.mission_type)  # fmt: skip


class FtpClient:
    """A client that reads files as QGroundControl does."""

    def __init__(self, station: GroundStation) -> None:
        self.station = station
        self.sequence = 0

    def packet(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        self.sequence += 1
        plain = {"session": 0, "size": len(data), "offset": 0} | fields
        return Packet(
            self.sequence, plain["session"], opcode, plain["size"], 0, 0, plain["offset"], data
        )

    def send(self, packet: Packet) -> list[Packet]:
        return self.packets(self.station.send(ftp_message(packet, self.station.target)))

    def packets(self, messages: list[Any]) -> list[Packet]:
        found = of_kind(messages, "FILE_TRANSFER_PROTOCOL")
        return [decode_packet(bytes(message.payload)) for message in found]

    def ask(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        packet = self.packet(opcode, data, **fields)
        for _ in range(50):
            if answers := self.send(packet):
                return answers[0]
        raise AssertionError("no answer")

    def open(self, path: bytes, **fields: int) -> Packet:
        return self.ask(Opcode.OPEN_FILE_RO, path, **fields)

    def read(self, path: bytes) -> bytes:
        opened = self.open(path)
        assert opened.opcode == ACK
        size = struct.unpack("<I", opened.data)[0]
        content = bytearray(size)
        missing = set(range(size))
        burst = self.packet(Opcode.BURST_READ_FILE, session=opened.session, size=239)
        pieces = self.send(burst) + self.packets(self.station.wait(0.5))
        if len(pieces) * 239 >= size:  # none was lost
            after = range(burst.sequence + 1, burst.sequence + 1 + len(pieces))
            assert [piece.sequence for piece in pieces] == list(after)
        for piece in pieces:
            content[piece.offset : piece.offset + piece.size] = piece.data
            missing -= set(range(piece.offset, piece.offset + piece.size))
        while missing:
            start = min(missing)
            piece = self.ask(Opcode.READ_FILE, session=opened.session, size=100, offset=start)
            content[start : start + piece.size] = piece.data
            missing -= set(range(start, start + piece.size))
        assert self.ask(Opcode.TERMINATE_SESSION, session=opened.session).opcode == ACK
        return bytes(content)


def ftp_message(packet: Packet, target: tuple[int, int] = (1, 1)) -> Any:
    return mavlink.MAVLink_file_transfer_protocol_message(0, *target, packet.encode())


def ftp_request(opcode: int, data: bytes = b"", offset: int = 0) -> Any:
    """Return a first request, such as to open a file."""
    return ftp_message(Packet(1, 0, opcode, len(data), 0, 0, offset, data))
