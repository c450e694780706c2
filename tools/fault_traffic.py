"""Hostile traffic for `fault_hub.py`: forged frames, too many requests, too many clients.

    python -m tools.fault_traffic PORT KIND

The hub trusts clients at its address 127.0.0.1, and not those at 127.0.0.2, both on this port;
system 1 answers, and system 42 is the healthy source.
"""

import asyncio
import itertools
import socket
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

from pymavlink.dialects.v20 import common as mavlink

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.vehicle.services.ftp import Opcode, Packet
from tools.bench_hub import HANDSHAKE, SOURCE_SYSTEM, source_frames

TRUSTED, UNTRUSTED = "127.0.0.1", "127.0.0.2"
PORTS = 31
TURN_S = 0.005
"""Interval of batches, which have the rates below on average."""

Batch = Iterator[Callable[[], object]]


def packed(message: mavlink.MAVLink_message, system: int = 200, component: int = 190) -> bytes:
    """Encode one message."""
    return bytes(message.pack(mavlink.MAVLink(None, system, component)))


def heartbeat(system: int, component: int = 190) -> bytes:
    """Encode a ground station's heartbeat."""
    return packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), system, component)


def request_message(number: int, *, to_all: bool) -> bytes:
    """Encode a request for a message of the vehicle."""
    parameters = (number, 0, 0, 0, 0, 0, 2 if to_all else 0)
    return packed(mavlink.MAVLink_command_long_message(1, 1, 512, 0, *parameters))


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
        yield lambda: client.send(heartbeat(SOURCE_SYSTEM, 1))
        yield lambda: client.send(heartbeat(next(names), next(names)))
        yield lambda: client.send(next(frames))


def asking(port: int, host: str, frame: bytes, ports: int = PORTS) -> Batch:
    """Send the same request from many ports in turn."""
    callers = [caller(host, port) for _ in range(ports)]
    for sock in callers:
        sock.send(heartbeat(200))
    for sock in itertools.cycle(callers):
        yield partial(sock.send, frame)


def bursts(port: int) -> Batch:
    """Request a file byte by byte, repeatedly, from many ports."""
    callers = [(sock, ftp_session(sock)) for sock in (caller(UNTRUSTED, port) for _ in range(16))]
    for sock, session in itertools.cycle(callers):
        yield partial(sock.send, ftp(Opcode.BURST_READ_FILE, session, size=1))


def ftp_session(sock: socket.socket) -> int:
    """Open the vehicle's parameter metadata and return the session."""
    parser = mavlink.MAVLink(None)
    sock.settimeout(0.1)
    while True:
        sock.send(ftp(Opcode.OPEN_FILE_RO, 0, b"/parameter.json.xz"))
        for _ in range(50):
            try:
                data = sock.recv(2048)
            except TimeoutError:
                break
            for message in parser.parse_buffer(data) or ():
                if message.get_type() == "FILE_TRANSFER_PROTOCOL":
                    return int(message.payload[2])


def ftp(opcode: int, session: int, data: bytes = b"", size: int | None = None) -> bytes:
    """Encode one FTP request."""
    packet = Packet(1, session, opcode, len(data) if size is None else size, 0, 0, 0, data)
    return packed(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, packet.encode()))


def crowd(port: int) -> Batch:
    """Use all clients that the port allows, and request more, from one machine."""
    callers = [caller(UNTRUSTED, port) for _ in range(100)]
    frames = [heartbeat(1 + number) for number in range(100)]
    for sock, frame in itertools.cycle(zip(callers, frames, strict=True)):
        yield partial(sock.send, frame)


def twins(port: int) -> Batch:
    """Send the same requests at the same times as two stations with one id."""
    callers = [caller(TRUSTED, port) for _ in range(2)]
    link = mavlink.MAVLink(None, 254, 190)
    while True:
        message = mavlink.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
        frame = bytes(message.pack(link))
        link.seq = (link.seq + 1) % 256
        for sock in callers:
            yield partial(sock.send, frame)


def visit(port: int, clients: int) -> Batch:
    """Send one heartbeat each from new ports, as some stations in turn."""
    for system in itertools.cycle(range(1, 1 + clients)):
        with caller(TRUSTED, port) as client:
            yield partial(client.send, heartbeat(system))


def odd(port: int) -> Batch:
    """Send empty datagrams, and the longest ones with begins of frames or without."""
    client = caller(TRUSTED, port)
    client.send(heartbeat(200))
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


LIST = packed(mavlink.MAVLink_param_request_list_message(1, 1))
PING = packed(mavlink.MAVLink_ping_message(5, 1, 0, 0))
KINDS: dict[str, tuple[Callable[[int], Batch], int]] = {
    "forge": (forge, 1000),
    "to-all": (lambda p: asking(p, UNTRUSTED, request_message(148, to_all=True), 1), 400),
    "ports": (lambda p: asking(p, UNTRUSTED, request_message(148, to_all=False)), 4000),
    "trusted-ports": (lambda p: asking(p, TRUSTED, PING), 4000),
    "lists": (lambda p: asking(p, UNTRUSTED, LIST), 400),
    "bursts": (bursts, 21),
    "crowd": (crowd, 1000),
    "twins": (twins, 200),
    "die": (lambda port: visit(port, 1), 20),
    "visit": (lambda port: visit(port, 200), 1000),
    "odd": (odd, 200),
    "read": (read, 1000),
    "read-web": (lambda port: read(port, HANDSHAKE), 1000),
    "join": (join, 200),
}
"""Function and rate in Hz of each kind."""


def main() -> None:
    """Send hostile traffic until killed."""
    port, kind = int(sys.argv[1]), sys.argv[2]
    make, rate_hz = KINDS[kind]
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


if __name__ == "__main__":
    main()
