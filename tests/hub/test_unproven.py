"""Clients of a UDP port that have not proven that they receive: their source may be forged."""

from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.hub.round_trip import PROBE_COMPONENT
from gateway.hub.transports import udp_listen
from gateway.hub.transports.datagram import UNPROVEN, UNPROVEN_FACTOR
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.mavlink_splitter import MavFrame, frame_of, message_id_of
from tests.kit.hub import FlyingHub, Rig, Station
from tests.ports import free_port

pytestmark = pytest.mark.io

SYSTEM = 7


@pytest.fixture(autouse=True)
def other_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the clients of UDP ports be on other machines."""
    monkeypatch.setattr(udp_listen, "is_of_this_machine", lambda *_: False)


class Port:
    """A flying gateway with one listening port, and a station that counts both directions."""

    def __init__(self, rig: Rig, options: str = "") -> None:
        self.rig = rig
        self.gateway = FlyingHub(rig, SYSTEM, f"udp-listen:127.0.0.1:0{options}")
        self.station: Station = rig.station(self.gateway.hub.listening_ports()[0])
        self.sent = 0
        self.frames: list[bytes] = []

    @property
    def received(self) -> int:
        return sum(map(len, self.frames))

    async def send(self, data: bytes) -> None:
        self.sent += len(data)
        self.station.send(data)
        await self.rig.quiet()

    async def fly(self, seconds: float) -> None:
        """Let time pass, in steps of the vehicle's samples."""
        for _ in range(round(seconds * 20)):
            self.rig.clock.now_us += 50_000
            self.gateway.fly()
            self.rig.tick(self.gateway.hub)
            await self.rig.quiet_some()
            self.frames += self.station.received()

    def state(self) -> str:
        return str(self.gateway.hub.clients()[0].state)


def request_of(port: Port) -> bytes:
    return port.station.sender.command(SYSTEM, 1)


def answer_to(station: Station, ping: bytes) -> bytes:
    """Answer a PING as MAVSDK does."""
    asked = mavlink.MAVLink(None).decode(bytearray(ping))
    target = asked.get_srcSystem(), asked.get_srcComponent()
    return station.sender.pack(mavlink.MAVLink_ping_message(asked.time_usec, asked.seq, *target))


def answer_of_ping(port: Port) -> bytes:
    """Answer the PING that has been received last."""
    pings = [each for each in port.frames if message_id_of(each) == MESSAGE_IDS["PING"]]
    return answer_to(port.station, pings[-1])


def guessed_answer(port: Port) -> bytes:
    guess_ns = (port.rig.clock.now_us + 1) * 1000
    return port.station.sender.pack(mavlink.MAVLink_timesync_message(1, guess_ns))


@pytest.mark.parametrize("options", ["", "?trusted=no", "?trusted=yes", "?pack=1100"])
@pytest.mark.parametrize(
    "datagrams",
    [
        pytest.param([lambda port: port.station.sender.heartbeat()], id="one heartbeat"),
        pytest.param([lambda port: port.station.sender.heartbeat()] * 20, id="heartbeats"),
        pytest.param([guessed_answer] * 3, id="guessed answers"),
    ],
)
async def test_silent_address_gets_ten_times_its_bytes_and_five_seconds(
    rig: Rig, options: str, datagrams: list[Callable[[Port], bytes]]
) -> None:
    port = Port(rig, options)
    await port.fly(1)
    for make in datagrams:
        await port.send(make(port))
        await port.fly(1)
    await port.fly(5)
    assert 0 < port.received <= UNPROVEN_FACTOR * port.sent
    before = port.received
    await port.fly(20)
    assert port.received == before
    assert not port.gateway.hub.clients()


@pytest.mark.parametrize("options", ["", "?trusted=no", "?pack=1100"])
@pytest.mark.parametrize("make_proof", [request_of, answer_of_ping])
async def test_frame_that_depends_on_what_was_sent_opens_the_telemetry(
    rig: Rig, options: str, make_proof: Callable[[Port], bytes]
) -> None:
    port = Port(rig, options)
    await port.fly(1)
    for _ in range(6):
        await port.send(port.station.sender.heartbeat())
        await port.fly(1)
    assert port.state() == UNPROVEN
    await port.send(make_proof(port))
    assert port.state() == "open"
    before = port.received
    await port.fly(4)
    assert port.received - before > 20 * port.sent


@pytest.mark.parametrize("is_one_datagram", [True, False])
async def test_request_right_after_the_first_heartbeat_opens_the_telemetry(
    rig: Rig, is_one_datagram: bool
) -> None:
    port = Port(rig)
    await port.fly(1)
    frames = [port.station.sender.heartbeat(), request_of(port)]
    port.station.send(*([b"".join(frames)] if is_one_datagram else frames))
    await rig.quiet()
    assert port.state() == "open"
    await port.fly(4)
    assert port.frames[0][7] == 0, "the vehicle's heartbeat is the first frame"
    kinds = [int.from_bytes(frame[7:10], "little") for frame in port.frames]
    assert mavlink.MAVLINK_MSG_ID_COMMAND_ACK in kinds
    assert len(kinds) > 100


class Router:
    """A gateway without vehicles of its own, five vehicles behind one port, and a station."""

    def __init__(self, rig: Rig, options: str = "") -> None:
        ports = ("udp-listen:127.0.0.1:0", f"udp-listen:127.0.0.1:{free_port()}{options}")
        self.rig, self.hub = rig, rig.hub(*ports, ping_interval_s=0.0)
        self.link, self.station = map(rig.station, self.hub.listening_ports())
        self.vehicles = [rig.sender(system) for system in range(11, 16)]
        self.frames: list[MavFrame] = []

    async def run(self, seconds: float) -> None:
        """Let time pass: every vehicle sends at 10 Hz, and the station its heartbeats."""
        for step in range(round(seconds * 10)):
            if step % 10 == 0:
                self.link.send(*(each.heartbeat() for each in self.vehicles))
                self.station.send(self.station.sender.heartbeat())
            self.link.send(*(each.attitude() for each in self.vehicles))
            await self.rig.quiet()
            self.rig.tick(self.hub, 0.1)
            self.frames += map(frame_of, self.station.received())


async def test_station_of_a_router_is_pinged_each_second_until_it_answers(rig: Rig) -> None:
    router = Router(rig)
    await router.run(4)
    pings = [frame for frame in router.frames if frame.message_id == MESSAGE_IDS["PING"]]
    assert len(pings) in (3, 4)
    assert {frame.origin for frame in pings} == {(11, PROBE_COMPONENT)}
    assert router.hub.clients()[1].state == UNPROVEN
    router.station.send(answer_to(router.station, pings[-1].data))
    await router.run(2)
    assert [each.state for each in router.hub.clients()][1:] == ["open"]
    router.frames.clear()
    await router.run(4)
    assert len(router.frames) == 4 * 5 * 11
    systems = {system for each in router.hub.clients() for system, _ in each.systems}
    assert systems == {11, 12, 13, 14, 15, 255}


@pytest.mark.parametrize("options", ["", "?trusted=no"])
async def test_request_to_a_routed_vehicle_opens_the_telemetry(rig: Rig, options: str) -> None:
    router = Router(rig, options)
    await router.run(2)
    router.station.send(router.station.sender.command(99, 1))
    await router.run(1)
    assert router.hub.clients()[1].state == UNPROVEN
    router.station.send(router.station.sender.command(12, 1))
    await router.run(1)
    assert router.hub.clients()[1].state == "open"


async def test_station_on_this_machine_gets_all_frames_of_a_router_at_once(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    router = Router(rig)
    await router.run(1)
    before = len(router.frames)
    await router.run(2)
    assert len(router.frames) - before == 2 * 5 * 11


async def test_heartbeats_reach_a_client_that_only_sends_heartbeats(rig: Rig) -> None:
    port = Port(rig)
    await port.fly(1)
    for _ in range(10):
        await port.send(port.station.sender.heartbeat())
        await port.fly(1)
    heartbeats = sum(frame[7:10] == bytes(3) for frame in port.frames)
    assert heartbeats >= 10


async def test_program_with_a_hub_and_no_vehicle_proves_itself_by_its_answer(rig: Rig) -> None:
    port = Port(rig)
    panel = rig.hub(f"udp:127.0.0.1:{port.gateway.hub.listening_ports()[0]}")
    await rig.until_open(panel)
    await port.fly(1)
    rig.publish(panel, rig.sender(255, 190).heartbeat())
    await rig.quiet()
    await port.fly(0.2)
    assert port.state() == "open"
