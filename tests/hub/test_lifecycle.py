"""Every transport and output: opens, sends, receives, stalls, breaks, opens again, and closes."""

import asyncio
import contextlib
import os
import pty
import socket
import ssl
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import msgspec
import pytest
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, Request

from gateway.hub.stats import ListenerStats
from gateway.hub.transports.base import STALE_AFTER_US
from gateway.hub.transports.stream import PROBE_S, USER_TIMEOUT_MS
from gateway.outputs import extend
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavlinkSplitter
from tests.hub.web.conftest import certificate
from tests.kit.hub import GROUP, Rig, member
from tests.kit.mavlink import Sender, frames_of
from tests.kit.messages import at, beat
from tests.ports import free_port

__all__ = ["certificate"]

pytestmark = pytest.mark.io

RAW_IMU, ATTITUDE = 27, 30


class Far(ABC):
    """The far end of one endpoint: reads without blocking, writes, breaks and returns."""

    url = ""
    pem = ""
    """File with the certificate and key of both ends."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.splitter = MavlinkSplitter()
        self.data = bytearray()
        self.frames: list[bytes] = []
        self.sizes: list[int] = []
        """Of the datagrams, messages or chunks that were read."""
        self.open()
        rig.closing.append(self.shut)

    @abstractmethod
    def open(self) -> None:
        """Start, or start again at the same address."""

    def arrive(self, port: int) -> None:  # noqa: B027
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
                self.data += data
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

    def arrive(self, port: int) -> None:
        self.target = ("127.0.0.1", port)
        self.write(self.rig.sender(255, 190).heartbeat())


class GroupFar(UdpFar):
    def open(self) -> None:
        super().open()
        self.url = f"udp-broadcast:127.0.0.1:{self.port}"


class MulticastFar(UdpFar):
    def open(self) -> None:
        self.socket = member(self.rig)
        self.url = f"udp-multicast:{GROUP}:{self.socket.getsockname()[1]}"


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
        data = self.peer.recv(65535)
        if not data and hasattr(self, "server"):
            # The gateway connects again.
            self.peer.close()
            self.peer = None
        return data

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

    def arrive(self, port: int) -> None:
        self.use(socket.create_connection(("127.0.0.1", port)))

    def shut(self) -> None:
        if self.peer is not None:
            self.peer.close()


class TlsFar(TcpFar):
    """A server that asks for a certificate, or a client."""

    word, verifies = "tls", ssl.CERT_REQUIRED

    def open(self) -> None:
        super().open()
        self.url = self.url.replace("tcp", self.word)

    def use(self, peer: socket.socket) -> None:
        is_server = hasattr(self, "server")
        purpose = ssl.Purpose.CLIENT_AUTH if is_server else ssl.Purpose.SERVER_AUTH
        context = ssl.create_default_context(purpose, cafile=self.pem)
        if is_server:
            context.load_cert_chain(self.pem)
            context.verify_mode = self.verifies
        name = None if is_server else "127.0.0.1"
        super().use(context.wrap_socket(peer, is_server, False, server_hostname=name))

    def shut(self) -> None:
        if isinstance(self.peer, ssl.SSLSocket):
            with contextlib.suppress(OSError):
                self.peer.unwrap()
        super().shut()


class MqttFar(TcpFar):
    """A broker that acknowledges everything."""

    def read(self) -> bytes:
        data = super().read()
        if data[:1] == b"\x10":
            self.write(b"\x20\x02\x00\x00")
        elif data[:1] in (b"\x32", b"\x33"):
            size = 4 + int.from_bytes(data[2:4], "big")
            self.write(b"\x40\x02" + data[size : size + 2])
        return data


class WebFar(TcpFar):
    """A WebSocket server by wsproto."""

    role, word = ConnectionType.SERVER, "ws"
    hello = b""

    def open(self) -> None:
        super().open()
        self.url = self.url.replace("tcp", self.word)
        self.web = WSConnection(self.role)

    def read(self) -> bytes:
        payload = b""
        while not payload:
            if self.hello and self.peer is not None:
                self.peer.send(self.hello)
                self.hello = b""
            data = super().read()
            if self.peer is None:
                self.web = WSConnection(self.role)
            if not data:
                break
            self.web.receive_data(data)
            for event in self.web.events():
                if isinstance(event, Request) and self.peer is not None:
                    self.peer.send(self.web.send(AcceptConnection()))
                elif isinstance(event, BytesMessage):
                    self.sizes.append(len(event.data))
                    payload += event.data
        return payload

    def write(self, data: bytes) -> None:
        super().write(self.web.send(BytesMessage(data=data)))


class WebCaller(WebFar, TcpCaller):
    role = ConnectionType.CLIENT

    def arrive(self, port: int) -> None:
        super().arrive(port)
        self.hello = self.web.send(Request(host="127.0.0.1", target="/"))


class SecureFar(WebFar, TlsFar):
    word, verifies = "wss", ssl.CERT_NONE


class SecureCaller(WebCaller, TlsFar):
    word = "wss"


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


KINDS: dict[str, type[Far]] = {
    "udp": UdpFar, "udp-listen": UdpCaller, "udp-broadcast": GroupFar,
    "udp-multicast": MulticastFar, "serial": SerialFar,
    "tcp": TcpFar, "tcp-listen": TcpCaller, "ws": WebFar, "ws-listen": WebCaller,
    "wss": SecureFar, "wss-listen": SecureCaller,
}  # fmt: skip
OUTPUTS: dict[str, type[Far]] = {
    "nmea:udp": UdpFar, "nmea:udp-broadcast": GroupFar,
    "cot:udp-multicast": MulticastFar, "nmea:tcp": TcpFar,
    "nmea:tcp-listen": TcpCaller, "nmea:serial": SerialFar, "cot:udp": UdpFar, "cot:tcp": TcpFar,
    "cot:tls": TlsFar, "gdl90:udp": UdpFar, "rotator:tcp": TcpFar, "rotator:serial": SerialFar,
    "mqtt:tcp": MqttFar,
}  # fmt: skip
ALL = KINDS | OUTPUTS
LISTENING = [kind for kind in ALL if kind.endswith("listen")]
STREAMS = [kind for kind, far in ALL.items() if issubclass(far, TcpFar) and far is not MqttFar]
PACKING = ("udp", "udp-listen", "udp-broadcast", "ws", "ws-listen", "wss")
MARKS = {
    "nmea": b"$GPGGA", "cot": b"a-f-A-M-H-Q", "gdl90": b"\x7e\x00", "rotator": b"W",
    "mqtt": b'GLOBAL_POSITION_INT"',
}  # fmt: skip
"""Occurs once in every message of an output."""


class Link:
    """One endpoint of a hub, of MAVLink or an output, with its far end."""

    def __init__(
        self, rig: Rig, kind: str, options: str = "", *, port: int = 0, **settings: object
    ) -> None:
        extend()
        self.rig, self.kind = rig, kind
        self.output, _, carrier = kind.rpartition(":")
        self.far = ALL[kind](rig)
        if carrier == "tls":
            options = f"?authority={Far.pem}&certificate={Far.pem}"
        elif self.output == "rotator":
            options = "?station=1,2,3"
        self.url = kind[: -len(carrier)] + self.far.url + options
        if port:
            self.url = self.url.replace(":0", f":{port}")
        files = {"tls_certificate": Far.pem, "tls_authority": Far.pem}
        self.hub = rig.hub(self.url, ping_interval_s=0.0, **files, **settings)
        rig.publish(self.hub, rig.vehicle.heartbeat())
        if self.output:
            # It is turned by hand.
            self.clients[0]._timer.cancel()

    @property
    def clients(self) -> list[Any]:
        return [*self.hub._clients.values()]

    @property
    def peers(self) -> list[Any]:
        """Every connection or socket, also those of an output's carrier."""
        if self.output in ("", "mqtt"):
            return self.clients
        return [*self.clients[0].carrier.peers.values()]

    @property
    def port(self) -> ListenerStats:
        """The listening port, also that of an output's carrier."""
        if not self.output:
            return self.hub.listeners()[0]
        found: ListenerStats = self.clients[0].carrier.link.stats()
        return found

    def is_open(self) -> bool:
        return [client.state for client in self.hub.clients()] == ["open"] and bool(self.peers)

    def arrive(self, far: Far) -> None:
        far.arrive(self.port.port if self.kind in LISTENING else 0)

    async def until_open(self) -> None:
        self.arrive(self.far)
        await self.until(self.is_open)
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

    def arrived_at(self, far: Far) -> int:
        """Return how many of the sent messages a far end has received."""
        if self.output:
            return far.data.count(MARKS[self.output])
        return sum(frame[7] == ATTITUDE for frame in far.frames)

    @property
    def arrived(self) -> int:
        return self.arrived_at(self.far)

    def send(self) -> None:
        """Send one message: an attitude, or that of an output."""
        if not self.output:
            self.rig.publish(self.hub, self.rig.vehicle.attitude())
            return
        self.rig.clock.now_us += US_PER_S
        self.rig.publish(self.hub, *map(Sender(1, 1).pack, (beat(), at())))
        (output,) = self.clients
        for data in output.compose(self.rig.clock()):
            output.put(data)

    async def is_sent(self) -> None:
        before = self.arrived
        self.send()
        await self.until(lambda: self.arrived == before + 1)


@pytest.fixture(autouse=True)
def pem(certificate: Path) -> None:
    Far.pem = str(certificate)


@pytest.fixture(params=ALL)
async def any_link(request: pytest.FixtureRequest, rig: Rig) -> Link:
    link = Link(rig, request.param)
    await link.until_open()
    return link


@pytest.fixture(params=KINDS)
async def link(request: pytest.FixtureRequest, rig: Rig) -> Link:
    link = Link(rig, request.param)
    await link.until_open()
    return link


async def test_messages_are_sent(any_link: Link) -> None:
    before = any_link.hub.clients()[0]
    for _ in range(3):
        await any_link.is_sent()
    (client,) = any_link.hub.clients()
    assert (client.state, client.dropped, client.queued) == ("open", before.dropped, 0)
    assert client.sent >= before.sent + 3
    assert client.bytes_sent > before.bytes_sent


async def test_frames_are_received_and_garbage_is_counted(link: Link) -> None:
    await link.is_sent()
    station = link.rig.sender(255, 190)
    for garbage in (b"", b"garbage"):
        command = station.command(1, 1)
        link.far.write(garbage + command)
        await link.until(lambda: [i.frame for i in link.rig.incoming][-1:] == [command])  # noqa: B023
        (client,) = link.hub.clients()
        assert client.bytes_garbage == len(garbage)
    assert (255, 190) in client.systems


async def test_changed_filter_applies_to_the_open_client(link: Link) -> None:
    before = link.hub.clients()[0].client_id
    endpoints = (f"{link.far.url}?deny=RAW_IMU",)
    link.hub.apply(msgspec.structs.replace(link.hub.settings, endpoints=endpoints))
    link.rig.publish(link.hub, link.rig.vehicle.raw_imu(), link.rig.vehicle.attitude())
    await link.until(lambda: bool(link.numbers(ATTITUDE)))
    assert [client.client_id for client in link.hub.clients()] == [before]
    assert not link.numbers(RAW_IMU)


async def test_ended_peer_is_noticed_and_served_again_when_it_returns(any_link: Link) -> None:
    link = any_link
    if link.kind.endswith("cast"):
        pytest.skip("a broadcast has no peer")
    link.far.shut()

    def is_noticed() -> bool:
        link.send()
        link.rig.clock.now_us += 100_000
        return not link.is_open()

    await link.until(is_noticed)
    link.far.splitter.reset()
    link.far.data.clear()
    link.far.frames.clear()
    link.far.open()
    link.arrive(link.far)
    link.rig.clock.now_us += 2_000_000

    def is_served() -> bool:
        link.send()
        link.rig.clock.now_us += 100_000
        # Any of them: while the kernel passes no bytes on, a queue drops old frames and renumbers
        # those that follow.
        return link.arrived > 0

    await link.until(is_served)


@pytest.mark.parametrize("kind", STREAMS)
async def test_vanished_peer_is_probed_for_by_the_kernel(rig: Rig, kind: str) -> None:
    link = Link(rig, kind)
    await link.until_open()
    (peer,) = link.peers
    for level, name, value in (
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS),
        (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, USER_TIMEOUT_MS // 2000),
        (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, PROBE_S),
    ):
        assert peer._socket.getsockopt(level, name) == value, name


@pytest.mark.parametrize("kind", [kind for kind in STREAMS if kind in KINDS])
async def test_stalled_peer_loses_only_its_own_oldest_telemetry(rig: Rig, kind: str) -> None:
    link, lively = Link(rig, kind, queue_bytes=4096), rig.station()
    await link.until_open()
    await link.is_sent()
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


@pytest.mark.parametrize("kind", [kind for kind in STREAMS if kind in OUTPUTS])
async def test_stalled_peer_of_an_output_loses_whole_messages(rig: Rig, kind: str) -> None:
    link = Link(rig, kind, queue_bytes=4096)
    await link.until_open()
    link.send()
    (output,) = link.clients
    (message,) = output.compose(rig.clock())
    while not output.counters.dropped:
        output.put(message)
    await link.until(lambda: link.arrived == link.hub.clients()[0].sent)
    _, second, *_ = link.far.data.split(MARKS[link.output])
    assert len(link.far.data) == link.arrived * (len(MARKS[link.output]) + len(second))


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
    link = Link(rig, kind, port=taken.port)
    for _ in range(4):
        rig.tick(link.hub, 2)
    port = link.port
    assert (port.state, port.reason, port.port) == ("closed", "Address already in use", 0)
    assert caplog.text.count("Address already in use; trying again") == 1
    taken.socket.close()
    rig.tick(link.hub, 2)
    port = link.port
    assert (port.state, port.reason, port.port) == ("open", "", taken.port)


@pytest.mark.parametrize("kind", LISTENING)
async def test_port_serves_several_and_when_full_turns_others_away_until_one_is_stale(
    rig: Rig, kind: str
) -> None:
    link = Link(rig, kind, max_clients=2)
    await link.until_open()
    others = [type(link.far)(rig) for _ in range(3)]

    async def until_read(condition: Callable[[], bool]) -> None:
        await link.until(lambda: others[0].poll() is not None and condition())

    link.arrive(others[0])
    await until_read(lambda: len(link.peers) == 2)
    await until_read(lambda: {peer.state for peer in link.peers} == {"open"})
    link.send()
    await until_read(lambda: all(link.arrived_at(far) == 1 for far in (link.far, others[0])))
    link.arrive(others[1])
    await until_read(lambda: link.port.turned_away == 1)
    first, second = (peer.client_id for peer in link.peers)
    rig.clock.now_us += STALE_AFTER_US
    others[0].write(rig.sender(255, 190).heartbeat())
    await rig.until(lambda: link.hub.clients() and link.peers[1].heard_us == rig.clock())
    link.arrive(others[2])
    await until_read(lambda: first not in [peer.client_id for peer in link.peers])
    assert link.peers[0].client_id == second


async def test_removed_endpoint_closes_and_nothing_is_sent(any_link: Link) -> None:
    link = any_link
    output = link.clients[0]
    link.hub.remove(link.url)
    link.far.poll()
    before = link.arrived
    link.rig.publish(link.hub, link.rig.vehicle.attitude())
    if link.output:
        output.put(("topic", b"") if link.output == "mqtt" else MARKS[link.output])
    await link.rig.quiet()
    link.far.poll()
    assert link.arrived == before
    assert (link.hub.clients(), link.hub.endpoints()) == ((), ())


async def test_unexpected_error_closes_the_endpoint_and_the_next_tick_opens_it(
    any_link: Link, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    link = any_link
    (endpoint,) = link.hub._endpoints.values()
    with monkeypatch.context() as patched:
        patched.setattr(type(endpoint), "tick", lambda *_: 1 // 0)
        link.rig.tick(link.hub, 1)
        assert f"{endpoint.endpoint.name} is closed and opened again" in caplog.text
        shown: Any = link.port if link.kind in LISTENING else link.hub.clients()[0]
        assert (shown.state in ("unreachable", "closed"), shown.reason[:7]) == (True, "integer")
        if link.kind not in LISTENING:
            link.send()
            assert link.output == "mqtt" or link.hub.clients()[0].dropped > shown.dropped
    link.rig.tick(link.hub, 2)
    if link.kind in LISTENING:
        assert link.port.state == "open"
    else:
        await link.until(link.is_open)
        await link.is_sent()


async def test_closed_hub_leaves_no_client_and_no_task(any_link: Link) -> None:
    any_link.hub.close()
    assert any_link.hub.clients() == ()

    def is_left() -> bool:
        any_link.far.poll()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        return any("gateway" in repr(task) for task in others)

    await any_link.rig.until(lambda: not is_left())


@pytest.mark.parametrize("url", ["udp:127.0.0.1:1", "tcp:127.0.0.1:1", "zenoh:tcp/[::1]:1?site=a"])
async def test_endpoint_closed_while_it_opens_leaves_no_task(rig: Rig, url: str) -> None:
    rig.hub(url).close()
    await rig.quiet_some()
    assert asyncio.all_tasks() == {asyncio.current_task()}


@pytest.mark.parametrize("kind", ALL)
def test_uvloop_serves_every_endpoint_too(kind: str) -> None:
    uvloop = pytest.importorskip("uvloop")

    async def live() -> None:
        rig = Rig()
        try:
            link = Link(rig, kind)
            await link.until_open()
            await test_messages_are_sent(link)
            if kind in KINDS:
                await test_frames_are_received_and_garbage_is_counted(link)
            if not kind.endswith("cast"):
                await test_ended_peer_is_noticed_and_served_again_when_it_returns(link)
        finally:
            rig.close()
            await asyncio.sleep(0)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(live())
