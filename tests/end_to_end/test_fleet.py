"""Three fields that all fly an aircraft 1, seen, set and sent on a mission through one fleet.

The civil clocks of two of them are wrong by years; nothing of it may matter.
"""

import asyncio
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync

from tests.end_to_end.processes import Client, Gateway, MavProxy
from tests.end_to_end.test_ground_stations import WAYPOINTS, answered
from tests.kit.process import START_LIMIT_S, wait_for
from tests.ports import free_port, free_ports

pytestmark = [pytest.mark.io, pytest.mark.slow]

SITES = ("field-1", "field-2", "field-3")
DATAGRAMS = 50_000
YEAR_S = 31_556_952
OFF_S = {"field-2": 20 * YEAR_S, "field-3": -2 * YEAR_S}
"""No GPS reports a date before 2024."""
WRONG_CLOCK = Path(__file__).with_name("wrong_clock.c")
SITE = """
[hub]
endpoints = ["zenoh:{place}?site={site}&trusted=yes"]

[recording]
folder = "{folder}"

[simulator]
gps_first_fix_s = 0.5
"""


@dataclass
class Fleet:
    """Where its ground stations are, and its sites."""

    ports: list[int]
    sites: dict[str, Gateway]

    def ask(self, *words: str) -> str:
        """Ask by the command line."""
        words = (sys.executable, "-m", "gateway.cli", "fleet", *words)
        return subprocess.run(words, capture_output=True, check=True, text=True).stdout

    def ids(self) -> dict[str, int]:
        """Return which id each site's aircraft has here."""
        return {
            site["name"]: vehicle["id"]
            for site in json.loads(self.ask("status", "--json"))["sites"]
            for vehicle in site["vehicles"]
            if vehicle["system_id"] == 1
        }


@pytest.fixture(scope="module")
def wrong_clock(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """Something to preload that moves the civil clock of a process."""
    if not (compiler := shutil.which("cc")):
        return None
    library = tmp_path_factory.mktemp("clock") / "wrong_clock.so"
    words = [compiler, "-shared", "-fPIC", "-o", str(library), str(WRONG_CLOCK), "-ldl"]
    subprocess.run(words, check=True)
    return library


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, wrong_clock: Path | None) -> Iterator[Fleet]:
    folder = tmp_path_factory.mktemp("fleet")
    place = f"tcp/127.0.0.1:{free_port()}"
    running: dict[str, Gateway] = {}
    ports = free_ports(3)
    words = [sys.executable, "-m", "gateway.cli", "fleet", "--listen", place, "--site", "field-*"]
    for port in ports:
        words += ["--endpoint", f"udp:127.0.0.1:{port}"]
    with (folder / "fleet.log").open("w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log)
    try:
        for site in SITES:
            running[site] = start_site(folder / site, place, site, wrong_clock)
        yield Fleet(ports, running)
    finally:
        for each in [process] + [gateway.process for gateway in running.values()]:
            each.kill()
            each.wait(START_LIMIT_S)


def start_site(folder: Path, place: str, site: str, wrong_clock: Path | None) -> Gateway:
    """Start a site, its civil clock moved if it can be."""
    folder.mkdir()
    text = SITE.replace("{place}", place).replace("{site}", site).replace("{folder}", str(folder))
    with pytest.MonkeyPatch.context() as environment:
        if wrong_clock is not None and site in OFF_S:
            environment.setenv("LD_PRELOAD", str(wrong_clock))
            environment.setenv("CLOCK_OFF_S", str(OFF_S[site]))
        return Gateway(folder, "demo", "--record", config=text)


async def seen(mavsdk: Mavsdk) -> dict[int, System]:
    """Wait until a MAVSDK program sees all three, each with its autopilot."""
    async with asyncio.timeout(START_LIMIT_S):
        while True:
            systems = [s for s in await mavsdk.get_systems() if await s.has_autopilot()]
            if len(systems) == len(SITES):
                return {await system.get_system_id(): system for system in systems}
            await asyncio.sleep(0.1)


async def test_aircraft_with_one_system_id_at_three_sites_are_kept_apart(
    fleet: Fleet, tmp_path: Path, start_mavproxy: Callable[[int], MavProxy]
) -> None:
    (tmp_path / "way.txt").write_text(WAYPOINTS)
    mavproxy = start_mavproxy(fleet.ports[1])
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{fleet.ports[0]}")
        systems = await seen(mavsdk)
        ids = await asyncio.to_thread(fleet.ids)
        assert set(ids) == set(SITES)
        assert {*ids.values()} == {*systems} == {1, 2, 3}
        for system_id in systems:
            await asyncio.to_thread(mavproxy.until, rf"Detected vehicle {system_id}:1")
        first, second, third = (systems[ids[site]] for site in SITES)
        async with asyncio.timeout(START_LIMIT_S):
            params = [ParamAsync(system) for system in (first, second, third)]
            name = "PAPER_ACC_CUTOFF"
            before = [await answered(param.get_param_float, name) for param in params]
            await answered(params[1].set_param_float, name, before[1] + 1.5)
            after = [await answered(param.get_param_float, name) for param in params]
            assert after == [before[0], before[1] + 1.5, before[2]]
        mavproxy.type(f"vehicle {ids['field-3']}")
        mavproxy.type("wp load way.txt")
        found = r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED"
        await asyncio.to_thread(mavproxy.until, found)
        async with asyncio.timeout(START_LIMIT_S):
            missions = [MissionRawAsync(system) for system in (first, second, third)]
            items = [await answered(mission.download_mission) for mission in missions]
        assert [len(found) for found in items] == [0, 0, 2]


def times_reported(client: Client) -> dict[int, float]:
    """Return the civil time that each vehicle reports, once all report it and a position."""
    time_s: dict[int, float] = {}
    fused: set[int] = set()
    for _ in range(DATAGRAMS):
        for message in client.receive():
            if message.get_type() == "SYSTEM_TIME" and message.time_unix_usec:
                time_s[message.get_srcSystem()] = message.time_unix_usec / 1e6
            elif message.get_type() == "GLOBAL_POSITION_INT" and message.lat:
                fused.add(message.get_srcSystem())
        if len(time_s) == len(fused) == len(SITES):
            return time_s
    raise AssertionError(f"only {sorted(time_s)} report the time, {sorted(fused)} the position")


def test_sites_with_wrong_civil_clocks_are_fused_recorded_and_fetched(
    fleet: Fleet, wrong_clock: Path | None, tmp_path: Path
) -> None:
    if wrong_clock is None:
        pytest.skip("no C compiler")
    client, now_s = Client(fleet.ports[2]), time.time()
    time_s = times_reported(client)
    client.sock.close()
    for site, system_id in fleet.ids().items():
        assert abs(time_s[system_id] - now_s - OFF_S.get(site, 0)) < YEAR_S / 365
    wait_for(lambda: set(json.loads(fleet.ask("recordings", "--json"))) == set(SITES))
    logs: dict[str, list[bytes]] = {}

    def fetched(site: str) -> bool:
        """Fetch what is on the site's disk by now."""
        with suppress(subprocess.CalledProcessError):
            fleet.ask("recordings", "get", site, "last", "-o", str(tmp_path / site))
        logs[site] = [log.read_bytes() for log in sorted((tmp_path / site).glob("*.tlog"))]
        return sum(map(len, logs[site])) > 10_000

    for site in OFF_S:
        wait_for(partial(fetched, site))
    assert [gateway.end() for gateway in fleet.sites.values()] == [0, 0, 0]
    for site, off_s in OFF_S.items():
        # A second part begins where GPS reports another time than the clock, as in a late start.
        first_s = int.from_bytes(logs[site][0][:8], "big") / 1e6
        assert abs(first_s - now_s - off_s) < YEAR_S / 365
