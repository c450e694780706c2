"""A scripted ground station: it asks the pure vehicle, on a clock of its own, over a lossy link."""

import struct
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.vehicle.requests import Action
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock

OWN_MESSAGES = {
    300: ("PROTOCOL_VERSION", 217),
    397: ("COMPONENT_METADATA", 182),
    435: ("AVAILABLE_MODES", 134),
    436: ("CURRENT_MODE", 193),
    512: ("CONTROL_STATUS", 21),
}
"""What pymavlink's dialect lacks: name, and the CRC_EXTRA published with the standard."""


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


class GroundStation:
    """One client of one vehicle."""

    slice_s = 0.05
    patience = 1
    """Slices of time before it asks again."""

    def __init__(
        self,
        vehicle: Vehicle,
        clock: ManualClock,
        *,
        client_id: int = 7,
        system_id: int = 255,
        trusted: bool = True,
        version: int = 2,
        loses: Callable[[str, Any], bool] = lambda *_: False,
    ) -> None:
        self.vehicle = vehicle
        self.clock = clock
        self.client_id = client_id
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
        self._parser = mavlink.MAVLink(None)

    def frame(self, message: Any) -> bytes:
        data = message.pack(self.mav, force_mavlink1=self.version == 1)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def send(self, message: Any) -> list[Any]:
        """Send one message; what comes back at once."""
        if self.loses("up", message):
            return []
        return self.send_bytes(self.frame(message))

    def send_bytes(self, frame: bytes) -> list[Any]:
        incoming = Incoming(self.client_id, frame, self.trusted)
        return self.receive(self.vehicle.handle(incoming, self.clock.now_us))

    def receive(self, actions: list[Action]) -> list[Any]:
        found = []
        for action in actions:
            if not isinstance(action, Outgoing):
                self.actions.append(action)
                continue
            self.frames.append(action)
            if action.client_id not in (None, self.client_id):
                continue
            message = self.decode(action.frame)
            if not self.loses("down", message):
                found.append(message)
        self.inbox += found
        return found

    def decode(self, frame: bytes) -> Any:
        if int.from_bytes(frame[7:10], "little") in OWN_MESSAGES:
            return Foreign(frame)
        message = self._parser.decode(bytearray(frame))
        assert not message.get_type().startswith("UNKNOWN")
        return message

    def wait(self, seconds: float) -> list[Any]:
        """Let time pass, polling the vehicle when it is due."""
        found = []
        end_us = self.clock.now_us + round(seconds * 1e6)
        while (due_us := self.vehicle.next_due_us()) <= end_us:
            self.clock.now_us = max(self.clock.now_us, due_us)
            found += self.receive(self.vehicle.poll(self.clock.now_us))
        self.clock.now_us = end_us
        return found

    def ask(self, message: Any, *kinds: str, retries: int = 5, timeout_s: float = 1.0) -> list[Any]:
        """Send until one of the kinds comes back, as ground stations do; the answers since."""
        for _ in range(retries):
            found = self.send(message)
            if not any(m.get_type() in kinds for m in found):
                found += self.wait(timeout_s)
            answers = [m for m in found if m.get_type() in kinds]
            if answers:
                return answers
        raise AssertionError(f"no {' or '.join(kinds)} after {retries} tries")

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> list[Any]:
        padded = [*params, *[0.0] * (7 - len(params))]
        return self.send(mavlink.MAVLink_command_long_message(*target, number, 0, *padded))

    def request(self, message_id: int, index: int = 0) -> list[Any]:
        return self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id, index)

    @property
    def broadcasts(self) -> set[str]:
        """Kinds of message that went to all."""
        return {
            self.decode(frame.frame).get_type() for frame in self.frames if frame.client_id is None
        }

    def of(self, kind: type[Action]) -> list[Any]:
        return [action for action in self.actions if isinstance(action, kind)]

    @property
    def requested_intervals(self) -> list[ClientInterval]:
        return self.of(ClientInterval)


def kinds(messages: list[Any]) -> list[str]:
    return [message.get_type() for message in messages]
