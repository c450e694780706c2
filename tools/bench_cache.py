"""Measure the loading time of stations behind a 9,600 baud radio, without and with `cache=yes`.

A pseudo-terminal with a simulated vehicle carries 960 bytes a second in either direction. One
station after the other loads all parameters and the mission; printed are the time, and the bytes of
requests and answers on the radio. Telemetry, which is the same in all cases, is not counted.
"""

import os
import tempfile
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, Final

from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink

from tests.ports import free_port
from tools.harness import MAVGATE, SerialLine, arguments, running, show, write_json

BYTES_PER_S: Final = 960
STEP_S: Final = 0.02
STEP_BYTES: Final = round(BYTES_PER_S * STEP_S)
PARAMETERS: Final = 907
ITEMS: Final = 40
TELEMETRY_STEPS: Final = 25
QUIET_S: Final = 3.0
"""Timeout after which a station repeats a request."""


class Vehicle(threading.Thread):
    """An autopilot at the far end of a radio: parameters and a mission, telemetry first."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.line = SerialLine()
        os.set_blocking(self.line.master, False)
        self.radio = 0
        """Bytes of requests and answers on the radio."""
        self.stopped = threading.Event()
        self._mav: Any = mavlink.MAVLink(None, 1, 1)
        self._mav.robust_parsing = True
        self._answers: deque[Any] = deque()
        """Answers that are still to be sent."""

    def run(self) -> None:
        """Transfer the bytes of each step in either direction."""
        next_s, step, pending = time.monotonic(), 0, b""
        while not self.stopped.wait(max(0.0, next_s - time.monotonic())):
            next_s, step = next_s + STEP_S, step + 1
            if step % TELEMETRY_STEPS == 0:
                time_ms = 60_000 + round(1000 * step * STEP_S)
                pending += self._pack(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
                pending += self._pack(mavlink.MAVLink_attitude_message(time_ms, *(0,) * 6))
            self._receive()
            while len(pending) < STEP_BYTES and self._answers:
                answer = self._pack(self._answers.popleft())
                self.radio += len(answer)
                pending += answer
            pending = pending[os.write(self.line.master, pending[:STEP_BYTES]) :]
        self.line.close()

    def _receive(self) -> None:
        try:
            data = os.read(self.line.master, STEP_BYTES)
        except BlockingIOError:
            return
        for message in self._mav.parse_buffer(data) or ():
            if getattr(message, "target_system", 0) == 1:
                self.radio += len(message.get_msgbuf())
                self._answer(message, (message.get_srcSystem(), message.get_srcComponent()))

    def _answer(self, message: Any, sender: tuple[int, int]) -> None:
        match message.get_type():
            case "PARAM_REQUEST_LIST":
                self._answers.clear()
                self._answers.extend(map(parameter, range(PARAMETERS)))
            case "PARAM_REQUEST_READ":
                self._answers.append(parameter(message.param_index))
            case "MISSION_REQUEST_LIST":
                count = ITEMS if message.mission_type == 0 else 0
                answer = mavlink.MAVLink_mission_count_message(*sender, count, message.mission_type)
                self._answers.append(answer)
            case "MISSION_REQUEST_INT":
                item = (message.seq, 6, 16, 0, 1, 0, 0, 0, 0, 470_000_000 + message.seq, 80_000_000)
                answer = mavlink.MAVLink_mission_item_int_message(*sender, *item, 50.0, 0)
                self._answers.append(answer)

    def _pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data


def parameter(index: int) -> Any:
    """Return the value of a parameter."""
    name = f"PARAM_{index:04}".encode()
    return mavlink.MAVLink_param_value_message(name, index + 0.1, 9, PARAMETERS, index)


def load_all(port: int, system: int) -> float:
    """Load all as a station that repeats unanswered requests; return the time."""
    link: Any = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}")
    link.mav = mavlink.MAVLink(link, system, 190)

    def ask(kind: str, request: Any) -> None:
        link.mav.send(request)
        while link.recv_match(type=kind, blocking=True, timeout=QUIET_S) is None:
            link.mav.send(request)

    ask("ATTITUDE", mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    begin_s = time.monotonic()
    missing = {*range(PARAMETERS)}
    link.mav.param_request_list_send(1, 1)
    while missing:
        value = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=QUIET_S)
        if value is not None:
            missing.discard(value.param_index)
            continue
        for index in sorted(missing)[:10]:
            link.mav.param_request_read_send(1, 1, b"", index)
    ask("MISSION_COUNT", mavlink.MAVLink_mission_request_list_message(1, 1, 0))
    for number in range(ITEMS):
        ask("MISSION_ITEM_INT", mavlink.MAVLink_mission_request_int_message(1, 1, number, 0))
    link.mav.mission_ack_send(1, 1, 0, 0)
    link.close()
    return time.monotonic() - begin_s


def measure(option: str, folder: Path) -> list[tuple[object, ...]]:
    """Let two stations load everything, one after the other; return their figures."""
    vehicle, port = Vehicle(), free_port()
    radio = f"serial:{vehicle.line.device}:9600{option}"
    ends = ("--endpoint", radio, "--endpoint", f"udp-listen:127.0.0.1:{port}")
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder), "HOME": str(folder)}
    rows: list[tuple[object, ...]] = []
    with running(*MAVGATE, "run", "--plain", *ends, cwd=folder, env=environment):
        vehicle.start()
        for name, system in (("first", 255), ("second", 254)):
            before = vehicle.radio
            took_s = load_all(port, system)
            rows.append((option or "without", name, took_s, vehicle.radio - before))
        vehicle.stopped.set()
    return rows


def main() -> None:
    """Measure with the option and without it."""
    options, rows = arguments(__doc__).parse_args(), list[tuple[object, ...]]()
    for option in ("", "?cache=yes"):
        with tempfile.TemporaryDirectory() as folder:
            rows += measure(option, Path(folder))
    columns = ("option", "station", "s", "bytes on the radio")
    show(f"{PARAMETERS} parameters and {ITEMS} items over 9,600 baud", columns, rows)
    write_json(options, {"rows": rows})


if __name__ == "__main__":
    main()
