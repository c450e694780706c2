"""The hub on loopback sockets: what clients get, and what they may say."""

import asyncio
import socket
from collections.abc import AsyncIterator, Callable

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.edges.hub import Hub
from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.routing.settings import HubSettings

pytestmark = pytest.mark.io

GCS_HEARTBEAT = bytes(
    dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(dialect.MAVLink(None, 255, 190))
)
HEARTBEAT = bytes(
    dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(dialect.MAVLink(None, 1, 1))
)
ATTITUDE = bytes(
    dialect.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0).pack(dialect.MAVLink(None, 1, 1))
)


class Clock:
    def __init__(self) -> None:
        self.us = 0

    def __call__(self) -> int:
        return self.us


class Station:
    """A ground station's socket, read without blocking the loop."""

    def __init__(self, target: int | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.target = ("127.0.0.1", target) if target else None

    async def receive(self) -> bytes:
        return await asyncio.wait_for(asyncio.get_running_loop().sock_recv(self.socket, 65535), 5)

    def silent(self) -> bool:
        try:
            self.socket.recv(65535)
        except BlockingIOError:
            return True
        return False

    def say(self, data: bytes) -> None:
        assert self.target
        self.socket.sendto(data, self.target)


class Rig:
    """A hub with its clock, what came in, and the stations to be closed."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.incoming: list[Incoming] = []
        self.hubs: list[Hub] = []
        self.stations: list[Station] = []

    def hub(self, *endpoints: str, **settings: object) -> Hub:
        hub = Hub(
            HubSettings(endpoints=endpoints, **settings),  # type: ignore[arg-type]
            self.incoming.append,
            self.clock,
        )
        self.hubs.append(hub)
        hub.start()
        return hub

    def station(self, target: int | None = None) -> Station:
        self.stations.append(Station(target))
        return self.stations[-1]

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(5):
            while not condition():
                await asyncio.sleep(0)


@pytest.fixture
async def rig() -> AsyncIterator[Rig]:
    rig = Rig()
    yield rig
    for hub in rig.hubs:
        hub.close()
    for station in rig.stations:
        station.socket.close()


def out(frame: bytes, message_id: int, client_id: int | None = None) -> Outgoing:
    return Outgoing(frame, message_id, client_id)


def all_open(hub: Hub) -> Callable[[], bool]:
    return lambda: all(client.state == "open" for client in hub.clients())


async def test_configured_client_gets_frames_and_answers_the_same_socket(rig: Rig) -> None:
    station = rig.station()
    hub = rig.hub(f"udp:127.0.0.1:{station.port}?name=laptop")
    await rig.until(all_open(hub))
    hub.send(out(ATTITUDE, 30))
    assert await station.receive() == ATTITUDE
    _, address = None, None
    hub.send(out(HEARTBEAT, 0))
    data, address = station.socket.recvfrom(100)
    assert data == HEARTBEAT
    station.target = address
    station.say(GCS_HEARTBEAT)
    await rig.until(lambda: bool(rig.incoming))
    (client,) = hub.clients()
    assert rig.incoming == [Incoming(client.client_id, GCS_HEARTBEAT, trusted=True)]
    assert client.name == "laptop"
    assert (client.sent, client.bytes_sent, client.received) == (
        2,
        len(ATTITUDE) + len(HEARTBEAT),
        1,
    )
    assert client.systems == ((255, 190),)


async def test_whoever_speaks_to_the_port_is_served_and_greeted(rig: Rig) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0")
    home = bytes(
        dialect.MAVLink_home_position_message(1, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0).pack(
            dialect.MAVLink(None, 1, 1)
        )
    )
    hub.send(out(home, 242))
    hub.send(out(HEARTBEAT, 0))
    station = rig.station(hub.listening_ports()[0])
    station.say(GCS_HEARTBEAT)
    assert [await station.receive(), await station.receive()] == [HEARTBEAT, home]
    hub.send(out(ATTITUDE, 30))
    assert await station.receive() == ATTITUDE
    assert rig.incoming[0].trusted


async def test_noise_makes_no_client(rig: Rig) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0")
    noise = rig.station(hub.listening_ports()[0])
    for data in (b"", b"hello", b"\xfe" * 65507):
        noise.say(data)
    station = rig.station(hub.listening_ports()[0])
    station.say(GCS_HEARTBEAT)
    await rig.until(lambda: bool(rig.incoming))
    assert len(hub.clients()) == 1


async def test_a_silent_client_goes(rig: Rig) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0", idle_timeout_s=10.0)
    station = rig.station(hub.listening_ports()[0])
    station.say(GCS_HEARTBEAT)
    await rig.until(lambda: len(hub.clients()) == 1)
    rig.clock.us = 11_000_000
    await rig.until(lambda: not hub.clients())


async def test_at_most_so_many(rig: Rig) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0", max_clients=2)
    for _ in range(5):
        rig.station(hub.listening_ports()[0]).say(GCS_HEARTBEAT)
    last = rig.stations[0]
    last.say(GCS_HEARTBEAT)
    await rig.until(lambda: len(rig.incoming) >= 3)
    assert len(hub.clients()) == 2


async def test_a_refused_port_is_counted_and_hurts_nobody(rig: Rig) -> None:
    gone, station = rig.station(), rig.station()
    gone.socket.close()
    hub = rig.hub(f"udp:127.0.0.1:{gone.port}", f"udp:127.0.0.1:{station.port}")
    await rig.until(all_open(hub))
    for _ in range(10):
        hub.send(out(ATTITUDE, 30))
        assert await station.receive() == ATTITUDE
    refused, fine = hub.clients()
    assert refused.state == "refused"
    assert refused.sent + refused.dropped == 10
    assert (fine.sent, fine.dropped) == (10, 0)


async def test_a_station_that_starts_late_loses_nothing_after_its_start(rig: Rig) -> None:
    late = rig.station()
    late.socket.close()
    hub = rig.hub(f"udp:127.0.0.1:{late.port}")
    await rig.until(all_open(hub))
    for _ in range(5):
        hub.send(out(HEARTBEAT, 0))
    late.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    late.socket.setblocking(False)
    late.socket.bind(("127.0.0.1", late.port))
    hub.send(out(ATTITUDE, 30))
    assert await late.receive() == ATTITUDE


async def test_a_name_that_does_not_resolve_is_no_error(rig: Rig) -> None:
    hub = rig.hub("udp:no-such-host.invalid:14550")
    hub.send(out(ATTITUDE, 30))
    (client,) = hub.clients()
    assert (client.state, client.dropped) == ("resolving", 1)


async def test_an_answer_and_a_wish_concern_one_client(rig: Rig) -> None:
    first, second = rig.station(), rig.station()
    hub = rig.hub(f"udp:127.0.0.1:{first.port}", f"udp:127.0.0.1:{second.port}")
    await rig.until(all_open(hub))
    one, _ = hub.clients()
    hub.send(out(HEARTBEAT, 0, one.client_id))
    assert await first.receive() == HEARTBEAT
    hub.set_interval(ClientInterval(one.client_id, 1, 30, -1))
    hub.send(out(ATTITUDE, 30))
    assert len(await second.receive()) == len(ATTITUDE)
    assert first.silent()
    assert second.silent()


async def test_ipv6(rig: Rig) -> None:
    hub = rig.hub("udp-listen:[::1]:0")
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as station:
        station.setblocking(False)
        station.sendto(GCS_HEARTBEAT, ("::1", hub.listening_ports()[0]))
        await rig.until(lambda: len(hub.clients()) == 1)
        hub.send(out(ATTITUDE, 30))
        assert station.recv(100) == ATTITUDE
    assert hub.clients()[0].trusted
