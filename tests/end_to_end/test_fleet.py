"""Three fields that all fly an aircraft 1, seen, set and sent on a mission through one fleet."""

import asyncio
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync

from gateway.cli.support.warm_up import make_ready
from gateway.estimation.select import EstimationSettings
from tests.end_to_end.processes import START_LIMIT_S, Gateway, MavProxy, free_udp_ports
from tests.end_to_end.test_ground_stations import WAYPOINTS

pytestmark = [pytest.mark.io, pytest.mark.slow]

SITES = ("field-1", "field-2", "field-3")
SITE = """
[hub]
endpoints = ["zenoh:{place}?site={site}"]

[simulator]
gps_first_fix_s = 0.5
"""


@dataclass
class Fleet:
    """Where its ground stations are."""

    mavsdk_port: int
    mavproxy_port: int

    def ids(self) -> dict[str, int]:
        """Ask by the command line which id each site's aircraft has here."""
        words = [sys.executable, "-m", "gateway.cli", "fleet", "status", "--json"]
        done = subprocess.run(words, capture_output=True, check=True, text=True)
        return {
            site["name"]: vehicle["id"]
            for site in json.loads(done.stdout)["sites"]
            for vehicle in site["vehicles"]
            if vehicle["system_id"] == 1
        }


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    # Once for all: three sites that compile at the same time would take minutes.
    make_ready(EstimationSettings().estimator)
    running: list[Gateway] = []
    ports = free_udp_ports(2)
    words = [sys.executable, "-m", "gateway.cli", "fleet", "--listen", place, "--site", "field-*"]
    for port in ports:
        words += ["--endpoint", f"udp:127.0.0.1:{port}"]
    with (tmp_path / "fleet.log").open("w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log)
    try:
        for site in SITES:
            folder = tmp_path / site
            folder.mkdir()
            text = SITE.replace("{place}", place).replace("{site}", site)
            running.append(Gateway(folder, "demo", config=text))
        yield Fleet(*ports)
    finally:
        for each in (process, *(gateway.process for gateway in running)):
            each.kill()
            each.wait(10)


async def seen(mavsdk: Mavsdk) -> dict[int, System]:
    """Wait until a MAVSDK program sees all three, each with its autopilot."""
    async with asyncio.timeout(START_LIMIT_S):
        while True:
            systems = [s for s in await mavsdk.get_systems() if await s.has_autopilot()]
            if len(systems) == len(SITES):
                return {await system.get_system_id(): system for system in systems}
            await asyncio.sleep(0.1)


async def test_three_aircraft_1(fleet: Fleet, tmp_path: Path) -> None:
    (tmp_path / "way.txt").write_text(WAYPOINTS)
    mavproxy = MavProxy(fleet.mavproxy_port, tmp_path)
    try:
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        async with Mavsdk(configuration) as mavsdk:
            await mavsdk.add_any_connection(f"udpin://127.0.0.1:{fleet.mavsdk_port}")
            systems = await seen(mavsdk)
            ids = await asyncio.to_thread(fleet.ids)
            assert set(ids) == set(SITES)
            assert {*ids.values()} == {*systems} == {1, 2, 3}
            for system_id in systems:
                await asyncio.to_thread(mavproxy.until, rf"Detected vehicle {system_id}:1")
            first, second, third = (systems[ids[site]] for site in SITES)
            async with asyncio.timeout(60):
                params = [ParamAsync(system) for system in (first, second, third)]
                name = "SENS_ACC_CUTOFF"
                before = [await param.get_param_float(name) for param in params]
                await params[1].set_param_float(name, before[1] + 1.5)
                after = [await param.get_param_float(name) for param in params]
                assert after == [before[0], before[1] + 1.5, before[2]]
            mavproxy.type(f"vehicle {ids['field-3']}")
            mavproxy.type("wp load way.txt")
            found = r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED"
            await asyncio.to_thread(mavproxy.until, found)
            async with asyncio.timeout(60):
                missions = [MissionRawAsync(system) for system in (first, second, third)]
                items = [await mission.download_mission() for mission in missions]
            assert [len(found) for found in items] == [0, 0, 2]
    finally:
        mavproxy.process.kill()
        mavproxy.process.communicate(timeout=10)
