"""A fleet that is a router, sites behind it with real sessions, and one ground station."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import all as mavlink

from gateway.fleet.server import FleetServer
from gateway.fleet.settings import FleetSettings, SiteSettings
from gateway.hub.settings import HubSettings
from gateway.hub.transports.zenoh.session import open_session, session_config, site_key
from gateway.live.control_socket import request
from tests.kit.cli import invoke
from tests.kit.hub import Rig, Station, rig
from tests.kit.mavlink import Sender
from tests.kit.process import START_LIMIT_S
from tests.ports import free_port

__all__ = ["rig"]


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

    def open_site(self, name: str, options: str = "", **settings: Any) -> Any:
        return self.add_site(name, f"zenoh:{self.locator}?site={name}{options}", **settings)

    async def open(self, *names: str) -> None:
        """Open sites, and wait until the station has received the aircraft of each."""
        for name in names:
            self.open_site(name)
        await self.until(lambda: len(self.systems()) == len(names))

    def add_site(
        self,
        name: str,
        url: str,
        *,
        system: int = 1,
        extra: str = "",
        recordings: Path | None = None,
    ) -> Any:
        rig = Rig()
        rig.clock, rig.vehicle = self.rig.clock, rig.sender(system)
        hub = rig.hub(url, *filter(None, [extra]), recordings=recordings)
        self.rig.closing += rig.closing
        self.sites[name], self.received[name], self.vehicles[name] = hub, rig.incoming, rig.vehicle
        return hub

    def exchange(self) -> None:
        """Send frames of every vehicle and the station, and read those that the station gets."""
        for name, hub in self.sites.items():
            self.rig.tick(hub)
            vehicle = self.vehicles[name]
            self.rig.publish(hub, vehicle.heartbeat(), vehicle.attitude())
        self.station.send(self.station.sender.heartbeat())
        reader = mavlink.MAVLink(None)
        for data in self.station.received():
            self.got += reader.parse_buffer(data) or []

    async def until(self, condition: Callable[[], object]) -> None:
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

    def shown(self) -> dict[str, dict[str, Any]]:
        """Return the sites in the fleet's status, by name."""
        return {site["name"]: site for site in self.fleet.status()["sites"]}

    def ids(self) -> dict[tuple[str, int], int]:
        """Return the ids of vehicles that have one, by site and system."""
        return {
            (name, vehicle["system_id"]): vehicle["id"]
            for name, site in self.shown().items()
            for vehicle in site["vehicles"]
            if vehicle["id"] is not None
        }

    async def ask(self, verb: str, **params: object) -> Any:
        """Ask the fleet by its control socket, in a thread, since it answers here."""
        path = self.fleet.control_socket
        return await asyncio.to_thread(request, path, verb, params, timeout_s=START_LIMIT_S)


async def run(*words: str) -> str:
    """Run a command as a person does, in a thread, since the fleet answers it here."""
    result = await asyncio.to_thread(invoke, *words)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def ids() -> dict[str, int]:
    """Return the ids in the fleet's file when it starts."""
    return {}


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ids: dict[str, int]) -> FleetSettings:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    file = tmp_path / "fleet.json"
    if ids:
        file.write_text(json.dumps(ids))
    return FleetSettings(
        listen=f"tcp/127.0.0.1:{free_port()}",
        sites=("field-*",),
        ids_file=str(file),
        site=(SiteSettings(name="field-s", passphrase="secret"),),
    )


@asynccontextmanager
async def opened_world(
    rig: Rig, settings: FleetSettings, hub: HubSettings, locator: str = ""
) -> AsyncIterator[World]:
    """Run a fleet with one ground station; sites reach it at its router, or at another address."""
    station = rig.station(free_port())
    listener = "udp-listen:{}:{}".format(*station.target or ())
    fleet = FleetServer(settings, replace(hub, endpoints=(*hub.endpoints, listener)))
    await fleet.start()
    async with asyncio.timeout(START_LIMIT_S):
        while not fleet.status()["is_linked"]:
            await asyncio.sleep(0.01)
    yield World(rig, fleet, locator or settings.listen, station)
    fleet.close()
    rig.close()


@pytest.fixture
def hub_settings() -> HubSettings:
    """Return those of the fleet's hub, without the endpoint of the ground station."""
    return HubSettings(endpoints=())


@pytest.fixture
async def world(
    rig: Rig, settings: FleetSettings, hub_settings: HubSettings
) -> AsyncIterator[World]:
    async with opened_world(rig, settings, hub_settings) as world:
        yield world


@pytest.fixture
def forger(world: World) -> Iterator[Any]:
    """Open a session at the fleet's router that is no gateway's."""
    session = open_session(session_config(world.locator, ""))
    yield session
    session.close()


def announce(session: Any, site: str, token: object = None) -> Any:
    """Announce a session of a site, by default the announcing one."""
    return session.liveliness().declare_token(site_key(site, "site", token or session.zid()))
