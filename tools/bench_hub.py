"""Measure the hub's forwarding of MAVLink over UDP and WebSocket, next to a plain UDP forwarder.

A source sends frames of foreign vehicles to the forwarder, which passes them to N clients, all on
loopback. Three figures for each forwarder and N:

* the lossless maximum: the source keeps at most a window of frames in transit and the forwarder
sets the rate; the run lasts until every client has received every frame, so that all buffers are
empty, and a frame that is not received within half a second is lost;
* the CPU time of the forwarder for each delivered message in this run;
* latency and CPU share at a fixed rate, from the source's clock before the send to the kernel's
timestamp at the client's socket, datagram or stream, so that the clients' own wake-ups do not
count. The kernel gives all waiting bytes of a stream the timestamp of the last one, so the
clients read data as soon as it arrives.

The plain forwarder receives with a blocking `recvfrom` and sends with a blocking `sendto` for each
client, without reading the content. Forwarders take turns in short rounds, so that other load on
the machine affects them equally; all receive from the same port, and run on a separate core if
there are two. The median of the rounds counts.

"WebSocket" is the hub with its clients at a WebSocket port, "packed" the hub whose clients get
several frames in one datagram. With `--vehicles N` the source is a link to N vehicles, the bare hub
is compared with `mavgate run`, with and without a recording, and the first client sends each of the
vehicles a command.
"""

import argparse
import contextlib
import json
import os
import select
import shlex
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich import box
from rich.console import Console
from rich.table import Table

from gateway.compiled.system_calls import receive_many, send_many
from gateway.wire.mavlink_messages import CRC_EXTRA, TARGET_OFFSETS, base_size

CLIENTS = (1, 4, 16, 64)
RATE_HZ = 1000
SOURCE_SYSTEM = 42
FRAMES = 20_000
"""Distinct frames, so that the hub's memory of duplicates works as in operation."""
WINDOWS = (128, 32, 8)
"""Windows, frames in transit; a forwarder with losses in the first one gets a smaller one."""
STALL_S = 0.5
BATCH = 64
"""Maximum frames sent or received by one call."""
START_LIMIT_S = 20.0
SO_TIMESTAMPNS = 35
CORES = sorted(os.sched_getaffinity(0))
"""Processor cores: the forwarder runs on the last one, source and clients on the first."""
KINDS = 20
"""Kinds of frame of each of several vehicles."""
PAYLOAD_BYTES = 32
WARM_UP_S = 2.0
HUB_NAME, RUN, RECORDING = "mavgate", "mavgate run", "recording"
"""Names of the bare hub, and of the whole gateway without and with a recording."""
WEB = "WebSocket"
"""Name of the hub with its clients at a WebSocket port."""
PACKED = "packed"
"""Name of the hub with packed frames."""
COMMANDED_S = 3.0

PLAIN = """
import socket, sys
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("127.0.0.1", int(sys.argv[1])))
clients = [("127.0.0.1", int(port)) for port in sys.argv[2:]]
while True:
    data, _ = sock.recvfrom(65535)
    for client in clients:
        sock.sendto(data, client)
"""

HUB = """
import asyncio, importlib, sys
from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings

async def main(endpoints):
    hub = Hub(HubSettings(endpoints=tuple(endpoints), max_clients=500), lambda incoming: None,
              GatewayClock())
    hub.start()
    print(*hub.listening_ports(), flush=True)
    await asyncio.Event().wait()

event_loop, *endpoints = sys.argv[1:]
with asyncio.Runner(loop_factory=importlib.import_module(event_loop).new_event_loop) as runner:
    runner.run(main(endpoints))
"""
UVLOOP = "uvloop"
"""Name of the hub on the event loop uvloop."""

REFERENCE = "mavlink-router"
ROUTERS = {
    REFERENCE: "-t 0 -e 127.0.0.1:{out} 127.0.0.1:{in}",
    "mavp2p": "udps:127.0.0.1:{in} udpc:127.0.0.1:{out}",
    "mavproxy": (
        "--master=udpin:127.0.0.1:{in} --out=udp:127.0.0.1:{out} --daemon --non-interactive "
        "--streamrate=-1 --state-basedir=/tmp"
    ),
}
"""Arguments of the compared routers, in the form for `router`."""

HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)

COLUMNS = (
    ("throughput", "delivered_per_s", ",.0f"),
    ("throughput", "cpu_us_per_message", ".2f"),
    ("latency", "cpu_percent", ".1f"),
    ("latency", "p50_us", ".0f"),
    ("latency", "p99_us", ".0f"),
)
Command = Callable[[int, list[int]], list[str]]


@dataclass(frozen=True)
class Throughput:
    """Results of a run with a window."""

    delivered_per_s: float
    cpu_us_per_message: float
    lost: int


@dataclass(frozen=True)
class Latency:
    """Results of a run at a fixed rate."""

    p50_us: float
    p99_us: float
    max_us: float
    cpu_percent: float
    lost: int
    gap_us: float
    """The longest time without a frame at a client."""


def plain(port: int, clients: list[int]) -> list[str]:
    """Return the command line of the plain forwarder."""
    return [sys.executable, "-c", PLAIN, str(port), *map(str, clients)]


def router(command: str) -> Command:
    """Return the command line of another router from one with placeholders.

    `{in}` is its input port; each word with `{out}` is repeated for the port of each client, with
    an option before it.
    """

    def build(port: int, clients: list[int]) -> list[str]:
        words: list[str] = []
        for word in shlex.split(command):
            option = []
            if "{out}" in word and words and words[-1].startswith("-"):
                option = [words.pop()]
            outputs = clients if "{out}" in word else [0]
            for client in outputs:
                words += [*option, word.replace("{in}", str(port)).replace("{out}", str(client))]
        return words

    return build


def hub(options: str = "", event_loop: str = "asyncio") -> Command:
    """Return the command line of our hub, with endpoint options for its clients."""

    def build(port: int, clients: list[int]) -> list[str]:
        urls = (f"udp:127.0.0.1:{client}{options}" for client in clients)
        return hub_command(f"udp-listen:127.0.0.1:{port}", *urls, event_loop=event_loop)

    return build


def hub_command(*endpoints: str, event_loop: str = "asyncio") -> list[str]:
    """Return the command line of our hub with some endpoints."""
    return [sys.executable, "-c", HUB, event_loop, *endpoints]


def daemon(mode: str) -> Command:
    """Return the command line of `mavgate run` without a receiver, which records in a mode."""

    def build(port: int, clients: list[int]) -> list[str]:
        folder = Path(tempfile.mkdtemp(prefix="bench_hub_"))
        urls = [f"udp-listen:127.0.0.1:{port}", *(f"udp:127.0.0.1:{each}" for each in clients)]
        settings = folder / "gateway.toml"
        settings.write_text(
            f'aircraft_folder = "{folder}"\n[hub]\nendpoints = {json.dumps(urls)}\n'
            f'[recording]\nmode = "{mode}"\nfolder = "{folder}"\n'
        )
        program = str(Path(sys.executable).with_name("mavgate"))
        at = ["--config", str(settings), "--socket", str(folder / "run.sock")]
        return [program, *at, "run", "--plain", "--port", "none"]

    return build


def source_frames(vehicles: int = 1) -> list[bytes]:
    """Make the frames that the source sends: of one vehicle one kind, of several `KINDS` each."""
    kinds = [mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] if vehicles == 1 else _kinds()
    frames = []
    for number in range(FRAMES):
        turn, vehicle = divmod(number, vehicles)
        payload = number.to_bytes(PAYLOAD_BYTES, "little").replace(b"\0", b"\1")
        header = bytes((PAYLOAD_BYTES, 0, 0, turn % 256, *vehicle_ids(vehicle)))
        message_id = kinds[turn % len(kinds)]
        content = header + message_id.to_bytes(3, "little") + payload
        crc = mavlink.x25crc(content + CRC_EXTRA[message_id]).crc
        frames.append(b"\xfd" + content + crc.to_bytes(2, "little"))
    return frames


def _kinds() -> list[int]:
    """Return telemetry whose frames may all have the same size."""
    sizes = {key: base_size(key) or 0 for key in CRC_EXTRA if key not in TARGET_OFFSETS}
    return [key for key, size in sorted(sizes.items()) if size >= PAYLOAD_BYTES][:KINDS]


def vehicle_ids(number: int) -> tuple[int, int]:
    """Return system and component of a vehicle: 100 systems, of several components each."""
    return SOURCE_SYSTEM + number % 100, 1 + number // 100


def heartbeat() -> bytes:
    """Encode a heartbeat, without which some forwarders do not forward."""
    message = mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3)
    return bytes(message.pack(mavlink.MAVLink(None, SOURCE_SYSTEM, 1)))


def udp_socket(port: int = 0) -> socket.socket:
    """Open a socket on a loopback port, by default a free one."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    sock.bind(("127.0.0.1", port))
    sock.setblocking(False)
    return sock


def cpu_ns(pid: int) -> int:
    """Return the processor time of a process."""
    return sum(
        int(task.read_text().split()[0]) for task in Path(f"/proc/{pid}/task").glob("*/schedstat")
    )


def resident_kib(pid: int) -> int:
    """Return the resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0])


def stamp_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """Return the kernel's receive timestamp from the ancillary data of `recvmsg`."""
    seconds, nanoseconds = struct.unpack("=qq", ancillary[0][2])
    return int(seconds * 1_000_000_000 + nanoseconds)


class Messages:
    """Parts of a buffer as an array of `struct mmsghdr`."""

    def __init__(self, buffer: Any, count: int) -> None:
        size = len(buffer) // count
        parts = np.full((count, 2), size)
        parts[:, 0] = buffer.ctypes.data + np.arange(count) * size
        headers = np.zeros((count, 8), np.int64)
        headers[:, 2] = parts.ctypes.data + np.arange(count) * parts.strides[0]
        headers[:, 3] = 1
        self.sizes = headers[:, 7]
        self._headers = headers
        self._kept = buffer, parts

    def address_of(self, index: int) -> int:
        """Return the address of a header."""
        return int(self._headers.ctypes.data) + index * self._headers.strides[0]


class Bench:
    """A running forwarder with its source and its clients."""

    source_port = 0
    """Port from which frames are sent: the first free one, then always the same."""

    def __init__(self, command: Command, clients: int, frames: list[bytes]) -> None:
        self._frames = frames
        self._length = len(frames[0])
        self._sinks = [udp_socket() for _ in range(clients)]
        self._poll = select.poll()
        self._by_fd = {sink.fileno(): index for index, sink in enumerate(self._sinks)}
        for sink in self._sinks:
            sink.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            self._poll.register(sink, select.POLLIN)
        with udp_socket() as probe:
            self.port: int = probe.getsockname()[1]
        self._source = udp_socket(self.source_port)
        Bench.source_port = self._source.getsockname()[1]
        self._source.connect(("127.0.0.1", self.port))
        self._counts = [0] * clients
        self._stamps: list[list[int]] | None = None
        self._sent = Messages(np.frombuffer(b"".join(frames), np.uint8), len(frames))
        self._arrived = Messages(np.zeros(BATCH * 2048, np.uint8), BATCH)
        self.process = subprocess.Popen(
            command(self.port, [sink.getsockname()[1] for sink in self._sinks]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
        )
        if len(CORES) > 1:
            os.sched_setaffinity(self.process.pid, CORES[-1:])
        self._wait_until_up()

    def close(self) -> None:
        """End the forwarder."""
        self.process.terminate()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for sock in (*self._sinks, self._source):
            sock.close()

    def throughput(self, seconds: float, window: int) -> Throughput:
        """Keep a window of frames in transit and measure the rate."""
        self._counts = [0] * len(self._counts)
        sent, lost = 0, 0
        begin_ns, begin_cpu = time.perf_counter_ns(), cpu_ns(self.process.pid)
        end_ns = begin_ns + round(seconds * 1e9)
        moved_ns = begin_ns
        while True:
            now_ns = time.perf_counter_ns()
            room = window - (sent - lost - min(self._counts))
            while now_ns < end_ns and room > 0:
                done = self._send_some(sent % FRAMES, room)
                sent, room = sent + done, room - done
            if now_ns >= end_ns and min(self._counts) == sent:
                break
            if self._drain(20):
                moved_ns = time.perf_counter_ns()
            elif now_ns - moved_ns > STALL_S * 1e9:
                lost, moved_ns = sent - min(self._counts), now_ns
                if now_ns >= end_ns:
                    break
        elapsed_s = (moved_ns - begin_ns) / 1e9
        used_ns = cpu_ns(self.process.pid) - begin_cpu
        delivered = sum(self._counts)
        lost = sent * len(self._sinks) - delivered
        return Throughput(delivered / elapsed_s, used_ns / max(1, delivered) / 1000, lost)

    def latency(self, seconds: float, rate_hz: int) -> Latency:
        """Send at a fixed rate and compare the kernel's timestamps with the times of sending."""
        self._counts = [0] * len(self._counts)
        self._stamps = [[] for _ in self._sinks]
        sent_ns: list[int] = []
        begin_cpu, begin_ns = cpu_ns(self.process.pid), time.time_ns()
        for number in range(round(seconds * rate_hz)):
            due_ns = begin_ns + number * 1_000_000_000 // rate_hz
            while (wait_ns := due_ns - time.time_ns()) > 0:
                for sink in select.select(self._sinks, (), (), wait_ns / 1e9)[0]:
                    self._take(sink.fileno())
            sent_ns.append(time.time_ns())
            self._send(self._frames[number % FRAMES])
        elapsed_ns = time.time_ns() - begin_ns
        used_ns = cpu_ns(self.process.pid) - begin_cpu
        self._settle()
        stamps, self._stamps = self._stamps, None
        whole = [row for row in stamps if len(row) == len(sent_ns)]
        times_us = np.concatenate([np.subtract(row, sent_ns) for row in whole] or [[0]]) / 1000
        return Latency(
            p50_us=float(np.percentile(times_us, 50)),
            p99_us=float(np.percentile(times_us, 99)),
            max_us=float(times_us.max()),
            cpu_percent=100 * used_ns / elapsed_ns,
            lost=len(sent_ns) * len(stamps) - sum(self._counts),
            gap_us=max((float(np.diff(row).max()) for row in stamps if len(row) > 1), default=0.0)
            / 1000,
        )

    def commanded(self, vehicles: int) -> int:
        """Send a command to each of some vehicles; return the number that arrived."""
        self._send(self._frames[0])
        self._sinks[0].setblocking(True)
        _, forwarder = self._sinks[0].recvfrom(2048)
        self._sinks[0].setblocking(False)
        self._settle()
        station = mavlink.MAVLink(None, 255, 190)
        for number in range(vehicles):
            ask = mavlink.MAVLink_command_long_message(
                *vehicle_ids(number), mavlink.MAV_CMD_REQUEST_MESSAGE, 0, *(0,) * 7
            )
            self._sinks[0].sendto(ask.pack(station), forwarder)
            station.seq = (station.seq + 1) % 256
            time.sleep(0.002)
        reached: set[tuple[int, int]] = set()
        end_s = time.monotonic() + COMMANDED_S
        reader = mavlink.MAVLink(None)
        while time.monotonic() < end_s and len(reached) < vehicles:
            if select.select([self._source], (), (), 0.1)[0]:
                for message in reader.parse_buffer(self._source.recv(2048)) or []:
                    if message.get_type() == "COMMAND_LONG":
                        reached.add((message.target_system, message.target_component))
        return len(reached)

    def run_until(self, delivered: int) -> Iterator[tuple[int, int]]:
        """Forward until `delivered` messages are delivered; yield count and KiB repeatedly."""
        total = 0
        while total < delivered:
            self.throughput(2.0, WINDOWS[0])
            if not any(self._counts):
                raise RuntimeError("the forwarder has stopped")
            total += sum(self._counts)
            yield total, resident_kib(self.process.pid)

    def _wait_until_up(self) -> None:
        limit = time.monotonic() + START_LIMIT_S
        while time.monotonic() < limit:
            self._send(heartbeat())
            self._send(self._frames[0])
            self._drain(50)
            if min(self._counts) > 2:
                time.sleep(0.2)
                self._settle()
                return
            time.sleep(0.05)
        self.close()
        raise RuntimeError(f"{self.process.args!r} forwards nothing")

    def _send(self, frame: bytes) -> None:
        with contextlib.suppress(ConnectionRefusedError):
            self._source.send(frame)

    def _send_some(self, first: int, most: int) -> int:
        """Send frames from `first` on; return their number."""
        count = min(most, BATCH, FRAMES - first)
        return max(0, send_many(self._source.fileno(), self._sent.address_of(first), count))

    def _settle(self) -> None:
        """Read until nothing arrives for 0.1 s."""
        while self._drain(100):
            pass

    def _drain(self, wait_ms: int) -> int:
        """Read all received datagrams; return the number of frames."""
        return sum(self._take(fd) for fd, _ in self._poll.poll(wait_ms))

    def _take(self, fd: int) -> int:
        index = self._by_fd[fd]
        count = self._read_stamps(index) if self._stamps else self._read(index)
        self._counts[index] += count
        return count

    def _read(self, index: int) -> int:
        # Other frames, such as heartbeats, are shorter than ours; a datagram may have several.
        file, total, count = self._sinks[index].fileno(), 0, BATCH
        while count == BATCH:
            count = receive_many(file, self._arrived.address_of(0), BATCH)
            total += int((self._arrived.sizes[: max(0, count)] // self._length).sum())
        return total

    def _read_stamps(self, index: int) -> int:
        assert self._stamps is not None
        sink, row, before = self._sinks[index], self._stamps[index], len(self._stamps[index])
        try:
            while True:
                data, ancillary, _, _ = sink.recvmsg(2048, 64)
                row += [stamp_ns(ancillary)] * (len(data) // self._length)
        except BlockingIOError:
            return len(row) - before


class WebBench(Bench):
    """The hub with clients at its WebSocket port that count frames in the messages."""

    def __init__(self, clients: int, frames: list[bytes]) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._web_port: int = probe.getsockname()[1]
        self._rests: list[bytes] = []
        super().__init__(self._command, clients, frames)

    def _command(self, port: int, clients: list[int]) -> list[str]:  # noqa: ARG002
        web = f"ws-listen:127.0.0.1:{self._web_port}"
        return hub_command(f"udp-listen:127.0.0.1:{port}", web)

    def _wait_until_up(self) -> None:
        """Replace the UDP sockets by WebSockets."""
        for index, sink in enumerate(self._sinks):
            self._poll.unregister(sink)
            sink.close()
            self._sinks[index] = self._open_web()
        self._by_fd = {sink.fileno(): index for index, sink in enumerate(self._sinks)}
        self._rests = [b""] * len(self._sinks)
        for sink in self._sinks:
            sink.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            self._poll.register(sink, select.POLLIN)
        super()._wait_until_up()

    def _open_web(self) -> socket.socket:
        limit = time.monotonic() + START_LIMIT_S
        while True:
            try:
                sink = socket.create_connection(("127.0.0.1", self._web_port))
                break
            except ConnectionRefusedError:
                if time.monotonic() > limit:
                    raise
                time.sleep(0.05)
        sink.sendall(HANDSHAKE)
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += sink.recv(1)
        sink.setblocking(False)
        return sink

    def _read(self, index: int) -> int:
        return self._messages(index, self._received(index)[0])

    def _read_stamps(self, index: int) -> int:
        assert self._stamps is not None
        data, ancillary = self._received(index)
        count = self._messages(index, data)
        self._stamps[index] += [stamp_ns(ancillary)] * count if count else []
        return count

    def _received(self, index: int) -> tuple[bytes, list[tuple[int, int, bytes]]]:
        try:
            data, ancillary, _, _ = self._sinks[index].recvmsg(1 << 20, 64)
        except BlockingIOError:
            return b"", []
        return data, ancillary

    def _messages(self, index: int, chunk: bytes) -> int:
        """Return the number of complete messages, each with one frame of ours."""
        data = self._rests[index] + chunk
        count, at = 0, 0
        while at + 2 <= len(data) and at + 2 + data[at + 1] <= len(data):
            count += data[at + 1] == self._length
            at += 2 + data[at + 1]
        self._rests[index] = data[at:]
        return count


Start = Callable[[int, list[bytes]], Bench]
"""Starts a forwarder for a number of clients, with some frames."""


def lossless(bench: Bench, seconds: float) -> Throughput:
    """Return the fastest run without loss, or else the last one."""
    for window in WINDOWS:
        result = bench.throughput(seconds, window)
        if not result.lost:
            break
    return result


def summed_up(results: list[dict[str, float]]) -> dict[str, float]:
    """Return the median of the rounds for each figure, and the sum of the losses."""
    return {
        key: (sum if key == "lost" else statistics.median)([result[key] for result in results])
        for key in results[0]
    }


def measure(
    forwarders: dict[str, Start], clients: int, rounds: int, seconds: float
) -> dict[str, dict[str, dict[str, float]]]:
    """Run all forwarders with a number of clients, in turn."""
    frames = source_frames()
    found: dict[str, tuple[list[dict[str, float]], list[dict[str, float]]]] = {
        name: ([], []) for name in forwarders
    }
    for _ in range(rounds):
        for name, start in forwarders.items():
            bench = start(clients, frames)
            try:
                found[name][0].append(asdict(lossless(bench, seconds)))
                found[name][1].append(asdict(bench.latency(seconds, RATE_HZ)))
            finally:
                bench.close()
    return {
        name: {"throughput": summed_up(fast), "latency": summed_up(late)}
        for name, (fast, late) in found.items()
    }


def show(report: dict[str, dict[str, dict[str, dict[str, float]]]]) -> None:
    """Print the figures, with their ratios to the plain forwarder and to mavlink-router."""
    table = Table(title="Forwarding MAVLink, 44-byte frames, loopback", box=box.SIMPLE_HEAD)
    for column in ("clients", "forwarder", "lossless/s", "CPU µs/msg", f"CPU % @{RATE_HZ}/s",
                   "p50 µs", "p99 µs", "lost"):  # fmt: skip
        table.add_column(column, justify="right")
    for clients, by_name in report.items():
        for name, figures in by_name.items():
            cells = []
            for part, key, form in COLUMNS:
                value = figures[part][key]
                bases = [by_name[base][part][key] for base in ("plain", REFERENCE)
                         if base in by_name]  # fmt: skip
                ratios = " ".join(f"{value / base:.2f}" for base in bases if base)
                cells.append(f"{value:{form}} ({ratios})")
            lost = figures["throughput"]["lost"] + figures["latency"]["lost"]
            table.add_row(clients, name, *cells, f"{lost:.0f}")
    Console(width=140).print(table)
    print("in brackets: times the plain forwarder, times mavlink-router")


def measure_vehicles(
    forwarders: dict[str, Start], vehicles: list[int], clients: int, rounds: int, seconds: float
) -> dict[str, dict[str, dict[str, float]]]:
    """Measure the cost of frames of some vehicles behind one link, and command each of them."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for count in vehicles:
        frames, runs = (
            source_frames(count),
            {name: list[tuple[float, float]]() for name in forwarders},
        )
        reached = dict.fromkeys(forwarders, 0)
        for _ in range(rounds):
            for name, start in forwarders.items():
                bench = start(clients, frames)
                try:
                    # The first frame of each kind is routed.
                    bench.throughput(WARM_UP_S, WINDOWS[0])
                    fast = bench.throughput(seconds, WINDOWS[0])
                    late = bench.latency(seconds, RATE_HZ)
                    runs[name].append((fast.cpu_us_per_message, late.cpu_percent))
                    reached[name] = bench.commanded(count) if name != "plain" else 0
                finally:
                    bench.close()
        found[str(count)] = {
            name: {
                "cpu_us_per_message": statistics.median(fast for fast, _ in figures),
                "cpu_percent": statistics.median(late for _, late in figures),
                "commanded": reached[name],
            }
            for name, figures in runs.items()
        }
    show_vehicles(found)
    return found


def show_vehicles(found: dict[str, dict[str, dict[str, float]]]) -> None:
    """Print the figures of vehicles behind one link, with their ratios to the bare hub."""
    table = Table(title=f"Vehicles of {KINDS} kinds of frame behind one link", box=box.SIMPLE_HEAD)
    for column in ("vehicles", "forwarder", "CPU µs/msg", f"CPU % @{RATE_HZ}/s", "commanded"):
        table.add_column(column, justify="right")
    for count, by_name in found.items():
        for name, figures in by_name.items():
            cells = [
                f"{figures[key]:.2f} ({figures[key] / by_name[HUB_NAME][key]:.2f})"
                for key in ("cpu_us_per_message", "cpu_percent")
            ]
            table.add_row(count, name, *cells, f"{figures['commanded']:.0f}")
    Console(width=120).print(table)
    print("in brackets: times the bare hub")


def watch_memory(messages: int) -> dict[str, int]:
    """Forward many messages through the hub to 16 clients and measure its memory."""
    bench = Bench(hub(), 16, source_frames())
    track: list[tuple[int, int]] = []
    try:
        for total, kib in bench.run_until(messages):
            track.append((total, kib))
            print(f"{total:>12,} delivered  {kib:>8,} KiB", flush=True)
    finally:
        bench.close()
    return {"delivered": track[-1][0], "first_kib": track[0][1], "last_kib": track[-1][1]}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="duration of each run")
    parser.add_argument("--clients", type=int, nargs="+", default=CLIENTS)
    parser.add_argument("--uvloop", action="store_true", help="compare the hub on uvloop")
    for name in ROUTERS:
        parser.add_argument(f"--{name}", metavar="COMMAND", help=f"compare {name}, by its command")
    parser.add_argument(
        "--router", action="append", default=[], metavar="NAME=COMMAND",
        help="compare another router: its command with {in} and {out} for ports",
    )  # fmt: skip
    parser.add_argument(
        "--vehicles", type=int, nargs="+", help="measure these numbers of vehicles of one link"
    )
    parser.add_argument(
        "--memory", type=int, metavar="MESSAGES", help="only measure memory over this many messages"
    )
    options = parser.parse_args()
    os.sched_setaffinity(0, CORES[:1])
    report: dict[str, object] = {"load_before": os.getloadavg(), "cores": os.cpu_count()}
    forwarders: dict[str, Start] = {
        "plain": partial(Bench, plain),
        HUB_NAME: partial(Bench, hub()),
        PACKED: partial(Bench, hub("?pack=1100")),
        WEB: WebBench,
    }
    if options.uvloop:
        forwarders[UVLOOP] = partial(Bench, hub(event_loop=UVLOOP))
    for name, arguments in ROUTERS.items():
        if command := getattr(options, name.replace("-", "_")):
            forwarders[name] = partial(Bench, router(f"{command} {arguments}"))
    for given in options.router:
        name, _, command = given.partition("=")
        forwarders[name] = partial(Bench, router(command))
    if options.memory:
        report["memory"] = watch_memory(options.memory)
    elif options.vehicles:
        for name in (PACKED, WEB):
            del forwarders[name]
        forwarders |= {
            RUN: partial(Bench, daemon("manual")),
            RECORDING: partial(Bench, daemon("always")),
        }
        report["vehicles"] = measure_vehicles(
            forwarders, options.vehicles, options.clients[0], options.rounds, options.seconds
        )
    else:
        figures = {
            str(clients): measure(forwarders, clients, options.rounds, options.seconds)
            for clients in options.clients
        }
        show(figures)
        report["forwarding"] = figures
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
