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

import contextlib
import json
import os
import select
import shlex
import socket
import struct
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from gateway.compiled.system_calls import receive_many, send_many
from gateway.wire.mavlink_messages import CRC_EXTRA, TARGET_OFFSETS, base_size
from tools.harness import (
    CORES,
    MAVGATE,
    PYTHON,
    Figures,
    arguments,
    cpu_s,
    medians,
    port_of,
    running,
    show,
    text_of,
    udp_socket,
    write_json,
)

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
KINDS = 20
"""Kinds of frame of each of several vehicles."""
PAYLOAD_BYTES = 32
WARM_UP_S = 2.0
HUB_NAME, RUN, RECORDING = "mavgate", "mavgate run", "recording"
"""Names of the bare hub, and of the whole gateway without and with a recording."""
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

COLUMNS = ("delivered_per_s", "cpu_us_per_message", "cpu_percent", "p50_us", "p99_us")
Command = Callable[[int, list[int]], list[str]]


def plain(port: int, clients: list[int]) -> list[str]:
    """Return the command line of the plain forwarder."""
    return [PYTHON, "-c", PLAIN, str(port), *map(str, clients)]


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
    return [PYTHON, "-c", HUB, event_loop, *endpoints]


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
        at = ["--config", str(settings), "--socket", str(folder / "run.sock")]
        return [*MAVGATE, *at, "run", "--plain", "--port", "none"]

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
            self.port = port_of(probe)
        self._source = udp_socket(self.source_port)
        Bench.source_port = port_of(self._source)
        self._source.connect(("127.0.0.1", self.port))
        self._counts = [0] * clients
        self._stamps: list[list[int]] | None = None
        self._sent = Messages(np.frombuffer(b"".join(frames), np.uint8), len(frames))
        self._arrived = Messages(np.zeros(BATCH * 2048, np.uint8), BATCH)
        self._opened = contextlib.ExitStack()
        for sock in (*self._sinks, self._source):
            self._opened.callback(sock.close)
        self.process = self._opened.enter_context(
            running(*command(self.port, [port_of(sink) for sink in self._sinks]))
        )
        os.sched_setaffinity(self.process.pid, CORES[-1:])
        self._wait_until_up()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the forwarder."""
        self._opened.close()

    def throughput(self, seconds: float, window: int) -> Figures:
        """Keep a window of frames in transit and measure the rate."""
        self._counts = [0] * len(self._counts)
        sent, lost = 0, 0
        begin_ns, begin_cpu_s = time.perf_counter_ns(), cpu_s(self.process.pid)
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
        delivered = sum(self._counts)
        return {
            "delivered_per_s": delivered / (1e-9 * (moved_ns - begin_ns)),
            "cpu_us_per_message": 1e6 * self._cpu_since(begin_cpu_s) / max(1, delivered),
            "lost": sent * len(self._sinks) - delivered,
        }

    def latency(self, seconds: float, rate_hz: int) -> Figures:
        """Send at a fixed rate and compare the kernel's timestamps with the times of sending.

        `gap_us` is the longest time without a frame at a client.
        """
        self._counts = [0] * len(self._counts)
        self._stamps = [[] for _ in self._sinks]
        sent_ns: list[int] = []
        begin_cpu_s, begin_ns = cpu_s(self.process.pid), time.time_ns()
        for number in range(round(seconds * rate_hz)):
            due_ns = begin_ns + number * 1_000_000_000 // rate_hz
            while (wait_ns := due_ns - time.time_ns()) > 0:
                for sink in select.select(self._sinks, (), (), wait_ns / 1e9)[0]:
                    self._take(sink.fileno())
            sent_ns.append(time.time_ns())
            self._send(self._frames[number % FRAMES])
        share = self._cpu_since(begin_cpu_s) / (1e-9 * (time.time_ns() - begin_ns))
        self._settle()
        stamps, self._stamps = self._stamps, None
        whole = [row for row in stamps if len(row) == len(sent_ns)]
        times_us = np.concatenate([np.subtract(row, sent_ns) for row in whole] or [[0]]) / 1000
        gaps_ns = [float(np.diff(row).max()) for row in stamps if len(row) > 1]
        return {
            "p50_us": float(np.percentile(times_us, 50)),
            "p99_us": float(np.percentile(times_us, 99)),
            "cpu_percent": 100 * share,
            "lost": len(sent_ns) * len(stamps) - sum(self._counts),
            "gap_us": max(gaps_ns, default=0.0) / 1000,
        }

    def _cpu_since(self, begin_s: float) -> float:
        return cpu_s(self.process.pid) - begin_s

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
        self._opened.close()
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
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self._web_port = port_of(probe)
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


def lossless(bench: Bench, seconds: float) -> Figures:
    """Return the fastest run without loss, or else the last one."""
    for window in WINDOWS:
        result = bench.throughput(seconds, window)
        if not result["lost"]:
            break
    return result


def in_turn(
    forwarders: Mapping[str, Start], clients: int, vehicles: int, rounds: int,
    measure: Callable[[Bench], Figures],
) -> dict[str, Figures]:  # fmt: skip
    """Measure all forwarders in turn; return the median round of each."""
    frames = source_frames(vehicles)
    found: dict[str, list[Figures]] = {name: [] for name in forwarders}
    for _ in range(rounds):
        for name, start in forwarders.items():
            with start(clients, frames) as bench:
                found[name].append(measure(bench))
    return {name: medians(rows) for name, rows in found.items()}


def measure_clients(
    forwarders: Mapping[str, Start], clients: list[int], rounds: int, seconds: float
) -> dict[str, dict[str, Figures]]:
    """Measure rate, cost and latency with some numbers of clients."""

    def measure(bench: Bench) -> Figures:
        fast, late = lossless(bench, seconds), bench.latency(seconds, RATE_HZ)
        return fast | late | {"lost": fast["lost"] + late["lost"]}

    found = {str(count): in_turn(forwarders, count, 1, rounds, measure) for count in clients}
    show(
        "Forwarding MAVLink, 44-byte frames, loopback; in brackets: times the plain forwarder, "
        "times mavlink-router",
        ("clients", "forwarder", "lossless/s", "CPU µs/msg", f"CPU % @{RATE_HZ}/s", "p50 µs",
         "p99 µs", "lost"),
        [
            (count, name, *(with_ratios(by_name, name, key, "plain", REFERENCE) for key in COLUMNS),
             figures["lost"])
            for count, by_name in found.items()
            for name, figures in by_name.items()
        ],
    )  # fmt: skip
    return found


def measure_vehicles(
    forwarders: Mapping[str, Start], vehicles: list[int], clients: int, rounds: int, seconds: float
) -> dict[str, dict[str, Figures]]:
    """Measure the cost of frames of some vehicles behind one link, and command each of them."""

    def measure(bench: Bench, count: int) -> Figures:
        # The first frame of each kind is routed.
        bench.throughput(WARM_UP_S, WINDOWS[0])
        fast, late = bench.throughput(seconds, WINDOWS[0]), bench.latency(seconds, RATE_HZ)
        return fast | late | {"commanded": bench.commanded(count)}

    found = {
        str(count): in_turn(forwarders, clients, count, rounds, partial(measure, count=count))
        for count in vehicles
    }
    keys = ("cpu_us_per_message", "cpu_percent")
    show(
        f"Vehicles of {KINDS} kinds of frame behind one link; in brackets: times the bare hub",
        ("vehicles", "forwarder", "CPU µs/msg", f"CPU % @{RATE_HZ}/s", "commanded"),
        [
            (count, name, *(with_ratios(by_name, name, key, HUB_NAME) for key in keys),
             figures["commanded"])
            for count, by_name in found.items()
            for name, figures in by_name.items()
        ],
    )  # fmt: skip
    return found


def with_ratios(by_name: Mapping[str, Figures], name: str, key: str, *bases: str) -> str:
    """Return a figure, with its ratios to those of other forwarders."""
    value = by_name[name][key]
    ratios = [value / by_name[base][key] for base in bases if by_name.get(base, {}).get(key)]
    return f"{text_of(value)} ({' '.join(f'{ratio:.2f}' for ratio in ratios)})"


def main() -> None:
    """Run the benchmark."""
    parser = arguments(__doc__, rounds=3, seconds=2.0)
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
    options = parser.parse_args()
    os.sched_setaffinity(0, CORES[:1])
    forwarders: dict[str, Start] = {"plain": partial(Bench, plain), HUB_NAME: partial(Bench, hub())}
    if options.vehicles:
        forwarders[RUN] = partial(Bench, daemon("manual"))
        forwarders[RECORDING] = partial(Bench, daemon("always"))
    else:
        forwarders |= {"packed": partial(Bench, hub("?pack=1100")), "WebSocket": WebBench}
    if options.uvloop:
        forwarders["uvloop"] = partial(Bench, hub(event_loop="uvloop"))
    for name, words in ROUTERS.items():
        if command := getattr(options, name.replace("-", "_")):
            forwarders[name] = partial(Bench, router(f"{command} {words}"))
    for given in options.router:
        name, _, command = given.partition("=")
        forwarders[name] = partial(Bench, router(command))
    if options.vehicles:
        found = measure_vehicles(
            forwarders, options.vehicles, options.clients[0], options.rounds, options.seconds
        )
    else:
        found = measure_clients(forwarders, options.clients, options.rounds, options.seconds)
    write_json(options, found)


if __name__ == "__main__":
    main()
