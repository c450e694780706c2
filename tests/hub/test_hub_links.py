"""Gateways joined twice, stations that share an id: every frame arrives once, in order."""

import asyncio
import itertools
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.wire.mavlink_splitter import message_id_of
from tests.kit.hub import FlyingHub
from tests.ports import free_ports

pytestmark = pytest.mark.io

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
