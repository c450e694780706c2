"""A fleet that is a router, sites behind it with real sessions, and one ground station."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.fleet.server import FleetServer
from gateway.fleet.settings import FleetSettings, SiteSettings
from gateway.hub.settings import HubSettings
from tests.kit.cli import invoke
from tests.kit.hub import Rig, Station, proven, rig
from tests.kit.mavlink import Sender
from tests.kit.process import START_LIMIT_S
from tests.ports import free_port

__all__ = ["proven", "rig"]


class World:
    """A fleet that is a router, sites of one aircraft 1 each, and one ground station."""

    def __init__(self, rig: Rig, fleet: FleetServer, locator: str, station: Station) -> None:
        self.rig = rig
        self.fleet = fleet
        self.locator = locator
        self.station = station
        self.sites: dict[str, Any] = {}
        self.received: dict[str, list[Any]] = {}
        self.vehicles: dict[str, Sender] = {}
        self.got: list[Any] = []

    def open_site(
        self, name: str, options: str = "", recordings: Path | None = None, extra: str = ""
    ) -> Any:
        url = f"zenoh:{self.locator}?site={name}{options}"
        return self.add_site(name, url, extra=extra, recordings=recordings)

    def add_site(
        self,
        name: str,
        url: str,
        *,
        system: int = 1,
        extra: str = "",
        recordings: Path | None = None,
    ) -> Any:
        incoming: list[Any] = []
        rig = Rig()
        rig.clock = self.rig.clock
        rig.incoming = incoming
        rig.vehicle = rig.sender(system)
        hub = rig.hub(url, *filter(None, [extra]), recordings=recordings)
        self.rig.closing += rig.closing
        self.sites[name], self.received[name], self.vehicles[name] = hub, incoming, rig.vehicle
        return hub

    def exchange(self) -> None:
        """Send frames of every vehicle and the station, and read those that the station gets."""
        for name, hub in self.sites.items():
            if hub._timer is not None:
                self.rig.tick(hub)
                hub.send(self.rig.out(self.vehicles[name].heartbeat()))
                hub.send(self.rig.out(self.vehicles[name].attitude()))
        self.station.send(self.station.sender.heartbeat())
        reader = mavlink.MAVLink(None)
        while True:
            try:
                data = self.station.socket.recv(65536)
            except BlockingIOError:
                return
            self.got += reader.parse_buffer(data) or []

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(START_LIMIT_S):
            while not condition():
                self.rig.clock.now_us += 100_000
                self.exchange()
                await asyncio.sleep(0.01)

    def systems(self) -> set[int]:
        return {m.get_srcSystem() for m in self.got if m.get_type() == "ATTITUDE"}

    def commands(self, name: str) -> list[Any]:
        link = mavlink.MAVLink(None)
        found = [link.decode(bytearray(each.frame)) for each in self.received[name]]
        return [message for message in found if message.get_type() == "COMMAND_LONG"]


async def run(*words: str) -> str:
    """Run a command as a person does, in a thread, since the fleet answers it here."""
    result = await asyncio.to_thread(invoke, *words)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FleetSettings:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    return FleetSettings(
        listen=f"tcp/127.0.0.1:{free_port()}",
        sites=("field-*",),
        ids_file=str(tmp_path / "fleet.json"),
        site=(SiteSettings(name="field-s", passphrase="secret"),),
    )


@asynccontextmanager
async def opened_world(
    rig: Rig, settings: FleetSettings, hub: HubSettings | None = None, locator: str = ""
) -> AsyncIterator[World]:
    """Run a fleet with one ground station; sites reach it at its router, or at another address."""
    hub = msgspec.structs.replace(hub or HubSettings(), endpoints=("udp-listen:127.0.0.1:0",))
    fleet = FleetServer(settings, hub)
    await fleet.start()
    station = rig.station(fleet._hub.listening_ports()[0])
    async with asyncio.timeout(START_LIMIT_S):
        while not fleet._session.is_open:
            await asyncio.sleep(0.01)
    yield World(rig, fleet, locator or settings.listen, station)
    fleet.close()
    rig.close()


@pytest.fixture
async def world(rig: Rig, settings: FleetSettings) -> AsyncIterator[World]:
    async with opened_world(rig, settings) as world:
        yield world
