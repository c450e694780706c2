"""An aircraft whose every figure is set by the test."""

import contextlib
import math
import socket
import threading
from collections.abc import Iterable

from pymavlink.dialects.v20 import all as mavlink

from tests.ports import free_port

RATE_HZ = 20


class SendingVehicle(threading.Thread):
    """Sends its messages to a UDP port at an interval, until it is ended."""

    def __init__(self, interval_s: float) -> None:
        super().__init__(daemon=True)
        self.port = free_port()
        self._interval_s = interval_s
        self._ended = threading.Event()

    def run(self) -> None:
        mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect(("127.0.0.1", self.port))
            while not self._ended.wait(self._interval_s):
                for message in self._messages():
                    with contextlib.suppress(ConnectionRefusedError):
                        sock.send(message.pack(mav))

    def end(self) -> None:
        self._ended.set()
        self.join()

    def _messages(self) -> Iterable[mavlink.MAVLink_message]:
        raise NotImplementedError


class ScriptedVehicle(SendingVehicle):
    """An aircraft whose figures the test changes while it sends."""

    def __init__(self) -> None:
        super().__init__(1 / RATE_HZ)
        self.kind = mavlink.MAV_TYPE_FIXED_WING
        self.roll_deg = self.pitch_deg = self.heading_deg = 0.0
        self.alt_home_m, self.home_alt_m = 60.0, 431.0
        self.groundspeed_mps, self.airspeed_mps, self.climb_mps = 18.0, 17.5, 1.5

    def _messages(self) -> list[mavlink.MAVLink_message]:
        angles = map(math.radians, (self.roll_deg, self.pitch_deg, self.heading_deg))
        alt_m = self.home_alt_m + self.alt_home_m
        heading = round(self.heading_deg)
        return [
            mavlink.MAVLink_heartbeat_message(self.kind, 0, 128, 0, 4, 3),
            mavlink.MAVLink_attitude_message(0, *angles, 0.0, 0.0, 0.0),
            mavlink.MAVLink_global_position_int_message(
                0, 470_000_000, 80_000_000, round(alt_m * 1e3), round(self.alt_home_m * 1e3),
                0, 0, 0, heading * 100,
            ),
            mavlink.MAVLink_vfr_hud_message(
                self.airspeed_mps, self.groundspeed_mps, heading, 50, alt_m, self.climb_mps
            ),
        ]  # fmt: skip
