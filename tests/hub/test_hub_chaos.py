"""Anything in any order: no error, no leak, and who stays to the end hears the end."""

import asyncio
import random
import socket
from typing import Any

import msgspec
import pytest

from gateway.records import ClientInterval
from tests.ports import free_ports

pytestmark = pytest.mark.io


class Chaos:
    """One seeded run."""

    def __init__(self, rig: Any, seed: int) -> None:
        self.rig = rig
        self.rng = random.Random(seed)
        self.hub = rig.hub("udp-listen:127.0.0.1:0", "tcp-listen:127.0.0.1:0", max_clients=4)
        self.udp_port, self.tcp_port = self.hub.listening_ports()
        self.nobody = free_ports(10)
        self.callers: list[Any] = []
        self.tcp: list[socket.socket] = []
        self.autopilot = rig.sender(42, 1)

    async def step(self) -> None:
        await self.rng.choice(
            (self.publish, self.publish, self.forward, self.call, self.say, self.hang_up,
             self.connect, self.break_off, self.add, self.remove, self.reload, self.request,
             self.jump)
        )()  # fmt: skip
        await asyncio.sleep(0)

    async def publish(self) -> None:
        clients = self.hub.clients()
        asker = self.rng.choice(clients).client_id if clients and self.rng.random() < 0.3 else None
        vehicle = self.rig.vehicle
        make = self.rng.choice((vehicle.heartbeat, vehicle.attitude, vehicle.raw_imu, vehicle.home))
        for _ in range(self.rng.randrange(1, 20)):
            self.hub.send(self.rig.out(make(), asker))

    async def forward(self) -> None:
        if self.callers:
            source = self.rng.choice(self.callers)
            for _ in range(self.rng.randrange(1, 10)):
                source.say(self.autopilot.attitude())

    async def call(self) -> None:
        caller = self.rig.station(self.udp_port)
        caller.say(caller.sender.heartbeat())
        self.callers.append(caller)

    async def say(self) -> None:
        if self.callers:
            speaker = self.rng.choice(self.callers)
            target = self.rng.choice((0, 1, 42, 99, 255))
            speaker.say(self.rng.choice((speaker.sender, self.autopilot)).command(target, 1))
            speaker.say(self.rng.randbytes(self.rng.randrange(0, 2000)))

    async def hang_up(self) -> None:
        if self.callers:
            self.callers.pop(self.rng.randrange(len(self.callers))).socket.close()

    async def connect(self) -> None:
        client = socket.create_connection(("127.0.0.1", self.tcp_port))
        self.rig.closing.append(client.close)
        client.send(self.autopilot.heartbeat()[: self.rng.randrange(1, 30)])
        self.tcp.append(client)

    async def break_off(self) -> None:
        if self.tcp:
            client = self.tcp.pop(self.rng.randrange(len(self.tcp)))
            if self.rng.random() < 0.5:
                # With data unread, close sends a reset.
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            client.close()

    async def add(self) -> None:
        port = self.rng.choice(self.nobody)
        kind = self.rng.choice(("udp", "tcp"))
        options = self.rng.choice(("", "?deny=ATTITUDE", "?rate=RAW_IMU:5", "?pack=200"))
        place = f"{kind}:127.0.0.1:{port}"
        if not any(url.startswith(place) for url in self.hub.endpoints()):
            self.hub.add(place + options)

    async def remove(self) -> None:
        extra = self.hub.endpoints()[2:]
        if extra:
            self.hub.remove(self.rng.choice(extra))

    async def reload(self) -> None:
        options = self.rng.choice(("", "?deny=RAW_IMU", "?trusted=no"))
        endpoints = (f"udp-listen:127.0.0.1:0{options}", "tcp-listen:127.0.0.1:0")
        self.hub.apply(msgspec.structs.replace(self.hub.settings, endpoints=endpoints))

    async def request(self) -> None:
        client_id = self.rng.randrange(1, 20)
        interval_us = self.rng.choice((-1, 0, 100_000))
        self.hub.set_interval(ClientInterval(client_id, 1, 30, interval_us))

    async def jump(self) -> None:
        self.rig.clock.us += self.rng.randrange(0, 8_000_000)
        self.hub._timer.cancel()
        self.hub._tick()


@pytest.mark.parametrize("seed", range(6))
async def test_chaos(rig: Any, seed: int) -> None:
    errors: list[Any] = []
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: errors.append(context))
    chaos = Chaos(rig, seed)
    for _ in range(400):
        await chaos.step()
    for caller in chaos.callers:
        caller.socket.close()
    for client in chaos.tcp:
        client.close()
    for endpoint in chaos.hub.endpoints()[2:]:
        chaos.hub.remove(endpoint)
    await chaos.reload()

    def all_gone() -> bool:
        rig.clock.us += 60_000_000
        chaos.hub._timer.cancel()
        chaos.hub._tick()
        return not chaos.hub.clients()

    await rig.until(all_gone)
    last = rig.station(chaos.udp_port)
    last.say(last.sender.heartbeat())
    remote = f"127.0.0.1:{last.port}"
    await rig.until(lambda: remote in {client.remote for client in chaos.hub.clients()})
    frame = rig.vehicle.attitude()
    chaos.hub.send(rig.out(frame))
    while await last.receive() != frame:
        pass
    assert errors == []
    assert not chaos.hub._fanout._subscriptions.keys() - chaos.hub._clients.keys()
    assert set(chaos.hub._router._table._of_client) <= set(chaos.hub._clients)
