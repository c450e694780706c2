"""Clients of a UDP port that have not proven that they receive: their source may be forged."""

from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.hub.round_trip import PROBE_COMPONENT
from gateway.hub.transports.datagram import UNPROVEN, UNPROVEN_FACTOR
from tests.kit.hub import FlyingHub, Rig, Station

pytestmark = pytest.mark.io

SYSTEM = 7


@pytest.fixture
def proven() -> None:
    """Let clients prove that they receive."""


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


def answer_of_ping(port: Port) -> bytes:
    """Answer the PING that has been received last."""
    reader = mavlink.MAVLink(None)
    asked = next(
        message
        for frame in reversed(port.frames)
        if (message := reader.decode(bytearray(frame))).get_type() == "PING"
    )
    answer = mavlink.MAVLink_ping_message(asked.time_usec, asked.seq, SYSTEM, PROBE_COMPONENT)
    return port.station.sender.pack(answer)


def guessed_answer(port: Port) -> bytes:
    guess_ns = (port.rig.clock.now_us + 1) * 1000
    return port.station.sender.pack(mavlink.MAVLink_timesync_message(1, guess_ns))


@pytest.mark.parametrize("options", ["", "?trusted=no", "?trusted=yes", "?pack=1100"])
@pytest.mark.parametrize(
    "datagrams",
    [
        pytest.param([lambda port: port.station.sender.heartbeat()], id="one heartbeat"),
        pytest.param([request_of], id="one request"),
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


async def test_station_that_asks_at_the_first_heartbeat_misses_nothing_of_it(rig: Rig) -> None:
    port = Port(rig)
    await port.fly(1)
    await port.send(port.station.sender.heartbeat())
    await port.fly(0.1)
    assert port.frames[0][7] == 0, "the vehicle's heartbeat is the first frame"
    await port.send(request_of(port))
    await port.fly(0.1)
    assert port.state() == "open"
    kinds = {int.from_bytes(frame[7:10], "little") for frame in port.frames}
    assert mavlink.MAVLINK_MSG_ID_COMMAND_ACK in kinds


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
