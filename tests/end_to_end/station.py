"""The scripted ground station on real sockets, speaking to a running gateway."""

import socket
import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from tests.kit.ground_station import OWN_MESSAGES, Foreign
from tests.kit.process import START_LIMIT_S

HEARTBEAT_INTERVAL_S = 1.0


class Station:
    """A ground station over UDP or TCP, with the same verbs as the one of the pure tests."""

    slice_s = 0.005
    patience = 400
    """Slices of time before it asks again: a busy machine may keep the gateway waiting."""
    ask_again_s = 1.0
    target = (1, 1)

    def __init__(self, sock: socket.socket, version: int = 2) -> None:
        self.version = version
        self.inbox: list[Any] = []
        self.mav = mavlink.MAVLink(None, 255, 190)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._sock = sock
        self._beat_s = 0.0

    @classmethod
    def connect(cls, kind: int, port: int, version: int) -> "Station":
        """Connect to a gateway on this machine; raises OSError if none listens."""
        sock = socket.socket(socket.AF_INET, kind)
        try:
            sock.connect(("127.0.0.1", port))
        except OSError:
            sock.close()
            raise
        station = cls(sock, version)
        # Stations of one id that count from the same number send the same bytes, and the
        # gateway takes the second ones for copies that came by another way.
        station.mav.seq = sock.getsockname()[1] % 256
        return station

    def close(self) -> None:
        self._sock.close()

    def send(self, message: Any) -> list[Any]:
        self._sock.send(message.pack(self.mav, force_mavlink1=self.version == 1))
        self.mav.seq = (self.mav.seq + 1) % 256
        return []

    def wait(self, seconds: float) -> list[Any]:
        """Receive for a while."""
        found: list[Any] = []
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0.0:
            self._beat()
            self._sock.settimeout(left_s)
            try:
                data = self._sock.recv(65_536)
            except TimeoutError:
                break
            found += [self._known(m) for m in self._parser.parse_buffer(data) or []]
        self.inbox += found
        return found

    def ask(self, message: Any, *kinds: str, **_: float) -> list[Any]:
        """Ask until it is answered, with more patience than the pure tests on their own clock."""
        end_s = time.monotonic() + START_LIMIT_S
        while time.monotonic() < end_s:
            self.send(message)
            again_s = time.monotonic() + self.ask_again_s
            while time.monotonic() < again_s:
                answers = [m for m in self.wait(0.001) if m.get_type() in kinds]
                if answers:
                    return answers
        raise AssertionError(f"no {' or '.join(kinds)} in {START_LIMIT_S} s")

    def until_heard(self, seconds: float = START_LIMIT_S) -> None:
        """Wait for the vehicle's heartbeat; the gateway has one of its own."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            beats = (m for m in self.wait(0.1) if m.get_type() == "HEARTBEAT")
            if any(m.get_srcComponent() == mavlink.MAV_COMP_ID_AUTOPILOT1 for m in beats):
                return
        raise AssertionError("no vehicle")

    def _beat(self) -> None:
        if time.monotonic() >= self._beat_s:
            self._beat_s = time.monotonic() + HEARTBEAT_INTERVAL_S
            beat = mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
            )
            self.send(beat)

    @staticmethod
    def _known(message: Any) -> Any:
        if message.get_type().startswith("UNKNOWN"):
            frame = bytes(message.get_msgbuf())
            if int.from_bytes(frame[7:10], "little") in OWN_MESSAGES:
                return Foreign(frame)
        return message
