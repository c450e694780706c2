"""Every transport: opens, sends, receives, breaks, opens again, is reconfigured, and closes."""

import asyncio
import contextlib
import os
import pty
import socket
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir

import msgspec
import pytest
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, Request

from gateway.hub.hub import Hub
from gateway.hub.transports.base import STALE_AFTER_US, Client
from gateway.hub.transports.serial_line import SerialClient
from gateway.hub.transports.tcp import TcpClient
from gateway.hub.transports.udp import UdpClient
from gateway.hub.transports.udp_group import GroupClient
from gateway.hub.transports.websocket import WsClient
from gateway.wire.mavlink_splitter import MavlinkSplitter
from tests.kit.hub import Rig
from tests.kit.mavlink import frames_of
from tests.ports import free_port

pytestmark = pytest.mark.io

RAW_IMU, ATTITUDE = 27, 30


class Far(ABC):
    """The far end of one endpoint: reads without blocking, writes, breaks and returns."""

    url = ""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.splitter = MavlinkSplitter()
        self.frames: list[bytes] = []
        self.sizes: list[int] = []
        """Of the datagrams, messages or chunks that were read."""
        self.open()
        rig.closing.append(self.shut)

    @abstractmethod
    def open(self) -> None:
        """Start, or start again at the same address."""

    def arrive(self, hub: Hub) -> None:  # noqa: B027
        """Connect, where it is the far end that connects."""

    @abstractmethod
    def read(self) -> bytes: ...

    @abstractmethod
    def write(self, data: bytes) -> None: ...

    @abstractmethod
    def shut(self) -> None:
        """End so that the gateway can notice."""

    def poll(self) -> list[bytes]:
        with contextlib.suppress(BlockingIOError, OSError):
            while data := self.read():
                self.frames += frames_of(self.splitter.feed(data))
        return self.frames


class UdpFar(Far):
    def open(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.port = getattr(self, "port", 0) or free_port()
        self.socket.bind(("127.0.0.1", self.port))
        self.url, self.target = f"udp:127.0.0.1:{self.port}", None

    def read(self) -> bytes:
        data, self.target = self.socket.recvfrom(65535)
        self.sizes.append(len(data))
        return data

    def write(self, data: bytes) -> None:
        self.socket.sendto(data, self.target)

    def shut(self) -> None:
        self.socket.close()


class UdpCaller(UdpFar):
    def open(self) -> None:
        super().open()
        self.url = "udp-listen:127.0.0.1:0"

    def arrive(self, hub: Hub) -> None:
        self.target = ("127.0.0.1", hub.listening_ports()[0])
        self.write(self.rig.sender(255, 190).heartbeat())


class GroupFar(UdpFar):
    def open(self) -> None:
        super().open()
        self.url = f"udp-broadcast:127.0.0.1:{self.port}"


class TcpFar(Far):
    peer: socket.socket | None = None

    def use(self, peer: socket.socket) -> None:
        peer.setblocking(False)
        # A small write would wait for the acknowledgement of the one before, 40 ms.
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.peer = peer

    def open(self) -> None:
        self.port = getattr(self, "port", 0) or free_port()
        self.server = socket.create_server(("127.0.0.1", self.port))
        self.server.setblocking(False)
        self.url, self.peer = f"tcp:127.0.0.1:{self.port}", None

    def read(self) -> bytes:
        if self.peer is None:
            self.use(self.server.accept()[0])
        return self.peer.recv(65535)

    def write(self, data: bytes) -> None:
        assert self.peer is not None
        self.peer.send(data)

    def shut(self) -> None:
        if self.peer is not None:
            self.peer.close()
        self.server.close()


class TcpCaller(TcpFar):
    def open(self) -> None:
        self.url, self.peer = "tcp-listen:127.0.0.1:0", None

    def arrive(self, hub: Hub) -> None:
        self.use(socket.create_connection(("127.0.0.1", hub.listening_ports()[0])))

    def shut(self) -> None:
        if self.peer is not None:
            self.peer.close()


class WebFar(TcpFar):
    """A WebSocket server by wsproto."""

    role = ConnectionType.SERVER

    def open(self) -> None:
        super().open()
        self.url = self.url.replace("tcp", "ws")
        self.web = WSConnection(self.role)

    def read(self) -> bytes:
        payload = b""
        while not payload:
            data = super().read()
            assert self.peer is not None
            if not data and self.role is ConnectionType.SERVER:
                # The gateway connects again.
                self.peer.close()
                self.peer, self.web = None, WSConnection(self.role)
            if not data:
                break
            self.web.receive_data(data)
            for event in self.web.events():
                if isinstance(event, Request):
                    self.peer.send(self.web.send(AcceptConnection()))
                elif isinstance(event, BytesMessage):
                    self.sizes.append(len(event.data))
                    payload += event.data
        return payload

    def write(self, data: bytes) -> None:
        super().write(self.web.send(BytesMessage(data=data)))


class WebCaller(WebFar, TcpCaller):
    role = ConnectionType.CLIENT

    def arrive(self, hub: Hub) -> None:
        super().arrive(hub)
        assert self.peer is not None
        self.peer.send(self.web.send(Request(host="127.0.0.1", target="/")))


class SerialFar(Far):
    def open(self) -> None:
        self.near, self.far = pty.openpty()
        os.set_blocking(self.near, False)
        tty.setraw(self.far)
        self.link = Path(gettempdir(), f"mavgate-{os.getpid()}-{id(self.rig)}")
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self.far))
        self.url = f"serial:{self.link}:115200"

    def read(self) -> bytes:
        return os.read(self.near, 4096)

    def write(self, data: bytes) -> None:
        os.write(self.near, data)

    def shut(self) -> None:
        self.link.unlink(missing_ok=True)
        for descriptor in (self.near, self.far):
            with contextlib.suppress(OSError):
                os.close(descriptor)


KINDS: dict[str, tuple[type[Far], type[Client] | None]] = {
    "udp": (UdpFar, UdpClient),
    "udp-listen": (UdpCaller, None),
    "udp-broadcast": (GroupFar, GroupClient),
    "tcp": (TcpFar, TcpClient),
    "tcp-listen": (TcpCaller, None),
    "ws": (WebFar, WsClient),
    "ws-listen": (WebCaller, None),
    "serial": (SerialFar, SerialClient),
}
"""The far end, and the gateway's if it is the gateway that connects."""
LISTENING = [kind for kind, (_, transport) in KINDS.items() if transport is None]
STREAMS = ("tcp", "tcp-listen", "ws", "ws-listen")
PACKING = ("udp", "udp-listen", "udp-broadcast", "ws", "ws-listen")
NOTICES_THE_END = set(KINDS) - {"udp-broadcast"}


class Link:
    """One endpoint of a hub with its far end."""

    def __init__(self, rig: Rig, kind: str, options: str = "", **settings: object) -> None:
        self.rig, self.kind = rig, kind
        far, self.transport = KINDS[kind]
        self.far = far(rig)
        self.hub = rig.hub(self.far.url + options, ping_interval_s=0.0, **settings)
        rig.publish(self.hub, rig.vehicle.heartbeat())

    async def until_open(self) -> None:
        self.far.arrive(self.hub)
        await self.until(lambda: [c.state for c in self.hub.clients()] == ["open"])
        self.far.poll()
        self.far.frames.clear()

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait, with the far end reading and the hub ticking."""

        def is_so() -> bool:
            self.far.poll()
            self.rig.clock.now_us += 2000
            # By hand: its own timer runs on the machine's clock, far behind the manual one.
            self.rig.tick(self.hub)
            return condition()

        await self.rig.until(is_so)

    def numbers(self, message_id: int) -> list[int]:
        """Return the sequence numbers of the received messages of a kind."""
        return [frame[4] for frame in self.far.frames if frame[7] == message_id]

    async def is_sent(self, frame: bytes) -> None:
        self.rig.publish(self.hub, frame)
        await self.until(lambda: frame in self.far.frames)


@pytest.fixture(params=KINDS)
async def link(request: pytest.FixtureRequest, rig: Rig) -> Link:
    link = Link(rig, request.param)
    await link.until_open()
    return link


async def test_frames_pass_in_both_directions_and_garbage_is_counted(link: Link) -> None:
    before = link.hub.clients()[0].dropped
    for _ in range(3):
        await link.is_sent(link.rig.vehicle.attitude())
    station = link.rig.sender(255, 190)
    for garbage in (b"", b"garbage"):
        command = station.command(1, 1)
        link.far.write(garbage + command)
        await link.until(lambda: [i.frame for i in link.rig.incoming][-1:] == [command])  # noqa: B023
        (client,) = link.hub.clients()
        assert client.bytes_garbage == len(garbage)
    assert (client.state, client.dropped, client.queued) == ("open", before, 0)
    assert client.sent >= 3
    assert (255, 190) in client.systems


async def test_changed_filter_applies_to_the_open_client(link: Link) -> None:
    before = link.hub.clients()[0].client_id
    endpoints = (f"{link.far.url}?deny=RAW_IMU",)
    link.hub.apply(msgspec.structs.replace(link.hub.settings, endpoints=endpoints))
    link.rig.publish(link.hub, link.rig.vehicle.raw_imu(), link.rig.vehicle.attitude())
    await link.until(lambda: bool(link.numbers(ATTITUDE)))
    assert [client.client_id for client in link.hub.clients()] == [before]
    assert not link.numbers(RAW_IMU)


async def test_ended_peer_is_noticed_and_served_again_when_it_returns(link: Link) -> None:
    if link.kind not in NOTICES_THE_END:
        pytest.skip("a broadcast has no peer")
    link.far.shut()

    def is_noticed() -> bool:
        link.rig.publish(link.hub, link.rig.vehicle.attitude())
        link.rig.clock.now_us += 100_000
        return [client.state for client in link.hub.clients()] != ["open"]

    await link.until(is_noticed)
    link.far.splitter.reset()
    link.far.frames.clear()
    link.far.open()
    link.far.arrive(link.hub)
    link.rig.clock.now_us += 2_000_000

    def is_served() -> bool:
        link.rig.publish(link.hub, link.rig.vehicle.attitude())
        link.rig.clock.now_us += 100_000
        # Any of them: while the kernel passes no bytes on, a queue drops old frames and renumbers
        # those that follow.
        return 30 in {frame[7] for frame in link.far.poll()}

    await link.until(is_served)


@pytest.mark.parametrize("kind", STREAMS)
async def test_stalled_peer_loses_only_its_own_oldest_telemetry(rig: Rig, kind: str) -> None:
    link, lively = Link(rig, kind, queue_bytes=4096), rig.station()
    await link.until_open()
    await link.is_sent(rig.vehicle.attitude())
    link.hub.add(f"udp:127.0.0.1:{lively.port}")
    await rig.until_open(link.hub)
    before, frames, got = link.hub.clients()[0], list[bytes](), list[bytes]()
    while link.hub.clients()[0].dropped < 500:
        frames += (batch := [rig.vehicle.raw_imu() for _ in range(50)])
        rig.publish(link.hub, *batch)
        await asyncio.sleep(0)
        got += lively.received()
    await rig.until(lambda: bool(got.extend(lively.received()) or len(got) >= len(frames)))
    assert got == frames
    await link.until(lambda: link.hub.clients()[0].queued == 0)
    slow, fast = link.hub.clients()
    assert (fast.sent, fast.dropped) == (len(frames), 0)
    passed = slow.sent - before.sent
    assert passed + slow.dropped - before.dropped == len(frames)
    await link.until(lambda: len(link.numbers(RAW_IMU)) == passed)
    first = link.numbers(RAW_IMU)[0]
    assert link.numbers(RAW_IMU) == [first + n & 255 for n in range(passed)], "without a gap"


@pytest.mark.parametrize("kind", PACKING)
async def test_packed_frames_share_datagrams_or_messages(rig: Rig, kind: str) -> None:
    link = Link(rig, kind, "?pack=200")
    await link.until_open()
    link.far.sizes.clear()
    frames = [rig.vehicle.raw_imu() for _ in range(9)]
    rig.publish(link.hub, *frames)
    await link.until(lambda: link.far.frames[-9:] == frames)
    assert len(link.far.sizes) <= 3
    assert max(link.far.sizes) <= 200


@pytest.mark.parametrize("kind", LISTENING)
async def test_taken_port_is_reported_once_and_opens_when_it_is_free(
    rig: Rig, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    taken = rig.station(kind=socket.SOCK_DGRAM if kind == "udp-listen" else socket.SOCK_STREAM)
    if kind != "udp-listen":
        taken.socket.listen()
    hub = rig.hub(f"{kind}:127.0.0.1:{taken.port}?name=here")
    for _ in range(4):
        rig.tick(hub, 2)
    (port,) = hub.listeners()
    assert (port.state, port.reason, port.port) == ("closed", "Address already in use", 0)
    assert caplog.text.count("Address already in use; trying again") == 1
    taken.socket.close()
    rig.tick(hub, 2)
    (port,) = hub.listeners()
    assert (port.state, port.reason, port.port) == ("open", "", taken.port)


@pytest.mark.parametrize("kind", LISTENING)
async def test_full_port_turns_clients_away_until_one_is_stale(rig: Rig, kind: str) -> None:
    link = Link(rig, kind, max_clients=2)
    await link.until_open()
    others = [type(link.far)(rig) for _ in range(3)]
    others[0].arrive(link.hub)
    await link.until(lambda: len(link.hub.clients()) == 2)
    await rig.quiet()
    others[0].poll()
    others[1].arrive(link.hub)
    await link.until(lambda: link.hub.listeners()[0].turned_away == 1)
    first, second = (client.client_id for client in link.hub.clients())
    rig.clock.now_us += STALE_AFTER_US
    others[0].write(rig.sender(255, 190).heartbeat())
    await rig.until(lambda: link.hub.clients()[1].heard_us == rig.clock())
    others[2].arrive(link.hub)
    await link.until(lambda: first not in [each.client_id for each in link.hub.clients()])
    assert link.hub.clients()[0].client_id == second


async def test_removed_endpoint_closes_and_nothing_is_sent(link: Link) -> None:
    link.hub.remove(link.far.url)
    link.far.poll()
    link.far.frames.clear()
    link.rig.publish(link.hub, link.rig.vehicle.attitude())
    await link.rig.quiet()
    link.far.poll()
    assert link.far.frames == []
    assert (link.hub.clients(), link.hub.endpoints()) == ((), ())


async def test_unexpected_error_closes_the_client_and_the_next_tick_opens_it(
    link: Link, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if link.transport is None:
        pytest.skip("the client leaves, and the port stays open")
    with monkeypatch.context() as patched:
        patched.setattr(link.transport, "tick", lambda *_: 1 // 0)
        link.rig.tick(link.hub)
        (client,) = link.hub.clients()
        assert (client.state, client.reason[:16]) == ("unreachable", "integer division")
        assert f"{link.far.url} is closed and opened again" in caplog.text
        link.rig.publish(link.hub, link.rig.vehicle.attitude())
        assert link.hub.clients()[0].dropped > client.dropped
    link.rig.clock.now_us += 1_000_000
    await link.until(lambda: link.hub.clients()[0].state == "open")


async def test_closed_hub_leaves_no_client_and_no_task(link: Link) -> None:
    link.hub.close()
    await link.rig.quiet()
    assert link.hub.clients() == ()
    others = asyncio.all_tasks() - {asyncio.current_task()}
    assert not [task for task in others if "gateway" in repr(task)]


@pytest.mark.parametrize("kind", KINDS)
def test_uvloop_serves_every_transport_too(kind: str) -> None:
    uvloop = pytest.importorskip("uvloop")

    async def live() -> None:
        rig = Rig()
        try:
            link = Link(rig, kind)
            await link.until_open()
            await test_frames_pass_in_both_directions_and_garbage_is_counted(link)
            if kind in NOTICES_THE_END:
                await test_ended_peer_is_noticed_and_served_again_when_it_returns(link)
        finally:
            rig.close()
            await asyncio.sleep(0)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(live())
