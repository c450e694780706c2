"""Measure the effect of a faulty client of the hub on the others.

Four healthy clients of the hub are sent 500 messages a second while a fifth one has a fault, or
untrusted clients send forged frames, too many requests, or open too many connections. For each
fault, runs with and without it take turns; the healthy clients must lose no frame and have no gap
above 100 ms, and their p99 latency must be within twice the undisturbed one. The source of the
fault takes processor time too, which on two cores affects the result.
"""

import asyncio
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Any

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.records import ClientInterval, Outgoing
from gateway.vehicle.services.ftp import Opcode, Packet
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.ground_station import command, ftp_message, ftp_request, to_vehicle
from tests.kit.mavlink import STATION, Sender, packed
from tests.ports import free_ports
from tools.bench_hub import HANDSHAKE, SOURCE_SYSTEM, Bench, source_frames
from tools.harness import PYTHON, Figures, arguments, medians, running, show, write_json

HEALTHY = 4
RATE_HZ = 500
LIMIT = 2.0
"""Maximum p99 latency, in multiples of the undisturbed one."""
GAP_LIMIT_US = 100_000
SETTLE_S = 4.0
"""Pause after a fault: a dead client is removed after three seconds."""
RELOAD_S = 0.2
TRUSTED, UNTRUSTED = "127.0.0.1", "127.0.0.2"
"""Addresses of the hub, by whether it trusts their clients."""
PORTS = 31
TURN_S = 0.005
"""Interval of batches of traffic, which have the rates below on average."""
SELF = (PYTHON, "-m", "tools.fault_hub")
Batch = Iterator[Callable[[], object]]
Fault = Callable[[], AbstractContextManager[object]]


def sent(message: Any, system: int = 200) -> bytes:
    """Encode the message of a ground station."""
    return packed(message, system, STATION)


def heartbeat_of(system: int) -> bytes:
    """Encode the heartbeat of a ground station."""
    return Sender(system, STATION).heartbeat()


def caller(host: str, port: int) -> socket.socket:
    """Open a socket that only sends to the hub."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect((host, port))
    return sock


def forge(port: int) -> Batch:
    """Send forged heartbeats of the source as a station and of its components, and its frames."""
    client = caller(UNTRUSTED, port)
    frames = itertools.cycle(source_frames())
    names = itertools.cycle(range(1, 250))
    while True:
        yield lambda: client.send(Sender(SOURCE_SYSTEM, 1).heartbeat())
        yield lambda: client.send(Sender(next(names), next(names)).heartbeat())
        yield lambda: client.send(next(frames))


def asking(port: int, host: str, frame: bytes, ports: int = PORTS) -> Batch:
    """Send the same request from many ports in turn."""
    callers = [caller(host, port) for _ in range(ports)]
    for sock in callers:
        sock.send(heartbeat_of(200))
    for sock in itertools.cycle(callers):
        yield partial(sock.send, frame)


def bursts(port: int) -> Batch:
    """Request a file byte by byte, repeatedly, from many ports."""
    callers = [(sock, ftp_session(sock)) for sock in (caller(UNTRUSTED, port) for _ in range(16))]
    for sock, session in itertools.cycle(callers):
        by_bytes = Packet(1, session, Opcode.BURST_READ_FILE, 1, 0, 0, 0, b"")
        yield partial(sock.send, sent(ftp_message(by_bytes)))


def ftp_session(sock: socket.socket) -> int:
    """Open the vehicle's parameter metadata and return the session."""
    parser = mavlink.MAVLink(None)
    sock.settimeout(0.1)
    while True:
        sock.send(sent(ftp_request(Opcode.OPEN_FILE_RO, b"/parameter.json.xz")))
        for _ in range(50):
            try:
                data = sock.recv(2048)
            except TimeoutError:
                break
            for message in parser.parse_buffer(data) or ():
                if message.get_type() == "FILE_TRANSFER_PROTOCOL":
                    return int(message.payload[2])


def crowd(port: int) -> Batch:
    """Use all clients that the port allows, and request more, from one machine."""
    callers = [caller(UNTRUSTED, port) for _ in range(100)]
    frames = [heartbeat_of(1 + number) for number in range(100)]
    for sock, frame in itertools.cycle(zip(callers, frames, strict=True)):
        yield partial(sock.send, frame)


def twins(port: int) -> Batch:
    """Send the same requests at the same times as two stations with one id."""
    callers, station = [caller(TRUSTED, port) for _ in range(2)], Sender(254, STATION)
    while True:
        frame = station.pack(request(to_all=False))
        for sock in callers:
            yield partial(sock.send, frame)


def visit(port: int, clients: int) -> Batch:
    """Send one heartbeat each from new ports, as some stations in turn."""
    for system in itertools.cycle(range(1, 1 + clients)):
        with caller(TRUSTED, port) as client:
            yield partial(client.send, heartbeat_of(system))


def odd(port: int) -> Batch:
    """Send empty datagrams, and the longest ones with begins of frames or without."""
    client = caller(TRUSTED, port)
    client.send(heartbeat_of(200))
    for data in itertools.cycle((b"", b"\xfe" * 65507, b"\xfd" * 65507, bytes(65507))):
        yield partial(client.send, data)


def read(port: int, opening: bytes = b"") -> Batch:
    """Read a stream."""
    link = socket.create_connection((TRUSTED, port))
    link.sendall(opening)
    while True:
        yield lambda: link.recv(4096)


def join(port: int) -> Batch:
    """Connect another gateway by two links."""

    async def joined() -> None:
        links = tuple(f"udp:127.0.0.{host}:{port}" for host in (1, 3))
        Hub(HubSettings(endpoints=links), lambda _: None, GatewayClock()).start()
        await asyncio.Event().wait()

    yield lambda: asyncio.run(joined())


def request(*, to_all: bool) -> Any:
    """Return a request for AUTOPILOT_VERSION, whose answer is sent to the client or to all."""
    return command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148, 0, 0, 0, 0, 0, 2 if to_all else 0)


TO_ALL, TO_ONE = (sent(request(to_all=to_all)) for to_all in (True, False))
LIST = sent(to_vehicle("PARAM_REQUEST_LIST"))
PING = sent(mavlink.MAVLink_ping_message(5, 1, 0, 0))
READ, READ_WEB = "a client reads", "a browser reads"
VISIT = "1000 clients a second come and go"
TRAFFIC: dict[str, tuple[Callable[[int], Batch], int]] = {
    "a client is killed, again and again": (lambda port: visit(port, 1), 20),
    VISIT: (lambda port: visit(port, 200), 1000),
    "datagrams of 0 and 65507 bytes": (odd, 200),
    "untrusted clients forge heartbeats and copies": (forge, 1000),
    "an untrusted client asks for answers to all, 400/s": (
        lambda port: asking(port, UNTRUSTED, TO_ALL, 1), 400
    ),
    "31 untrusted clients ask 4000 times a second": (
        lambda port: asking(port, UNTRUSTED, TO_ONE), 4000
    ),
    "31 trusted clients ask 4000 times a second": (lambda port: asking(port, TRUSTED, PING), 4000),
    "31 untrusted clients request all parameters, 400/s": (
        lambda port: asking(port, UNTRUSTED, LIST), 400
    ),
    "16 untrusted clients have files sent byte by byte": (bursts, 21),
    "one machine crowds a port": (crowd, 1000),
    "two stations with one id ask the same": (twins, 200),
    "another gateway is joined twice": (join, 200),
    READ: (read, 1000),
    READ_WEB: (lambda port: read(port, HANDSHAKE), 1000),
}  # fmt: skip
"""Hostile or faulty traffic to a port: function, and rate in Hz."""


def send_traffic(port: int, kind: str) -> None:
    """Send one kind of traffic until killed."""
    make, rate_hz = TRAFFIC[kind]
    batch, begin_s, done = make(port), time.monotonic(), 0
    while True:
        due = round((time.monotonic() - begin_s) * rate_hz)
        for act in itertools.islice(batch, due - done):
            try:
                act()
            except ConnectionRefusedError:
                time.sleep(TURN_S)
        done = due
        time.sleep(TURN_S)


async def serve(port: int, tcp_port: int, web_port: int, closed_port: int, *clients: int) -> None:
    """Run the measured hub, with a vehicle; SIGHUP adds or removes a client with a closed port."""
    calm = HubSettings(
        endpoints=(
            *(f"udp-listen:{TRUSTED}:{port}", f"tcp-listen:{TRUSTED}:{tcp_port}"),
            f"udp-listen:{UNTRUSTED}:{port}?trusted=no",
            f"udp-listen:127.0.0.3:{port}?trusted=yes",
            f"ws-listen:{TRUSTED}:{web_port}",
            *(f"udp:127.0.0.1:{client}" for client in clients),
        )
    )
    refused = msgspec.structs.replace(
        calm, endpoints=(*calm.endpoints, f"udp:127.0.0.1:{closed_port}")
    )
    clock, vehicle = GatewayClock(), Vehicle(VehicleSettings(), 1)

    def perform(actions: Iterable[object]) -> None:
        for action in actions:
            if isinstance(action, Outgoing):
                hub.send(action)
            elif isinstance(action, ClientInterval):
                hub.set_interval(action)

    hub = Hub(
        calm,
        lambda incoming: perform(vehicle.handle(incoming, clock())),
        clock,
        on_gone=vehicle.remove_client,
    )
    hub.start()
    asyncio.get_running_loop().add_signal_handler(
        signal.SIGHUP, lambda: hub.apply(refused if hub.settings is calm else calm)
    )
    while True:
        perform(vehicle.poll(clock()))
        await asyncio.sleep(0.01)


class FaultBench(Bench):
    """The hub with a TCP and a WebSocket port, and faults of its clients."""

    def __init__(self) -> None:
        self._others = free_ports(3)
        super().__init__(self._command, HEALTHY, source_frames())

    def _command(self, port: int, clients: list[int]) -> list[str]:
        ports = (port, *self._others, *clients)
        return [*SELF, "--serve", *map(str, ports)]

    def faults(self) -> dict[str, Fault]:
        """Return the faults by name."""
        tcp_port, web_port, _ = self._others
        return {
            "a client stops, TCP open": partial(self.stopped, tcp_port, READ),
            "a browser stalls, WebSocket open": partial(self.stopped, web_port, READ_WEB),
            "a port is refused": self.refused,
            "settings are reloaded 5 times a second": self.reloaded,
            **{
                kind: partial(self.traffic, self.port, kind)
                for kind in TRAFFIC
                if kind not in (READ, READ_WEB)
            },
        }

    @contextmanager
    def refused(self) -> Iterator[None]:
        """Add a client whose port is closed."""
        self.process.send_signal(signal.SIGHUP)
        time.sleep(RELOAD_S)
        yield
        self.process.send_signal(signal.SIGHUP)

    @contextmanager
    def reloaded(self) -> Iterator[None]:
        """Add and remove that client repeatedly."""
        ended = threading.Event()

        def reload() -> None:
            while not ended.is_set():
                for _ in ("add", "remove"):
                    self.process.send_signal(signal.SIGHUP)
                    time.sleep(RELOAD_S)

        thread = threading.Thread(target=reload)
        thread.start()
        yield
        ended.set()
        thread.join()

    @contextmanager
    def stopped(self, port: int, kind: str) -> Iterator[None]:
        """Stop a reading client with its connection open."""
        with self.traffic(port, kind) as client:
            os.kill(client.pid, signal.SIGSTOP)
            yield
            os.kill(client.pid, signal.SIGCONT)

    @contextmanager
    def traffic(self, port: int, kind: str) -> Iterator["subprocess.Popen[bytes]"]:
        """Run one kind of hostile traffic."""
        with running(*SELF, "--traffic", str(port), kind, stderr=None) as source:
            time.sleep(1.0)
            yield source
            if source.poll() is not None:
                raise SystemExit(f"{source.args!r} ended")
        if kind == VISIT:
            time.sleep(SETTLE_S)


def measure(bench: FaultBench, fault: Fault, rounds: int, seconds: float) -> Figures:
    """Measure runs without and with a fault in turn."""
    calm: list[Figures] = []
    disturbed: list[Figures] = []
    for _ in range(rounds):
        for trouble, results in ((nullcontext, calm), (fault, disturbed)):
            with trouble():
                results.append(bench.latency(seconds, RATE_HZ))
    before, after = (medians(results, maxima=["gap_us"]) for results in (calm, disturbed))
    return after | {"p99_calm_us": before["p99_us"], "gap_calm_us": before["gap_us"]}


def holds(found: Figures) -> bool:
    """Return whether the healthy clients were not affected."""
    latency_holds = found["p99_us"] <= LIMIT * found["p99_calm_us"]
    return not found["lost"] and latency_holds and found["gap_us"] <= GAP_LIMIT_US


def main() -> None:
    """Run all faults."""
    parser = arguments(__doc__, rounds=3, seconds=2.0)
    parser.add_argument("--only", metavar="WORD", default="", help="faults with this word")
    options = parser.parse_args()
    with FaultBench() as bench:
        found = {
            name: measure(bench, fault, options.rounds, options.seconds)
            for name, fault in bench.faults().items()
            if options.only in name
        }
    keys = ("lost", "p99_calm_us", "p99_us", "gap_calm_us", "gap_us")
    show(
        f"{HEALTHY} healthy clients at {RATE_HZ} messages/s",
        ("fault", "lost", "p99 µs quiet", "p99 µs", "gap µs quiet", "gap µs", "holds"),
        [
            (name, *(row[key] for key in keys), "yes" if holds(row) else "no")
            for name, row in found.items()
        ],
    )
    write_json(options, found)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        asyncio.run(serve(*map(int, sys.argv[2:])))
    elif sys.argv[1:2] == ["--traffic"]:
        send_traffic(int(sys.argv[2]), sys.argv[3])
    else:
        main()
