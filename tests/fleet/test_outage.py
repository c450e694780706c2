"""A fleet whose router dies and comes back, as its ground station sees it."""

import msgspec
import pytest

from gateway.fleet.settings import FleetSettings
from tests.fleet.conftest import World
from tests.kit.zenoh_router import Router, router

__all__ = ["router"]

pytestmark = pytest.mark.io


@pytest.fixture
def settings(settings: FleetSettings, router: Router) -> FleetSettings:
    """Both ends at one router."""
    return msgspec.structs.replace(settings, listen=router.locator, router=router.locator)


async def test_router_outage_loses_old_frames_and_recovers(world: World, router: Router) -> None:
    # By TCP, which has no timeout: the clock of the test is faster than the reconnection.
    site = world.open_site("field-a", extra="tcp-listen:127.0.0.1:0")
    await world.rig.connect(site.listening_ports()[0])
    await world.until(lambda: bool(world.systems()))
    router.kill()
    await world.until(lambda: not world.fleet.status()["is_linked"])
    await world.until(lambda: site.clients()[0].state == "connecting")
    # What was on its way when the link broke comes before anything else does.
    await world.until(lambda: site.clients()[0].dropped > 20)
    before = len(world.got)
    for _ in range(50):
        world.station.send(world.station.sender.command(1, 1))
    await world.until(lambda: site.clients()[0].dropped > 150)
    texts = [m.text for m in world.got[before:] if m.get_type() == "STATUSTEXT"]
    assert {m.get_type() for m in world.got[before:]} <= {"STATUSTEXT"}, "nothing of the vehicle"
    assert len(texts) <= 1
    assert (site.clients()[0].queued, world.fleet.status()["clients"][0].queued) == (0, 0)
    router.start()
    del world.got[:]
    await world.until(lambda: bool(world.systems()))
    assert not world.commands("field-a"), "what is old is not delivered as new"
    world.station.send(world.station.sender.command(1, 1))
    await world.until(lambda: bool(world.commands("field-a")))
    assert len(world.commands("field-a")) == 1
    assert [each["id"] for each in world.fleet.status()["sites"][0]["vehicles"]] == [1]
    assert site.clients()[1].dropped == 0, "a local client has noticed nothing"
