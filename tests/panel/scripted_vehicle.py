"""Vehicles whose messages the test sets."""

import contextlib
import math
import socket
import threading
from collections.abc import Iterator

from pymavlink.dialects.v20 import all as mavlink

from tests.ports import free_port

RATE_HZ = 20
HOME_DEG = 46.99, 8.01
HOSTILE_EVERY = 4
HOSTILE_NAMES = ["B :a=q=1", 'B :a="q=1"', '"onload=q=1 ', "<img/onerror=q>", "`${q=1}`",
                 "'+(q=1)+'", "{{q=1}}", "x :style=q=1", "' :id='q=1'", "\u202edoog"]  # fmt: skip
HOSTILE_MARKUP = '<img src=x onerror=q=1><script>q=1</script>`${q=1}` :a="q=1" {{q=1}}'


class ScriptedVehicle(threading.Thread):
    """Sends an aircraft, whose figures the test changes, and a hostile one until it is ended."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.port = free_port()
        self.roll_deg = self.pitch_deg = self.heading_deg = 0.0
        self.alt_home_m, self.home_alt_m = 60.0, 431.0
        self.groundspeed_mps, self.airspeed_mps, self.climb_mps = 18.0, 17.5, 1.5
        self._ended = threading.Event()

    def run(self) -> None:
        own = mavlink.MAVLink(None, srcSystem=2, srcComponent=1)
        hostile = mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect(("127.0.0.1", self.port))
            turn = 0
            while not self._ended.wait(1 / RATE_HZ):
                frames = [message.pack(own) for message in self._messages()]
                if turn % HOSTILE_EVERY == 0:
                    frames += [m.pack(hostile) for m in hostile_messages()]
                turn += 1
                for frame in frames:
                    with contextlib.suppress(ConnectionRefusedError):
                        sock.send(frame)

    def end(self) -> None:
        self._ended.set()
        self.join()

    def _messages(self) -> list[mavlink.MAVLink_message]:
        angles = map(math.radians, (self.roll_deg, self.pitch_deg, self.heading_deg))
        alt_m = self.home_alt_m + self.alt_home_m
        heading = round(self.heading_deg)
        return [
            mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3),
            mavlink.MAVLink_attitude_message(0, *angles, 0.0, 0.0, 0.0),
            mavlink.MAVLink_global_position_int_message(
                0, 470_000_000, 80_000_000, round(alt_m * 1e3), round(self.alt_home_m * 1e3),
                0, 0, 0, heading * 100,
            ),
            mavlink.MAVLink_home_position_message(
                *(round(angle * 1e7) for angle in HOME_DEG), round(self.home_alt_m * 1e3),
                *[0.0] * 3, [1.0, 0.0, 0.0, 0.0], *[0.0] * 3,
            ),
            mavlink.MAVLink_vfr_hud_message(
                self.airspeed_mps, self.groundspeed_mps, heading, 50, alt_m, self.climb_mps
            ),
        ]  # fmt: skip


def hostile_messages() -> Iterator[mavlink.MAVLink_message]:
    """Make parameters, texts and named values whose names are scripts."""
    yield mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3)
    yield mavlink.MAVLink_attitude_message(0, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0)
    yield mavlink.MAVLink_global_position_int_message(
        0, 470_000_000, 80_001_000, 500_000, 60_000, 0, 0, 0, 0
    )
    for number, name in enumerate(HOSTILE_NAMES):
        raw = name.encode()[:16]
        yield mavlink.MAVLink_param_value_message(raw, number / 3, 9, len(HOSTILE_NAMES), number)
        yield mavlink.MAVLink_named_value_float_message(0, raw[:10], 1.0)
        yield mavlink.MAVLink_debug_vect_message(raw[:10], 0, 1.0, 2.0, 3.0)
    for part in range(0, len(HOSTILE_MARKUP), 50):
        text = HOSTILE_MARKUP[part : part + 50].encode()
        yield mavlink.MAVLink_statustext_message(2, text, 7, part // 50)
