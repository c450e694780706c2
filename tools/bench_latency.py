"""Measure latency and CPU share from the serial byte to the datagram.

    python -m tools.bench_latency

Several aircraft send all payloads of their nodes: IMU and barometer samples, fixes with their
quality, the reports of nodes and receiver. A frame with an IMU sample is written to a
pseudo-terminal and the resulting ATTITUDE_QUATERNION is awaited on a UDP port, at several rates;
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
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich.progress import track

from gateway.records import GpsFixType, ImuFlags, NodeId, PipeCounters
from gateway.wire import payloads
from gateway.wire.framing import encode_frame
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
BARO_HZ, FIX_HZ, REPORT_HZ = 25, 5, 1
"""Rates of each aircraft's other payloads; REPORT_HZ is that of the receiver's report too."""
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


class Nodes:
    """Level aircraft that turn slowly, and their receiver."""

    def __init__(self) -> None:
        self._sequences: dict[NodeId, Iterator[int]] = {}
        self._frames = itertools.count()

    def moments(self, rate_hz: int, vehicles: int) -> Iterator[Moment]:
        """Yield frames without end, at a total rate of IMU samples of all aircraft."""
        for number in itertools.count():
            system, tick = 1 + number % vehicles, number // vehicles
            node_us = round(number * 1e6 / rate_hz)
            sample = self._radio(NodeId(system, 0), node_us, imu_payload(number))
            others = list(self._others(system, tick, rate_hz / vehicles, node_us))
            yield Moment(system, sample, others)

    def _others(self, system: int, tick: int, rate_hz: float, node_us: int) -> Iterator[bytes]:
        def is_due(each_hz: int) -> bool:
            return int(tick * each_hz / rate_hz) != int((tick - 1) * each_hz / rate_hz)

        imu, gps = NodeId(system, 0), NodeId(system, 1)
        if is_due(BARO_HZ):
            yield self._radio(imu, node_us, payloads.BaroPayload(10_000_000, 215))
        if is_due(FIX_HZ):
            itow_ms = node_us // 1000
            yield self._radio(gps, node_us, quality_payload(itow_ms))
            yield self._radio(gps, node_us, fix_payload(itow_ms))
        if is_due(REPORT_HZ):
            report = payloads.NodeStatusPayload((1, 0), 1, 7, 0, 0, 0, 3, 900, 200, 3700)
            yield self._radio(imu, node_us, report)
            pipes = (PipeCounters(1000, 3, 0),) * payloads.PIPES
            status = payloads.ReceiverStatusFrame(
                next(self._frames) % 256, node_us % 2**32, 76, 4, 0, 1, pipes
            )
            yield encode_frame(payloads.encode_receiver_status(status))

    def _radio(self, node: NodeId, node_us: int, payload: payloads.Payload) -> bytes:
        sequence = next(self._sequences.setdefault(node, itertools.count()))
        header = payloads.Header(node, sequence % 65536, node_us % 2**32)
        packet = payloads.encode_payload(header, payload)
        frame_seq, pipe = next(self._frames) % 256, node.node_id
        return encode_frame(payloads.encode_radio(frame_seq, pipe, node_us % 2**32, packet))


def imu_payload(number: int) -> payloads.ImuPayload:
    """Make the counts of a level node that turns slowly."""
    return payloads.ImuPayload(
        accel=(20, -15, 4096),
        gyro=(3, -2, round(300 * math.sin(number / 500))),
        mag=(200, 30, -380),
        temperature=-3900,
        flags=ImuFlags.MAG_NEW if number % 3 == 0 else ImuFlags(0),
        accel_range=2,
        gyro_range=2,
        mag_gain=1,
    )


def fix_payload(itow_ms: int) -> payloads.GpsFixPayload:
    """Make a fix of a stationary aircraft."""
    position = (-77_656_000, 1_103_728_000, 110_000)
    return payloads.GpsFixPayload(itow_ms, *position, (0, 0, 0), GpsFixType.FIX_3D, True, 12)


def quality_payload(itow_ms: int) -> payloads.GpsQualityPayload:
    """Make the accuracies and the time of the fix."""
    utc = datetime(2026, 1, 1, tzinfo=UTC)
    return payloads.GpsQualityPayload(itow_ms, 150, 220, 30, 900, 140, 2500, utc)


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
    return (moment.sample for moment in Nodes().moments(rate_hz, 1))


class Line:
    """A program at a serial line, and the UDP port for its answers.

    The command has `{line}` and `{port}` for both. A gateway answers each IMU sample, any other
    program each frame.
    """

    def __init__(self, command: list[str], moments: Iterator[Moment], *, is_gateway: bool) -> None:
        self._is_gateway, self._moments = is_gateway, moments
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
    command: list[str], moments: Iterator[Moment], rate_hz: int, seconds: float, *, is_gateway: bool
) -> Figures:
    """Run a program on a separate line and measure it."""
    line = Line(command, moments, is_gateway=is_gateway)
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
        runs = [*itertools.product(range(options.rounds), RATES_HZ, commands)]
        for _, rate_hz, program in track(runs, "measuring"):
            moments = Nodes().moments(rate_hz, options.vehicles)
            figures = measure(
                commands[program],
                line_moments(rate_hz) if program == OF_LINES else moments,
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
