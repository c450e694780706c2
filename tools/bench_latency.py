"""Measure latency and CPU share from the serial byte to the datagram.

    python tools/bench_latency.py

Several aircraft send all payloads of their nodes: IMU and barometer samples, fixes with their
quality, the reports of nodes and receiver. A frame with an IMU sample is written to a
pseudo-terminal and the resulting ATTITUDE_QUATERNION is awaited on a UDP port, at several rates;
for one aircraft the samples are lines of JSON. Programs take turns in short rounds, so that other
load on the machine affects them equally: the median round counts. The baseline is a program that
reads the same line and sends a datagram of the same size for every frame, without decoding, fusion
or encoding; `--forwarder` names another such program, in any language. The maximum latency at the
highest rate is the longest pause, including pauses of the machine, which the baseline has as well.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import select
import shlex
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gateway.records import GpsFixType, ImuFlags, NodeId, PipeCounters
from gateway.wire import payloads
from gateway.wire.framing import encode_frame

RATES_HZ = (100, 1000)
VEHICLES = 3
BARO_HZ, FIX_HZ, REPORT_HZ = 25, 5, 1
"""Rates of each aircraft's other payloads; REPORT_HZ is that of the receiver's report too."""
WARM_UP_S = 3.0
START_LIMIT_S = 120.0
CLOCK_TICKS = os.sysconf("SC_CLK_TCK")
GATEWAY = "mavgate"
WITH_UVLOOP = "mavgate, uvloop"
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


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS


class Line:
    """A pseudo-terminal with a program at its other end, and the UDP port for its answers."""

    def __init__(self, name: str, command: list[str], moments: Iterator[Moment]) -> None:
        self._is_gateway = name in (GATEWAY, WITH_UVLOOP, OF_LINES)
        self._moments = moments
        self._waiting: dict[int, deque[float | None]] = {}
        """Times of unanswered frames, by system; None for frames that are not measured."""
        self._latencies_us: list[float] = []
        self.unanswered = 0
        """Frames of the last exchange without an answer."""
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self._sock.setblocking(False)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        values = {"line": os.ttyname(self._slave), "port": self._sock.getsockname()[1]}
        self.process = subprocess.Popen(
            [word.format(**values) for word in command],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )

    def close(self) -> None:
        """End the program."""
        self.process.terminate()
        self.process.wait(10)
        self._sock.close()
        os.close(self._master)
        os.close(self._slave)

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
        os.write(self._master, moment.sample)
        for frame in moment.others:
            if not self._is_gateway:
                queue.append(None)
            os.write(self._master, frame)

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
    name: str, command: list[str], rate_hz: int, options: argparse.Namespace
) -> dict[str, float]:
    """Run a program on a separate line and measure it."""
    of_nodes = Nodes().moments(rate_hz, options.vehicles)
    line = Line(name, command, line_moments(rate_hz) if name == OF_LINES else of_nodes)
    try:
        line.await_answer(rate_hz)
        line.exchange(rate_hz, WARM_UP_S)
        cpu, wall = cpu_seconds(line.process.pid), time.perf_counter()
        latencies_us = line.exchange(rate_hz, options.seconds)
        share = (cpu_seconds(line.process.pid) - cpu) / (time.perf_counter() - wall)
    finally:
        line.close()
    p50, p99 = np.percentile(latencies_us, [50, 99])
    return {
        "p50_us": float(p50),
        "p99_us": float(p99),
        "max_us": max(latencies_us),
        "cpu_percent": 100 * share,
        "unanswered": line.unanswered,
    }


def programs(folder: Path, options: argparse.Namespace) -> dict[str, list[str]]:
    """Return the command line of each program, with placeholders for the line and the port."""
    loops = {GATEWAY: "asyncio"} | ({WITH_UVLOOP: "uvloop"} if options.uvloop else {})
    commands = {"plain forwarder": [sys.executable, "-c", BASELINE, "{line}", "{port}"]}
    for name, event_loop in loops.items():
        config = folder / f"{event_loop}.toml"
        config.write_text(CONFIG.format(event_loop=event_loop))
        gateway = f"-m gateway.cli run --plain --config {config} --port {{line}}"
        endpoint = ["--endpoint", "udp:127.0.0.1:{port}"]
        commands[name] = [sys.executable, *gateway.split(), *endpoint]
    config = folder / "asyncio.toml"
    gateway = f"-m gateway.cli run --plain --config {config} --source lines:{{line}}"
    commands[OF_LINES] = [sys.executable, *gateway.split(), "--endpoint", "udp:127.0.0.1:{port}"]
    return commands | {command.split()[0]: shlex.split(command) for command in options.forwarder}


def summed_up(rounds: list[dict[str, float]]) -> dict[str, float]:
    """Return the median round of each figure, the longest pause, and all unanswered frames."""
    ways: dict[str, Callable[[list[float]], float]] = {"max_us": max, "unanswered": sum}
    return {
        key: ways.get(key, statistics.median)([one[key] for one in rounds]) for key in rounds[0]
    }


def main() -> None:
    """Run every rate and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5.0, help="of each single run")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--vehicles", type=int, default=VEHICLES)
    parser.add_argument(
        "--forwarder", action="append", default=[], metavar="COMMAND",
        help="compare another that sends one datagram a frame: a command with {line} and {port}",
    )  # fmt: skip
    parser.add_argument(
        "--uvloop", action="store_true", help="measure the gateway with hub.event_loop = uvloop too"
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    options = parser.parse_args()
    found: dict[tuple[int, str], list[dict[str, float]]] = {}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commands = programs(folder, options)
        runs = list(itertools.product(range(options.rounds), RATES_HZ, commands))
        for _, rate_hz, name in track(runs, "measuring"):
            figures = measure(name, commands[name], rate_hz, options)
            found.setdefault((rate_hz, name), []).append(figures)
    results = {key: summed_up(rounds) for key, rounds in found.items()}
    show(results, options)
    if options.json:
        rows = [{"rate_hz": rate, "program": name, **r} for (rate, name), r in results.items()]
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def show(results: dict[tuple[int, str], dict[str, float]], options: argparse.Namespace) -> None:
    """Print the figures as a table, and the longest pauses."""
    title = f"serial byte in to datagram out, {options.vehicles} aircraft"
    table = Table(title=title, box=box.SIMPLE_HEAD)
    for column in ("IMU/s", "program", "p50 µs", "p99 µs", "max µs", "CPU %", "unanswered"):
        table.add_column(column, justify="left" if column == "program" else "right")
    for (rate_hz, name), row in results.items():
        latencies = (f"{row[key]:.0f}" for key in ("p50_us", "p99_us", "max_us"))
        table.add_row(
            str(rate_hz), name, *latencies, f"{row['cpu_percent']:.1f}", f"{row['unanswered']:.0f}"
        )
    console = Console()
    console.print(table)
    # At the highest rate, a frame waits for almost all of a pause, so the maximum is the longest.
    fastest, lasted_s = max(RATES_HZ), options.rounds * options.seconds
    for (rate_hz, name), row in results.items():
        if rate_hz == fastest:
            console.print(
                f"longest pause of {name}: {row['max_us'] / 1e3:.1f} ms in {lasted_s:.0f} s"
            )


if __name__ == "__main__":
    main()
