"""Measure latency and CPU share from the serial byte to the datagram.

    python -m tools.bench_latency

Several simulated aircraft send all payloads of their nodes. A frame with an IMU sample is written
to a pseudo-terminal and the resulting ATTITUDE_QUATERNION is awaited on a UDP port, at some rates;
for one aircraft the samples are lines of JSON. Programs take turns in short rounds, so that other
load on the machine affects them equally: the median round counts. The baseline is a program that
reads the same line and sends a datagram of the same size for every frame, without decoding, fusion
or encoding; `--forwarder` names another such program, in any language. The maximum latency at the
highest rate is the longest pause, including pauses of the machine, which the baseline has as well.
"""

import contextlib
import itertools
import json
import math
import os
import select
import shlex
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich.progress import track

from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.wire.framing import FrameDecoder
from gateway.wire.payloads import ImuPayload, RadioFrame, decode_content
from tools.harness import (
    MAVGATE,
    PYTHON,
    Figures,
    SerialLine,
    arguments,
    cpu_s,
    medians,
    port_of,
    running,
    show,
    udp_socket,
    write_json,
)

RATES_HZ = (100, 1000)
VEHICLES = 3
WARM_UP_S = 3.0
START_LIMIT_S = 120.0
GATEWAY = "mavgate"
OF_LINES = "mavgate, JSON lines"
"""Name of the run with one aircraft that sends each sample as a line of JSON."""

BASELINE = """
import os, socket, sys
line = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
while data := os.read(line, 4096):
    for _ in range(data.count(0)):
        out.sendto(bytes(44), ("127.0.0.1", int(sys.argv[2])))
"""

CONFIG = """
[vehicle.rates]
attitude_quaternion_hz = 1000

[hub]
event_loop = "{event_loop}"
"""


class Moment(NamedTuple):
    """Frames that are written to the line together."""

    system: int
    """System of the IMU sample."""
    sample: bytes
    others: list[bytes]


def moments(rate_hz: int, vehicles: int) -> Iterator[Moment]:
    """Yield frames of the simulated receiver without end, each time one IMU sample.

    Each of the aircraft sends an equal, whole part of `rate_hz` samples a second.
    """
    settings = SimulatorSettings(
        vehicles=vehicles,
        imu_rate_hz=rate_hz // vehicles,
        gps_first_fix_s=0.5,
        radio_loss=0.0,
        radio_duplicates=0.0,
    )
    decoder, others = FrameDecoder(), list[bytes]()
    for frame in simulate(settings).frames():
        for content in decoder.feed(frame.data):
            found = decode_content(content) if isinstance(content, bytes) else content
            if isinstance(found, RadioFrame) and isinstance(found.payload, ImuPayload):
                yield Moment(found.header.node.vehicle_id, frame.data, others)
                others = []
            else:
                others.append(frame.data)


def line_moments(rate_hz: int) -> Iterator[Moment]:
    """Yield lines of JSON without end, each with an IMU sample, every tenth with a field."""
    for number in itertools.count():
        turn = math.sin(number / 500)
        sample: dict[str, object] = {
            "t_ms": number * 1000 / rate_hz,
            "accel_mps2": [0.02 * turn, 0.01, 9.81],
            "gyro_dps": [0.1, -0.2, 3 * turn],
        }
        if number % 10 == 0:
            sample["mag_ut"] = [21.5, -3.25, -44.0]
        yield Moment(1, json.dumps(sample).encode() + b"\n", [])


def frames(rate_hz: int) -> Iterator[bytes]:
    """Yield the IMU frames of one aircraft without end."""
    return (moment.sample for moment in moments(rate_hz, 1))


class Line:
    """A program at a serial line, and the UDP port for its answers.

    The command has `{line}` and `{port}` for both. A gateway answers each IMU sample, any other
    program each frame.
    """

    def __init__(self, command: list[str], sent: Iterator[Moment], *, is_gateway: bool) -> None:
        self._is_gateway, self._moments = is_gateway, sent
        self._waiting: dict[int, deque[float | None]] = {}
        """Times of unanswered frames, by system; None for frames that are not measured."""
        self._latencies_us: list[float] = []
        self.unanswered = 0
        """Frames of the last exchange without an answer."""
        self._line, self._sock = SerialLine(), udp_socket()
        values = {"line": self._line.device, "port": port_of(self._sock)}
        self._opened = contextlib.ExitStack()
        self._opened.callback(self._line.close)
        self._opened.callback(self._sock.close)
        program = running(*(word.format(**values) for word in command))
        self.process = self._opened.enter_context(program)
        self.close = self._opened.close

    def await_answer(self, rate_hz: int) -> None:
        """Feed the line until the program answers, then read all answers."""
        deadline = time.monotonic() + START_LIMIT_S
        while time.monotonic() < deadline and self.process.poll() is None:
            self._send()
            if select.select([self._sock], [], [], 1 / rate_hz)[0] and self._receive():
                while select.select([self._sock], [], [], 0.3)[0]:
                    self._sock.recv(2048)
                self._waiting.clear()
                return
        raise SystemExit(f"no answer from {self.process.args!r}")

    def exchange(self, rate_hz: int, seconds: float) -> list[float]:
        """Send at a rate, match IMU frames with their answers in order; return latencies in µs.

        Frames without an answer are counted: on a busy machine the gateway drops telemetry that has
        waited for 0.15 s. The latencies after one are too long by an interval, up to the end.
        """
        self._latencies_us = []
        begin = time.perf_counter()
        count, total = 0, round(seconds * rate_hz)
        while count < total or (self._unanswered() and time.perf_counter() < begin + seconds + 1):
            now = time.perf_counter()
            due = begin + count / rate_hz
            if now >= due and count < total:
                self._send()
                count += 1
                continue
            # A sleep to the end would end too late at 1000 frames/s, so the last part is polled.
            if select.select([self._sock], [], [], max(0.0, due - now - 2e-4))[0]:
                self._receive()
        self.unanswered = self._unanswered()
        self._waiting.clear()
        return self._latencies_us

    def _unanswered(self) -> int:
        return sum(map(len, self._waiting.values()))

    def _send(self) -> None:
        moment = next(self._moments)
        queue = self._waiting.setdefault(moment.system if self._is_gateway else 0, deque())
        queue.append(time.perf_counter())
        os.write(self._line.master, moment.sample)
        for frame in moment.others:
            if not self._is_gateway:
                queue.append(None)
            os.write(self._line.master, frame)

    def _receive(self) -> bool:
        """Read one datagram; return whether it answers a frame."""
        arrival, datagram, system = time.perf_counter(), self._sock.recv(2048), 0
        if self._is_gateway:
            message_id = int.from_bytes(datagram[7:10], "little")
            if message_id != mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
                return False
            system = datagram[5]
        if (queue := self._waiting.get(system)) and (sent := queue.popleft()) is not None:
            self._latencies_us.append((arrival - sent) * 1e6)
        return True


def measure(
    command: list[str], sent: Iterator[Moment], rate_hz: int, seconds: float, *, is_gateway: bool
) -> Figures:
    """Run a program on a separate line and measure it."""
    line = Line(command, sent, is_gateway=is_gateway)
    try:
        line.await_answer(rate_hz)
        line.exchange(rate_hz, WARM_UP_S)
        begin_cpu_s, begin_s = cpu_s(line.process.pid), time.perf_counter()
        latencies_us = line.exchange(rate_hz, seconds)
        share = (cpu_s(line.process.pid) - begin_cpu_s) / (time.perf_counter() - begin_s)
    finally:
        line.close()
    p50, p99 = map(float, np.percentile(latencies_us, [50, 99]))
    return {
        "p50_us": p50, "p99_us": p99, "max_us": max(latencies_us), "cpu_percent": 100 * share,
        "lost": line.unanswered,
    }  # fmt: skip


def gateway(folder: Path, event_loop: str, *input_: str) -> list[str]:
    """Return the command of a gateway with an input."""
    config = folder / f"{event_loop}.toml"
    config.write_text(CONFIG.format(event_loop=event_loop))
    endpoint = ("--endpoint", "udp:127.0.0.1:{port}")
    return [*MAVGATE, "run", "--plain", "--config", str(config), *input_, *endpoint]


def main() -> None:
    """Run every rate and print the table."""
    parser = arguments(__doc__, rounds=3, seconds=5.0)
    parser.add_argument("--vehicles", type=int, default=VEHICLES)
    parser.add_argument(
        "--forwarder", action="append", default=[], metavar="COMMAND",
        help="compare another that sends one datagram a frame: a command with {line} and {port}",
    )  # fmt: skip
    parser.add_argument(
        "--uvloop", action="store_true", help="measure the gateway with hub.event_loop = uvloop too"
    )
    options = parser.parse_args()
    found: dict[tuple[int, str], list[Figures]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gateways = {
            GATEWAY: gateway(folder, "asyncio", "--port", "{line}"),
            OF_LINES: gateway(folder, "asyncio", "--source", "lines:{line}"),
        }
        if options.uvloop:
            gateways["mavgate, uvloop"] = gateway(folder, "uvloop", "--port", "{line}")
        commands = {"plain forwarder": [PYTHON, "-c", BASELINE, "{line}", "{port}"], **gateways}
        commands |= {command.split()[0]: shlex.split(command) for command in options.forwarder}
        # An equal, whole rate for each aircraft.
        rates_hz = [rate_hz - rate_hz % options.vehicles for rate_hz in RATES_HZ]
        runs = [*itertools.product(range(options.rounds), rates_hz, commands)]
        for _, rate_hz, program in track(runs, "measuring"):
            is_of_lines = program == OF_LINES
            figures = measure(
                commands[program],
                line_moments(rate_hz) if is_of_lines else moments(rate_hz, options.vehicles),
                rate_hz,
                options.seconds,
                is_gateway=program in gateways,
            )
            found.setdefault((rate_hz, program), []).append(figures)
    rows = [(*key, medians(rounds, maxima=["max_us"])) for key, rounds in found.items()]
    show(
        f"serial byte in to datagram out, {options.vehicles} aircraft",
        ("IMU/s", "program", "p50 µs", "p99 µs", "max µs", "CPU %", "unanswered"),
        [(rate_hz, program, *figures.values()) for rate_hz, program, figures in rows],
    )
    write_json(options, {"rows": rows})


if __name__ == "__main__":
    main()
