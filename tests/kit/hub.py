"""A hub on the manual clock, and its clients on loopback sockets or without a transport."""

import asyncio
import contextlib
import os
import resource
import select
import socket
import struct
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.hub.endpoint import parse_endpoint
from gateway.hub.forwarding import new_client_state
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.stats import ClientCounters
from gateway.hub.transports.base import Client
from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from tests.conftest import ManualClock
from tests.kit.mavlink import STATION, Sender, outgoing
from tests.kit.process import START_LIMIT_S, until
from tests.kit.records import sample_at, state_at
from tests.ports import free_port


async def receive(sock: socket.socket) -> bytes:
    """Wait for the next bytes of a socket that does not block."""
    async with asyncio.timeout(START_LIMIT_S):
        return await asyncio.get_running_loop().sock_recv(sock, 65536)


@contextlib.contextmanager
def no_descriptors() -> Iterator[None]:
    """Let the process open no file and no socket."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest_free = os.dup(0)
    os.close(lowest_free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


GROUP = "239.255.145.50"


def member(rig: "Rig") -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    rig.closing.append(sock.close)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((GROUP, 0))
    sock.setsockopt(
        socket.IPPROTO_IP,
        socket.IP_ADD_MEMBERSHIP,
        struct.pack("=4s4s", socket.inet_aton(GROUP), socket.inet_aton(source_address())),
    )
    return sock


def source_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((GROUP, 1))
        except OSError:
            pytest.skip("this machine has no route to multicast groups")
        return str(probe.getsockname()[0])


class Station:
    """A ground station's socket, read without blocking the loop.

    Without a target, it answers the address of the first datagram that it receives.
    """

    def __init__(
        self, target: int | None, kind: socket.SocketKind, origin: tuple[int, int]
    ) -> None:
        self.sender = Sender(*origin)
        self.socket = socket.socket(socket.AF_INET, kind)
        self.socket.setblocking(False)
        self.port = free_port()
        self.socket.bind(("127.0.0.1", self.port))
        self.target = ("127.0.0.1", target) if target else None

    async def receive(self) -> bytes:
        async with asyncio.timeout(START_LIMIT_S):
            data, source = await asyncio.get_running_loop().sock_recvfrom(self.socket, 65535)
        self.target = self.target or source
        return data

    def is_empty(self) -> bool:
        """Return whether there is nothing to read, without reading it."""
        return not select.select([self.socket], (), (), 0)[0]

    def received(self) -> list[bytes]:
        """Read all datagrams that have arrived."""
        frames = []
        with contextlib.suppress(BlockingIOError):
            while True:
                data, source = self.socket.recvfrom(65535)
                self.target = self.target or source
                frames.append(data)
        return frames

    def send(self, *frames: bytes) -> None:
        assert self.target
        for data in frames:
            self.socket.sendto(data, self.target)


class KeepingClient(Client):
    """A client without a transport that keeps the frames that it is sent, with their times."""

    def __init__(self, client_id: int, url: str = "udp:h:1", *, direct: bool = False) -> None:
        self.client_id = client_id
        self.endpoint = parse_endpoint(url)
        self.counters = ClientCounters()
        self.routes = {}
        self.heard_us = None
        self.memory = new_client_state(client_id)
        self.now_us = 0
        self.sent: list[tuple[int, MavFrame]] = []
        self._direct = direct

    @property
    def is_direct(self) -> bool:
        return self._direct

    @property
    def frames(self) -> list[bytes]:
        return [frame.data for _, frame in self.sent]

    def since(self, since_us: int) -> list[bytes]:
        return [frame.data for us, frame in self.sent if us >= since_us]

    def transmit(self, frame: MavFrame) -> None:
        assert frame == frame_of(frame.data)
        self.sent.append((self.now_us, frame))

    def send_rest(self, frames: Iterable[bytes], *_: int) -> None:
        for data in frames:
            self.transmit(frame_of(data))


class FlyingHub:
    """A hub with a real vehicle; `fly` sends its frames of this moment."""

    def __init__(self, rig: "Rig", system: int, *endpoints: str, **settings: Any) -> None:
        self.clock = rig.clock
        self.vehicle = Vehicle(VehicleSettings(), system)
        self.hub = Hub(
            HubSettings(endpoints=endpoints, **settings),
            lambda incoming: self.perform(self.vehicle.handle(incoming, self.clock())),
            self.clock,
            lambda _: None,
            on_gone=self.vehicle.remove_client,
        )
        rig.closing.append(self.hub.close)
        self.hub.start()

    def perform(self, actions: Iterable[Any]) -> None:
        """Send frames and apply intervals: no client may change anything else."""
        for action in actions:
            if isinstance(action, Outgoing):
                self.hub.send(action)
            else:
                assert isinstance(action, ClientInterval)
                self.hub.set_interval(action)

    def fly(self) -> list[Any]:
        now_us = self.clock()
        found = self.vehicle.on_state(state_at(now_us), sample_at(now_us), now_us)
        self.perform([*found, *self.vehicle.poll(now_us)])
        return found


class Rig:
    """Hubs, the frames they received, a vehicle, and the stations; all closed at the end."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.incoming: list[Incoming] = []
        self.foreign: list[bytes] = []
        self.vehicle = Sender(1, 1)
        self.closing: list[Callable[[], object]] = []

    def close(self) -> None:
        for close in self.closing:
            close()
        self.closing.clear()

    def hub(
        self,
        *endpoints: str,
        signer: FrameSigner | None = None,
        recordings: Path | None = None,
        on_frame: Callable[[Incoming], None] | None = None,
        **settings: object,
    ) -> Hub:
        wanted = HubSettings(endpoints=endpoints, **settings)
        taps = (on_frame or self.incoming.append, self.clock, self.foreign.extend)
        hub = Hub(wanted, *taps, signer=signer, recordings=recordings)
        self.closing.append(hub.close)
        hub.start()
        return hub

    async def open(self, *endpoints: str, **settings: Any) -> Hub:
        """Return a hub whose clients are all open."""
        hub = self.hub(*endpoints, **settings)
        await self.until_open(hub)
        return hub

    async def call(self, hub: Hub, number: int = 0, **options: Any) -> Station:
        """Return a station that is served by a listening port, after its first heartbeat."""
        station, before = self.station(hub.listening_ports()[number], **options), self.received
        station.send(station.sender.heartbeat())
        await self.until(lambda: self.received > before)
        return station

    @property
    def received(self) -> int:
        """How many frames the hubs have received for their vehicles."""
        return len(self.incoming)

    def publish(self, hub: Hub, *frames: bytes) -> None:
        """Send frames of our vehicle to all."""
        for frame in frames:
            hub.send(outgoing(frame))

    async def check_passes(self, hub: Hub, *stations: Station) -> None:
        """Send one frame of telemetry, which each of the stations receives next."""
        frame = self.vehicle.attitude()
        self.publish(hub, frame)
        for station in stations:
            assert await station.receive() == frame

    def station(
        self,
        target: int | None = None,
        kind: socket.SocketKind = socket.SOCK_DGRAM,
        *,
        origin: tuple[int, int] = (255, STATION),
    ) -> Station:
        station = Station(target, kind, origin)
        self.closing.append(station.socket.close)
        return station

    async def connect(
        self, port: int, kind: socket.SocketKind = socket.SOCK_STREAM, *, room_bytes: int = 0
    ) -> socket.socket:
        """Return a socket that is connected to a port, with a receive buffer of some size."""
        sock = socket.socket(socket.AF_INET, kind)
        self.closing.append(sock.close)
        sock.setblocking(False)
        if room_bytes:
            # Before it connects: a window that shrinks later makes the kernel drop data.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room_bytes)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, 536)
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", port))
        return sock

    def sender(self, system: int, component: int = 1, *, signed: bool = False) -> Sender:
        return Sender(system, component, signed=signed)

    def out(self, frame: bytes, client_id: int | None = None) -> Outgoing:
        return outgoing(frame, client_id)

    def tick(self, hub: Hub, seconds: float = 0.0) -> None:
        """Let time pass, and run the hub's periodic tasks."""
        self.clock.advance(seconds)
        # Its own timer runs on the machine's clock.
        assert hub._timer
        hub._timer.cancel()
        hub._tick()

    async def until(self, condition: Callable[[], object]) -> None:
        await until(condition)

    async def tick_until(self, hub: Hub, condition: Callable[[], object]) -> None:
        """Let the hub tick until something holds: threads of its links take their time."""
        async with asyncio.timeout(START_LIMIT_S):
            while not condition():
                self.tick(hub, 0.1)
                await asyncio.sleep(0.01)

    async def quiet(self) -> None:
        """Let all frames arrive: on loopback each step takes one turn of the loop."""
        for _ in range(200):
            await asyncio.sleep(0)

    async def quiet_some(self) -> None:
        """Let the hub read and send waiting frames."""
        for _ in range(6):
            await asyncio.sleep(0)

    async def until_open(self, hub: Hub) -> None:
        await self.until(lambda: all(client.state == "open" for client in hub.clients()))


@pytest.fixture
async def loop_errors() -> list[Any]:
    """Errors that the event loop has reported."""
    errors: list[Any] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context))
    return errors


@pytest.fixture
async def rig() -> AsyncIterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()
