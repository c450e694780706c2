"""Measure the loading time of stations behind a 9,600 baud radio, without and with `cache=yes`.

A pseudo-terminal with a simulated vehicle carries 960 bytes a second in either direction. One
station after the other loads all parameters and the mission; printed are the time, and the bytes of
requests and answers on the radio. Telemetry, which is the same in all cases, is not counted.
"""

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections import deque
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tests.ports import free_port

BYTES_PER_S: Final = 960
STEP_S: Final = 0.02
STEP_BYTES: Final = round(BYTES_PER_S * STEP_S)
PARAMETERS: Final = 907
ITEMS: Final = 40
TELEMETRY_S: Final = 0.5
QUIET_S: Final = 3.0
"""Timeout after which a station repeats a request."""


class Vehicle(threading.Thread):
    """An autopilot at the far end of a radio: parameters and a mission, telemetry first."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.path, self._slave = os.ttyname(slave), slave
        self.radio = 0
        """Bytes of requests and answers on the radio."""
        self.stopped = threading.Event()
        self._mav: Any = mavlink.MAVLink(None, 1, 1)
        self._mav.robust_parsing = True
        self._out: deque[bytes] = deque()
        self._left: deque[int] = deque()
        """Parameters of the list that are still to be sent."""

    def run(self) -> None:
        """Transfer the bytes of each step in either direction."""
        begin_s = next_s = sent_s = time.monotonic()
        pending = b""
        while not self.stopped.is_set():
            now_s = time.monotonic()
            if now_s - sent_s >= TELEMETRY_S:
                sent_s = now_s
                time_ms = round((now_s - begin_s) * 1000) + 60_000
                for message in (
                    mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3),
                    mavlink.MAVLink_attitude_message(time_ms, 0, 0, 0, 0, 0, 0),
                ):
                    pending += self._pack(message)
            self._receive()
            while len(pending) < STEP_BYTES and (self._out or self._left):
                answer = self._out.popleft() if self._out else self._parameter(self._left.popleft())
                self.radio += len(answer)
                pending += answer
            pending = pending[os.write(self.master, pending[:STEP_BYTES]) :] if pending else b""
            next_s += STEP_S
            time.sleep(max(0.0, next_s - time.monotonic()))
        os.close(self.master)
        os.close(self._slave)

    def _receive(self) -> None:
        try:
            data = os.read(self.master, STEP_BYTES)
        except BlockingIOError:
            return
        for message in self._mav.parse_buffer(data) or ():
            if getattr(message, "target_system", 0) == 1:
                self.radio += len(message.get_msgbuf())
                self._answer(message, message.get_srcSystem(), message.get_srcComponent())

    def _answer(self, message: Any, system: int, component: int) -> None:
        match message.get_type():
            case "PARAM_REQUEST_LIST":
                self._left = deque(range(PARAMETERS))
            case "PARAM_REQUEST_READ":
                self._out.append(self._parameter(message.param_index))
            case "MISSION_REQUEST_LIST":
                count = ITEMS if message.mission_type == 0 else 0
                self._out.append(
                    self._pack(
                        mavlink.MAVLink_mission_count_message(
                            system, component, count, message.mission_type
                        )
                    )
                )
            case "MISSION_REQUEST_INT":
                self._out.append(
                    self._pack(
                        mavlink.MAVLink_mission_item_int_message(
                            system,
                            component,
                            message.seq,
                            6,
                            16,
                            0,
                            1,
                            0,
                            0,
                            0,
                            0,
                            470_000_000 + message.seq,
                            80_000_000,
                            50.0,
                            0,
                        )
                    )
                )

    def _parameter(self, index: int) -> bytes:
        name = f"PARAM_{index:04}".encode()
        return self._pack(
            mavlink.MAVLink_param_value_message(name, index + 0.1, 9, PARAMETERS, index)
        )

    def _pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data


class Station:
    """A ground station with pymavlink that requests missing data again."""

    def __init__(self, port: int, system: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(QUIET_S)
        self._mav: Any = mavlink.MAVLink(None, system, 190)

    def send(self, message: Any) -> None:
        """Send one message."""
        self._socket.send(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

    def load(self) -> float:
        """Load all parameters, then the mission; return the time in s."""
        while self._next("ATTITUDE") is None:
            self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        begin_s = time.monotonic()
        parameters: set[int] = set()
        self.send(mavlink.MAVLink_param_request_list_message(1, 1))
        while len(parameters) < PARAMETERS:
            value = self._next("PARAM_VALUE")
            if value is not None:
                parameters.add(value.param_index)
                continue
            for index in sorted({*range(PARAMETERS)} - parameters)[:10]:
                self.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))
        self._ask(mavlink.MAVLink_mission_request_list_message(1, 1, 0), "MISSION_COUNT")
        for number in range(ITEMS):
            self._ask(
                mavlink.MAVLink_mission_request_int_message(1, 1, number, 0), "MISSION_ITEM_INT"
            )
        self.send(mavlink.MAVLink_mission_ack_message(1, 1, 0, 0))
        return time.monotonic() - begin_s

    def _ask(self, request: Any, kind: str) -> None:
        self.send(request)
        while self._next(kind) is None:
            self.send(request)

    def _next(self, kind: str) -> Any:
        """Return the next message of a kind; None after a timeout."""
        until_s = time.monotonic() + QUIET_S
        while time.monotonic() < until_s:
            try:
                data = self._socket.recv(65535)
            except (TimeoutError, ConnectionRefusedError):
                return None
            for message in self._mav.parse_buffer(data) or ():
                if message.get_type() == kind:
                    return message
        return None


def measure(options: str, folder: Path) -> None:
    """Let two stations load everything, one after the other, and print their figures."""
    vehicle, port = Vehicle(), free_port()
    command = [
        str(Path(sys.executable).parent / "mavgate"), "run", "--plain",
        "--endpoint", f"serial:{vehicle.path}:9600{options}",
        "--endpoint", f"udp-listen:127.0.0.1:{port}",
    ]  # fmt: skip
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder), "HOME": str(folder)}
    gateway = subprocess.Popen(
        command, cwd=folder, env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    vehicle.start()
    try:
        for name in ("first", "second"):
            station = Station(port, 254 + (name == "first"))
            before = vehicle.radio
            took_s = station.load()
            figures = f"{took_s:.1f} s, {vehicle.radio - before} bytes"
            print(f"{options or 'without'}: {name} station {figures}")
    finally:
        vehicle.stopped.set()
        gateway.terminate()
        gateway.wait()


def main() -> None:
    """Measure with the option and without it."""
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    for options in ("", "?cache=yes"):
        with tempfile.TemporaryDirectory() as folder:
            measure(options, Path(folder))


if __name__ == "__main__":
    main()
