"""Untrusted clients get telemetry and answers, and change nothing that other clients see."""

from typing import Any

import msgspec
import pytest

from gateway.hub.limits import UNTRUSTED_BURST
from tests.ports import free_port

pytestmark = pytest.mark.io


@pytest.fixture
async def world(rig: Any) -> Any:
    """A hub with a trusted autopilot, a trusted station and an untrusted client."""
    autopilots = f"udp-listen:127.0.0.1:{free_port()}?trusted=yes"
    hub = rig.hub("udp-listen:127.0.0.1:0", "udp-listen:127.0.0.2:0?trusted=no", autopilots)
    rig.world = hub
    rig.publish(hub, rig.vehicle.heartbeat())
    rig.untrusted = rig.station(origin=(200, 190))
    rig.untrusted.target = ("127.0.0.2", hub.listening_ports()[1])
    await send_untrusted(rig, rig.untrusted.sender.heartbeat())
    rig.station_ = await rig.call(hub)
    rig.autopilot = await rig.call(hub, 2, origin=(42, 1))
    for client in (rig.untrusted, rig.station_):
        assert (await client.receive())[5] == 42
    return rig


async def send_untrusted(world: Any, *frames: bytes) -> None:
    """Send frames as the untrusted client, and wait until they are received."""
    hub = world.world

    def received() -> int:
        return sum(client.received for client in hub.clients())

    before = received()
    world.untrusted.send(*frames)
    await world.until(lambda: received() == before + len(frames))


async def test_forged_stations_displace_no_other_client(world: Any) -> None:
    for number in range(357):
        forged = world.sender(1 + number % 200, 1 + number // 200)
        forged.is_station = True
        await send_untrusted(world, forged.heartbeat())
        world.clock.now_us += 10_000
    late = world.station(world.world.listening_ports()[0], origin=(253, 190))
    heartbeat = late.sender.heartbeat()
    late.send(heartbeat)
    assert await world.autopilot.receive() == heartbeat
    assert world.station_.is_empty(), "what a station says to all goes to vehicles only"


async def test_systems_shown_for_an_untrusted_client_are_bounded(world: Any) -> None:
    for number in range(100):
        await send_untrusted(world, world.sender(100 + number, 1).attitude())
    untrusted = next(c for c in world.world.clients() if not c.trusted)
    assert 1 <= len(untrusted.systems) <= 8


async def test_client_no_longer_trusted_loses_its_routes(world: Any) -> None:
    hub = world.world
    request = world.station_.sender.command(42, 1)
    world.station_.send(request)
    assert await world.autopilot.receive() == request
    *others, autopilots = hub.settings.endpoints
    changed = (*others, autopilots.replace("=yes", "=no"))
    hub.apply(msgspec.structs.replace(hub.settings, endpoints=changed))
    count = hub.counters().unroutable
    world.station_.send(world.station_.sender.command(42, 1))
    await world.until(lambda: hub.counters().unroutable == count + 1)
    assert world.autopilot.is_empty()


class TestRequests:
    async def test_untrusted_clients_share_one_quota_of_answers(self, world: Any) -> None:
        before = len(world.incoming)
        hub = world.world
        answer = world.out(world.vehicle.attitude(), hub.clients()[0].client_id)
        for _ in range(UNTRUSTED_BURST // len(answer.frame)):
            hub.send(answer)
        await send_untrusted(world, *(world.untrusted.sender.command(1, 1) for _ in range(100)))
        await world.quiet()
        assert len(world.incoming) == before
        assert hub.counters().unserved == 100 - 64
        request = world.station_.sender.command(1, 1)
        world.station_.send(request)
        await world.until(lambda: world.incoming[-1].frame == request)

    async def test_telemetry_passes_between_two_answers(self, world: Any) -> None:
        """A flood of requests is served one by one, so nothing waits for more than one of them."""
        before = len(world.incoming)
        world.station_.send(*(world.station_.sender.command(1, 1) for _ in range(50)))
        world.autopilot.send(world.autopilot.sender.attitude())
        await world.until(lambda: not world.station_.is_empty())
        assert len(world.incoming) - before <= 5
