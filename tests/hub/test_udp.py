"""UDP clients, configured, of a port or a group: frames both ways, timeouts, packing."""

import asyncio
import socket
from random import Random
from typing import Any

import pytest

from gateway.hub.endpoint import parse_endpoint
from gateway.hub.forwarding_step import MAX_DATAGRAM
from gateway.hub.transports.udp import UdpClient
from tests.conftest import LoopTime
from tests.kit.hub import GROUP, member, receive
from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io


async def test_new_client_of_a_port_is_greeted_without_a_gap(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0")
    home, heartbeat = rig.vehicle.home(), rig.vehicle.heartbeat()
    rig.publish(hub, home, heartbeat)
    rig.vehicle.link.seq = 77
    station = await rig.call(hub)
    rig.publish(hub, rig.vehicle.attitude())
    frames = [await station.receive() for _ in range(3)]
    assert [frame[7] for frame in frames] == [0, 242, 30]
    assert [frame[4] for frame in frames] == [75, 76, 77]
    assert rig.incoming[0].trusted


@pytest.mark.parametrize("seed", range(4))
async def test_first_frames_of_new_clients_stay_in_order_while_the_loop_is_slow(
    rig: Any, seed: int
) -> None:
    """Datagrams arrive in bursts of any size between two turns of the loop."""
    random, got = Random(seed), list[bytes]()
    reader = rig.station()
    hub = await rig.open("udp-listen:127.0.0.1:0", f"udp:127.0.0.1:{reader.port}")
    new = [rig.station(hub.listening_ports()[0], origin=(n, 1)) for n in range(1, 4)]
    sent: dict[int, list[bytes]] = {n: [] for n in range(1, 4)}
    while sum(map(len, sent.values())) < 240:
        system = random.randint(1, 3)
        for _ in range(random.choice((1, 3, 20))):
            sent[system].append(new[system - 1].sender.attitude(time_ms=len(sent[system])))
            new[system - 1].send(sent[system][-1])
        for _ in range(random.randint(0, 2)):
            await asyncio.sleep(0)
            got += reader.received()
    await rig.quiet()
    got += reader.received()
    assert {n: [frame for frame in got if frame[5] == n] for n in sent} == sent


async def test_clients_of_one_port_are_distinguished(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0")
    port = hub.listening_ports()[0]
    stations = [rig.station(port, origin=(200 + number, 190)) for number in range(5)]
    for station in stations * 4:
        station.send(station.sender.heartbeat())
    await rig.until(lambda: len(rig.incoming) == 20)
    assert [client.received for client in hub.clients()] == [4] * 5
    assert {client.systems for client in hub.clients()} == {((n, 190),) for n in range(200, 205)}
    answered = hub.clients()[2]
    frame = rig.vehicle.attitude()
    hub.send(rig.out(frame, answered.client_id))
    receivers = [station for station in stations if not station.is_empty()]
    assert [f"127.0.0.1:{station.port}" for station in receivers] == [answered.remote]


async def test_datagrams_of_unusual_sizes_are_counted(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0")
    station = rig.station(hub.listening_ports()[0])
    station.send(station.sender.heartbeat(), b"", b"\xfd" * 65507, station.sender.heartbeat())
    await rig.until(lambda: len(rig.incoming) == 2)
    assert (hub.clients()[0].bytes_garbage, hub.clients()[0].cut) == (MAX_DATAGRAM, 1)
    # Now the compiled step reads the client's own socket.
    frames = [station.sender.attitude(time_ms=number) for number in range(3)]
    station.send(frames[0], frames[1].ljust(MAX_DATAGRAM + 1, b"\xfd"), frames[2])
    await rig.until(lambda: hub.clients()[0].received == 5)
    assert hub.clients()[0].cut == 2


async def refused(rig: Any) -> tuple[Any, Any]:
    """Return a hub and its only client, whose socket is closed."""
    hub = rig.hub("udp-listen:127.0.0.1:0", idle_timeout_s=1000.0)
    station = await rig.call(hub)
    station.socket.close()
    rig.publish(hub, rig.vehicle.attitude())
    await rig.until(lambda: hub.clients()[0].state == "refused")
    return hub, station


async def test_client_is_removed_after_its_host_refuses_and_may_return(rig: Any) -> None:
    hub, station = await refused(rig)
    rig.clock.now_us = 4_000_000
    await rig.until(lambda: not hub.clients())
    with listening_again(station) as again:
        again.sendto(station.sender.heartbeat(), station.target)
        await rig.until(lambda: hub.clients())


def listening_again(station: Any) -> socket.socket:
    """Return a socket at the address of a station that has ended."""
    again = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    again.setblocking(False)
    again.bind(("127.0.0.1", station.port))
    return again


async def test_refusing_client_gets_nothing_until_it_sends_again(rig: Any) -> None:
    hub, station = await refused(rig)
    rig.publish(hub, *(rig.vehicle.attitude() for _ in range(100)))
    (caller,) = hub.clients()
    assert (caller.sent + caller.unheard, caller.dropped) == (101, 0)
    assert caller.unheard >= 99
    assert caller.reason == "nobody listens there"
    with listening_again(station) as again:
        again.sendto(station.sender.heartbeat(), station.target)
        await rig.until(lambda: hub.clients()[0].received == 2)
        frame = rig.vehicle.attitude()
        rig.publish(hub, frame)
        assert await receive(again) == frame
    assert len(hub.clients()) == 1


async def test_client_that_returns_on_another_port_replaces_its_old_entry(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0", idle_timeout_s=1000.0)
    before, after = (rig.station(hub.listening_ports()[0]) for _ in range(2))
    before.send(before.sender.heartbeat())
    await rig.until(lambda: len(rig.incoming) == 1)
    rig.clock.now_us = 4_000_000
    after.send(after.sender.heartbeat())
    await rig.until(lambda: len(rig.incoming) == 2)
    await rig.until(lambda: len(hub.clients()) == 1)
    assert hub.clients()[0].remote == f"127.0.0.1:{after.port}"


@pytest.fixture
async def names(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[tuple[str, int]]]:
    """Resolve names to the addresses of a table instead."""
    known: dict[str, list[tuple[str, int]]] = {}

    async def resolve(host: str, _port: int, **_: object) -> list[object]:
        if host not in known:
            raise socket.gaierror(socket.EAI_AGAIN, "no network yet")
        return [(socket.AF_INET, socket.SOCK_DGRAM, 0, "", address) for address in known[host]]

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", resolve)
    return known


async def test_name_that_resolves_later_is_used_then(rig: Any, names: Any) -> None:
    station = rig.station()
    hub = rig.hub("udp:observer.example:14550")
    rig.publish(hub, rig.vehicle.attitude())
    (client,) = hub.clients()
    assert (client.state, client.dropped) == ("resolving", 1)
    names["observer.example"] = [("127.0.0.1", station.port)]
    rig.clock.now_us = 2_000_000
    await rig.until_open(hub)
    await rig.check_passes(hub, station)


async def test_second_address_of_a_name_is_used_when_the_first_refuses(
    rig: Any, names: Any
) -> None:
    """As `localhost` has, whose first address is often not the one that a station listens at."""
    station = rig.station()
    names["here.example"] = [(host, station.port) for host in ("127.0.0.2", "127.0.0.1")]
    hub = await rig.open(f"udp:here.example:{station.port}")
    assert hub.clients()[0].remote == f"127.0.0.2:{station.port}"
    rig.publish(hub, rig.vehicle.attitude())
    await rig.until(lambda: hub.clients()[0].state == "refused")
    for second in range(1, 5):
        rig.clock.now_us = second * 1_000_000
        rig.tick(hub)
        rig.publish(hub, rig.vehicle.attitude())
        assert hub.clients()[0].remote == f"127.0.0.1:{station.port}"
        assert (await station.receive())[7] == 30


async def test_changed_address_of_a_name_is_followed(rig: Any, names: Any) -> None:
    old, new = rig.station(), rig.station()
    names["observer.example"] = [("127.0.0.1", old.port)]
    hub = await rig.open("udp:observer.example:14550")
    await rig.check_passes(hub, old)
    names["observer.example"] = [("127.0.0.1", new.port)]
    rig.tick(hub, 61)
    await rig.until(lambda: hub.clients()[0].remote == f"127.0.0.1:{new.port}")
    await rig.check_passes(hub, new)
    assert new.target == old.target


async def test_packing_without_a_wait_joins_only_frames_of_one_wake_up(
    rig: Any, loop_time: LoopTime
) -> None:
    """Two datagrams that are read at one wake-up go on as one, without a timer."""
    station = rig.station()
    hub = await rig.open("udp-listen:127.0.0.1:0", f"udp:127.0.0.1:{station.port}?pack=1100")
    source = rig.station(hub.listening_ports()[0], origin=(42, 1))
    source.send(source.sender.heartbeat())
    assert (await station.receive())[5] == 42
    frames = [source.sender.attitude() for _ in range(3)]
    loop_time.stop()
    source.send(*frames)
    assert await station.receive() == b"".join(frames)


async def test_packing_with_a_wait_joins_later_frames(rig: Any, loop_time: LoopTime) -> None:
    station = rig.station()
    hub = await rig.open(f"udp:127.0.0.1:{station.port}?pack=1100&wait=20")
    loop_time.stop()
    frames = [rig.vehicle.attitude() for _ in range(3)]
    for frame in frames:
        rig.publish(hub, frame)
        loop_time.ahead_s += 0.006
        await asyncio.sleep(0)
        assert station.is_empty()
    loop_time.ahead_s += 0.003
    assert await station.receive() == b"".join(frames)


async def test_client_removed_before_its_flush_causes_no_error(
    rig: Any, loop_errors: list[Any]
) -> None:
    station = rig.station()
    hub = await rig.open(f"udp:127.0.0.1:{station.port}?pack=1100")
    rig.publish(hub, rig.vehicle.attitude())
    hub.remove(f"udp:127.0.0.1:{station.port}")
    await rig.quiet()
    assert loop_errors == []


async def test_full_socket_buffer_drops_the_oldest_frames(rig: Any) -> None:
    hub, pair = rig.hub(), socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    for sock in pair:
        sock.setblocking(False)
        rig.closing.append(sock.close)
    link = UdpClient(hub, hub.new_client_id(), parse_endpoint("udp:127.0.0.1:1"))
    link.adopt(pair[0])
    hub.appear(link)
    frames = list[bytes]()
    while hub.clients()[0].dropped < 44:
        frames.append(rig.vehicle.attitude())
        rig.publish(hub, frames[-1])
    (client,) = hub.clients()
    assert (client.queued, client.sent, client.dropped) == (256, len(frames) - 44, 44)
    passed = frames[:-300] + frames[-256:]
    assert [await receive(pair[1]) for _ in passed] == passed
    assert hub.clients()[0].queued == 0
    newest = rig.vehicle.attitude()
    rig.publish(hub, newest)
    assert await receive(pair[1]) == newest


async def test_ipv6_works_at_configured_and_listening_endpoints(rig: Any) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as station:
        station.setblocking(False)
        station.bind(("::1", 0))
        hub = await rig.open("udp-listen:[::1]:0", f"udp:[::1]:{station.getsockname()[1]}")
        frame = rig.vehicle.attitude()
        rig.publish(hub, frame)
        assert await receive(station) == frame
        station.sendto(rig.sender(255, 190).heartbeat(), ("::1", hub.listening_ports()[0]))
        await rig.until(lambda: len(hub.clients()) == 2)
    assert all(client.trusted for client in hub.clients())


@pytest.mark.parametrize("kind", ["udp-listen", "udp"])
@pytest.mark.parametrize("size", [10, 64, 300])
async def test_frames_that_a_bridge_cuts_over_datagrams_are_forwarded(
    rig: Any, kind: str, size: int
) -> None:
    bridge, station = rig.station(), rig.station()
    port = bridge.port if kind == "udp" else 0
    hub = await rig.open(f"{kind}:127.0.0.1:{port}", f"udp:127.0.0.1:{station.port}")
    if kind == "udp":
        await rig.check_passes(hub, bridge, station)
    else:
        bridge.target = ("127.0.0.1", hub.listening_ports()[0])
    sender = rig.sender(42)
    frames = [sender.attitude() if n % 4 else sender.raw_imu() for n in range(60)]
    data = b"".join(frames)
    for begin in range(0, len(data), size):
        bridge.send(data[begin : begin + size])
        await asyncio.sleep(0)
    assert [await station.receive() for _ in frames] == frames
    (client,) = (each for each in hub.clients() if each.received)
    assert (client.received, client.bytes_garbage) == (60, 0)


async def test_multicast_is_sent_and_received_without_own_frames(rig: Any) -> None:
    listener = member(rig)
    port = listener.getsockname()[1]
    hub = await rig.open(f"udp-multicast:{GROUP}:{port}")
    frame = rig.vehicle.attitude()
    rig.publish(hub, frame)
    async with asyncio.timeout(START_LIMIT_S):
        data, sender = await asyncio.get_running_loop().sock_recvfrom(listener, 4096)
    assert data == frame
    answer, sent = rig.sender(255, 190), []
    for target in ((GROUP, port), sender):
        sent.append(answer.heartbeat())
        listener.sendto(sent[-1], target)
    await rig.until(lambda: len(rig.incoming) == 2)
    assert [incoming.frame for incoming in rig.incoming] == sent
    (client,) = hub.clients()
    assert (client.received, client.trusted) == (2, False)
