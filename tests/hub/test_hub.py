"""The hub between many endpoints: routing, loops, changes, round trips, redundant links, faults."""

import asyncio
import errno
import itertools
import logging
import socket
from collections import defaultdict
from typing import Any

import msgspec
import pytest
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v10 import common as v1
from pymavlink.dialects.v20 import common as dialect

from gateway.hub.hub import CONNECTIONS_IN_FULL
from gateway.hub.round_trip import PROBE_COMPONENT
from gateway.hub.stats import WINDOW_US
from gateway.hub.transports import sockets
from gateway.wire.mavlink_messages import CRC_EXTRA, MESSAGE_IDS
from gateway.wire.mavlink_splitter import frame_of, message_id_of
from tests.kit.hub import FlyingHub, no_descriptors
from tests.kit.mavlink import STATION, packed
from tests.ports import free_ports

pytestmark = pytest.mark.io


@pytest.fixture
async def world(rig: Any) -> Any:
    """One listening port; an autopilot, a station on each of two further clients."""
    rig.world = hub = rig.hub("udp-listen:127.0.0.1:0")
    rig.publish(hub, rig.vehicle.heartbeat())
    rig.first, rig.second = await rig.call(hub), await rig.call(hub, origin=(254, 190))
    rig.autopilot = await rig.call(hub, origin=(42, 1))
    for station in (rig.first, rig.second):
        assert (await station.receive())[5] == 42
    assert rig.autopilot.is_empty()
    return rig


async def test_text_of_a_router_is_sent_as_a_component_of_each_vehicle(world: Any) -> None:
    foreign = len(world.foreign)
    for number in range(2):
        assert world.world.announce([dialect.MAVLink_statustext_message(6, b"Note: here")])
        for station in (world.first, world.second):
            frame = frame_of(await station.receive())
            assert (frame.origin[0], frame.message_id, frame.sequence) == (42, 253, number)
            assert b"Note: here" in frame.data
    assert len(world.foreign) == foreign + 2


async def test_first_frame_of_a_restarted_program_is_accepted(world: Any) -> None:
    for _ in range(4):
        again = world.station(world.world.listening_ports()[0])
        request = again.sender.command(42, 1)
        again.send(request)
        assert await world.autopilot.receive() == request
        again.socket.close()
        world.clock.now_us += 100_000
    assert world.world.counters().duplicates == 0


async def test_allow_restricts_round_trip_requests_and_greetings_too(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0?allow=HEARTBEAT", ping_interval_s=1.0)
    rig.publish(hub, rig.vehicle.home(), rig.vehicle.heartbeat())
    station = await rig.call(hub)
    for _ in range(8):
        rig.clock.now_us += 500_000
        rig.publish(hub, rig.vehicle.heartbeat(), rig.vehicle.attitude())
        rig.tick(hub)
    await rig.quiet()
    got = station.received()
    assert [frame[7] for frame in got] == [0] * 9
    assert [frame[4] for frame in got] == list(range(got[0][4], got[0][4] + 9))


async def test_slow_second_link_does_not_move_an_aircraft_back(world: Any) -> None:
    """Frames that the first link has lost arrive three seconds late by the second one."""
    hub = world.world
    slow = world.station(hub.listening_ports()[0])
    pilot = world.autopilot.sender
    delayed = []
    newest = -1
    for number in range(400):
        world.clock.now_us += 20_000
        frame = pilot.attitude(time_ms=number)
        delayed.append(frame)
        if number % 10 != 5:
            world.autopilot.send(frame)
        if number >= 150:
            slow.send(delayed[number - 150])
        await world.quiet_some()
        for got in map(frame_of, world.first.received()):
            if got.message_id == 30:
                time_ms = int.from_bytes(got.payload[:4], "little")
                assert time_ms > newest
                newest = time_ms
    assert newest == 399
    counters = hub.counters()
    assert counters.late > 100, "all from before the slow link appeared, and the lost ones"
    assert counters.duplicates > 80


async def test_round_trip_is_measured_by_ping_and_by_timesync(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0", ping_interval_s=5.0)
    rig.publish(hub, rig.vehicle.heartbeat())
    station = await rig.call(hub)
    rig.clock.now_us = 5_000_000
    rig.publish(hub, rig.vehicle.heartbeat())
    assert [(await station.receive())[7] for _ in range(2)] == [0, 0]
    reader = dialect.MAVLink(None)
    ping, sync = [reader.parse_buffer(await station.receive())[0] for _ in range(2)]
    rig.clock.now_us += 1_500
    asker = (ping.get_srcSystem(), ping.get_srcComponent())
    answer = dialect.MAVLink_ping_message(ping.time_usec, ping.seq, *asker)
    station.send(station.sender.pack(answer))
    await rig.until(lambda: hub.clients()[0].round_trip_us == 1_500)
    rig.clock.now_us += 500
    station.send(station.sender.pack(dialect.MAVLink_timesync_message(77, sync.ts1)))
    await rig.until(lambda: hub.clients()[0].round_trip_us == 2_000)
    assert len(rig.incoming) == 1
    # mavros has the id of a UDP bridge in the system of its vehicle, and asks as well.
    mavros = rig.sender(1, dialect.MAV_COMP_ID_UDP_BRIDGE)
    station.send(mavros.pack(dialect.MAVLink_timesync_message(0, 1000)), mavros.command(1, 1))
    await rig.until(lambda: len(rig.incoming) == 3)


class TestChangesAtRunTime:
    async def test_added_endpoint_gets_frames_after_a_reload_too(self, rig: Any) -> None:
        hub, station = rig.hub(), rig.station()
        hub.add(f"udp:127.0.0.1:{station.port}?name=tablet")
        await rig.until_open(hub)
        await rig.check_passes(hub, station)
        with pytest.raises(ValueError, match="already exists"):
            hub.add(f"udp:127.0.0.1:{station.port}")
        hub.apply(hub.settings)
        await rig.check_passes(hub, station)
        hub.remove("tablet")
        rig.publish(hub, rig.vehicle.attitude())
        assert hub.clients() == ()
        assert station.is_empty()
        with pytest.raises(ValueError, match="tablet"):
            hub.remove("tablet")

    async def test_reload_keeps_the_clients_of_endpoints_that_remain(self, rig: Any) -> None:
        stays, goes, comes = (rig.station() for _ in range(3))
        urls = [f"udp:127.0.0.1:{each.port}" for each in (stays, goes, comes)]
        hub = rig.hub("udp-listen:127.0.0.1:0", *urls[:2])
        caller = rig.station(hub.listening_ports()[0])
        caller.send(caller.sender.heartbeat())
        await rig.until(lambda: len(hub.clients()) == 3)
        await rig.until_open(hub)
        before = {client.remote: client.client_id for client in hub.clients()}
        changed = (f"{urls[0]}?name=laptop&deny=ATTITUDE", urls[2])
        endpoints = ("udp-listen:127.0.0.1:0?deny=RAW_IMU", *changed)
        hub.apply(msgspec.structs.replace(hub.settings, endpoints=endpoints))
        await rig.until_open(hub)
        after = {client.remote: client.client_id for client in hub.clients()}
        kept = {remote: after.get(remote) for remote in before}
        assert kept == before | {f"127.0.0.1:{goes.port}": None}
        rig.publish(hub, rig.vehicle.raw_imu(), rig.vehicle.attitude(), rig.vehicle.heartbeat())
        for station, expected in ((stays, [27, 0]), (comes, [27, 30, 0]), (caller, [30, 0])):
            assert [(await station.receive())[7] for _ in expected] == expected
        assert goes.is_empty()
        assert "laptop" in {client.name for client in hub.clients()}


class TestListeningPorts:
    @pytest.mark.parametrize("kind", ["udp", "tcp"])
    async def test_clients_are_admitted_once_descriptors_are_free_again(
        self, rig: Any, kind: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sockets, "ACCEPT_AGAIN_S", 0.001)
        hub = rig.hub(f"{kind}-listen:127.0.0.1:0")
        (port,) = hub.listening_ports()
        caller = rig.station(port, socket.SOCK_DGRAM if kind == "udp" else socket.SOCK_STREAM)
        with no_descriptors():
            if kind == "tcp":
                caller.socket.connect_ex(caller.target)
            else:
                caller.send(caller.sender.heartbeat())
            await rig.until(lambda: hub.listeners()[0].reason == "Too many open files")
            rig.tick(hub)
            assert hub.listeners()[0].reason == "Too many open files", "no tick hides it"
            assert hub.clients() == ()
        rig.tick(hub, 2)
        if kind == "udp":
            caller.send(caller.sender.heartbeat())
        await rig.until(lambda: len(hub.clients()) == 1)
        assert hub.listeners()[0].state == "open"


async def test_round_trips_are_measured_at_each_interval(rig: Any) -> None:
    """Next to the reports, which have turns of their own."""
    hub = rig.hub("udp-listen:127.0.0.1:0", ping_interval_s=1.0)
    rig.publish(hub, rig.vehicle.heartbeat())
    station = await rig.call(hub)
    for _ in range(40):
        rig.tick(hub, 0.25)
        rig.publish(hub, rig.vehicle.heartbeat())
    await rig.quiet()
    ids = [message_id_of(frame) for frame in station.received()]
    assert 9 <= ids.count(MESSAGE_IDS["PING"]) == ids.count(MESSAGE_IDS["TIMESYNC"]) <= 10


async def test_frames_of_the_gateway_itself_have_no_gap_at_any_client(rig: Any) -> None:
    """Requests, answers to another gateway, and texts have one numbering at each client."""
    hub = rig.hub("udp-listen:127.0.0.1:0", ping_interval_s=1.0)
    vehicles = rig.station(hub.listening_ports()[0], origin=(1, 1))
    gateway = rig.station(hub.listening_ports()[0], origin=(3, PROBE_COMPONENT))
    stations = [vehicles, gateway, *(rig.station(hub.listening_ports()[0]) for _ in range(2))]
    second, numbers = rig.sender(2), defaultdict(list)
    for step in range(60):
        vehicles.send(vehicles.sender.attitude(), second.attitude())
        gateway.send(gateway.sender.pack(dialect.MAVLink_ping_message(step, step, 0, 0)))
        for station in stations[2 : 3 + step // 20]:
            station.send(station.sender.heartbeat())
        await rig.quiet_some()
        hub.announce([dialect.MAVLink_statustext_message(6, b"text")])
        rig.tick(hub, 0.5)
        await rig.quiet_some()
        for key, station in enumerate(stations):
            for frame in map(frame_of, station.received()):
                if frame.origin[1] == PROBE_COMPONENT:
                    numbers[key, frame.origin].append(frame.sequence)
    assert len(numbers) == 4 * 2 + 1, "texts of two systems to all, and answers to a gateway"
    for key, found in numbers.items():
        assert len(found) > 20, key
        assert found == [(found[0] + step) % 256 for step in range(len(found))], key


async def test_interface_outage_loses_no_frame_of_other_clients(
    rig: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = rig.station(), rig.station()
    hub = await rig.open(*(f"udp:127.0.0.1:{each.port}" for each in (near, far)))
    rig.publish(hub, sent := rig.vehicle.attitude())
    client = hub._clients[2]

    def unreachable(_: bytes) -> int:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    frames = [sent]
    with monkeypatch.context() as down:
        down.setattr(client, "write", unreachable)
        down.setattr(type(client), "_connect", lambda _: None)
        for _ in range(100):
            frames.append(rig.vehicle.attitude())
            rig.publish(hub, frames[-1])
        assert (hub.clients()[1].state, hub.clients()[1].dropped) == ("unreachable", 100)
    rig.tick(hub, 1)
    await rig.until_open(hub)
    rig.publish(hub, last := rig.vehicle.attitude())
    assert [await near.receive() for _ in (*frames, last)] == [*frames, last]
    assert [await far.receive() for _ in range(2)] == [sent, last]


@pytest.mark.parametrize("kind", ["udp", "tcp"])
async def test_invalid_name_is_reported_as_unresolved(
    rig: Any, kind: str, monkeypatch: pytest.MonkeyPatch, loop_errors: list[Any]
) -> None:
    async def choke(*_: object, **__: object) -> None:
        raise UnicodeError("label empty or too long")

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", choke)
    hub = rig.hub(f"{kind}:no-such-place.invalid:14550")
    await rig.until(lambda: hub.clients()[0].reason != "")
    assert (hub.clients()[0].state, loop_errors) == ("resolving", [])


async def test_truncated_heartbeats_are_accepted_without_error(
    rig: Any, loop_errors: list[Any]
) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0?trusted=no")
    caller = rig.station(hub.listening_ports()[0])
    for length in range(10):
        payload = bytes((0, 0, 0, 0, 6, 8, 0, 4, 3))[:length]
        body = bytes((len(payload), 0, 0, length, 255, 190, 0, 0, 0)) + payload
        crc = mcrf4xx(CRC_EXTRA[0], mcrf4xx(body))
        caller.send(b"\xfd" + body + crc.to_bytes(2, "little"))
    await rig.until(lambda: len(rig.incoming) == 10)
    assert loop_errors == []


async def test_unlimited_new_clients_do_not_flood_the_log(
    rig: Any, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="gateway")
    many = CONNECTIONS_IN_FULL + 10
    hub = rig.hub("udp-listen:127.0.0.1:0", max_clients=many, idle_timeout_s=3600)
    for _ in range(many):
        client = rig.station(hub.listening_ports()[0])
        client.send(client.sender.heartbeat())
    await rig.until(lambda: len(hub.clients()) == many)
    assert len(caplog.messages) == CONNECTIONS_IN_FULL
    hub.add("udp:127.0.0.1:9")
    assert caplog.messages[-1].endswith("127.0.0.1:9"), "a configured client is always named"
    rig.clock.now_us += WINDOW_US
    rig.tick(hub)
    assert "10 more connects and disconnects at listening ports" in caplog.messages


STEP_US = 20_000


class Joined:
    """Two gateways, each calling the other, and a station at the second."""

    def __init__(self, rig: Any) -> None:
        self.rig = rig
        ports = free_ports(2)
        self.first, self.second = (
            FlyingHub(
                rig,
                system,
                f"udp-listen:127.0.0.1:{here}",
                f"udp:127.0.0.1:{there}",
                ping_interval_s=1.0,
            )
            for system, here, there in ((1, *ports), (2, *reversed(ports)))
        )
        self.station = rig.station(ports[1])
        self.received: dict[int, list[bytes]] = {1: [], 2: []}

    async def run(self, seconds: float) -> None:
        for step in range(round(seconds * 1e6 / STEP_US)):
            self.rig.clock.now_us += STEP_US
            self.first.fly()
            self.second.fly()
            if step % 12 == 0:
                self.rig.tick(self.first.hub)
                self.rig.tick(self.second.hub)
            if step % 50 == 0:
                self.station.send(self.station.sender.heartbeat())
            for _ in range(8):
                await asyncio.sleep(0)
            self.listen()

    def listen(self) -> None:
        for frame in self.station.received():
            if frame[5] in self.received and frame[6] == 1:
                self.received[frame[5]].append(frame)

    def gaps(self, system: int) -> int:
        numbers = [frame[4] for frame in self.received[system]]
        return sum((b - a) % 256 != 1 for a, b in itertools.pairwise(numbers))


async def test_two_gateways_joined_twice_send_frames_and_answers_once_without_a_gap(
    rig: Any,
) -> None:
    joined = Joined(rig)
    await joined.run(4)
    joined.received = {1: [], 2: []}
    await joined.run(8)
    for _ in range(10):
        joined.station.send(joined.station.sender.command(1, 1))
        await joined.run(0.2)
    acks = [frame for frame in joined.received[1] if message_id_of(frame) == 77]
    assert len(acks) == 10
    for system in (1, 2):
        assert len(joined.received[system]) > 500
        assert joined.gaps(system) == 0


async def test_two_stations_with_one_id_are_both_answered(rig: Any) -> None:
    gateway = FlyingHub(rig, 1, "udp-listen:127.0.0.1:0")
    twins = [rig.station(gateway.hub.listening_ports()[0]) for _ in range(2)]
    gateway.fly()
    answers = [0, 0]
    for step in range(10):
        rig.clock.now_us += 100_000
        for twin in twins:
            if step % 10 == 0:
                twin.send(twin.sender.heartbeat())
            twin.send(twin.sender.command(1, 1))
        await rig.quiet()
        for number, twin in enumerate(twins):
            ids = [message_id_of(frame) for frame in twin.received()]
            answers[number] += ids.count(dialect.MAVLINK_MSG_ID_COMMAND_ACK)
    assert answers[0] >= 10
    assert answers[1] >= 10


V1, V2 = 0xFE, 0xFD
PROBE_US = 6_000_000


def heartbeat(sequence: int) -> bytes:
    message = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    return packed(message, 254, STATION, sequence=sequence, version=1)


async def next_attitude(rig: Any, hub: Any, station: Any) -> bytes:
    """Publish an attitude, and return the frame that the station receives."""
    rig.publish(hub, rig.vehicle.attitude())
    while True:
        frame = await station.receive()
        if (frame[5] if frame[0] == V1 else frame[7]) == dialect.MAVLINK_MSG_ID_ATTITUDE:
            return frame


async def test_endpoint_of_version_1_gets_only_messages_of_this_version(rig: Any) -> None:
    station = rig.station()
    hub = await rig.open(f"udp:127.0.0.1:{station.port}?mavlink=1")
    odometry = dialect.MAVLink_odometry_message(
        1, 1, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0] * 21, [0] * 21
    )
    rig.publish(hub, packed(odometry))
    first, second = [await next_attitude(rig, hub, station) for _ in range(2)]
    assert [first[0], second[0]] == [V1, V1]
    assert (second[2] - first[2]) % 256 == 1
    found = v1.MAVLink(None).decode(bytearray(first))
    assert (found.get_type(), found.get_srcSystem()) == ("ATTITUDE", 1)


@pytest.mark.parametrize(
    ("options", "versions"), [("", (V2, V1, V2, V2, V2)), ("?mavlink=2", (V2, V2, V2, V2, V2))]
)
async def test_client_that_only_sends_version_1_gets_it_after_a_probe(
    rig: Any, options: str, versions: tuple[int, ...]
) -> None:
    """Programs that know both versions answer version 2 by version 2 within the probe."""
    hub = rig.hub(f"udp-listen:127.0.0.1:0{options}")
    station = rig.station(hub.listening_ports()[0])
    frames = [heartbeat(0), heartbeat(1), station.sender.heartbeat(), heartbeat(2), heartbeat(3)]
    for count, (frame, version) in enumerate(zip(frames, versions, strict=True), start=1):
        station.send(frame)
        await rig.until(lambda n=count: rig.received == n)
        assert (await next_attitude(rig, hub, station))[0] == version
        rig.clock.now_us += PROBE_US
