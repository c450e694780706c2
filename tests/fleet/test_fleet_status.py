"""Status and metrics of a fleet: round trips, rates, sites of the same name."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from gateway.live.control_socket import request
from tests.fleet.conftest import World, run
from tests.hub.conftest import LIMIT_S
from tests.ports import free_port

pytestmark = pytest.mark.io


def site_of(world: World, name: str) -> dict[str, Any]:
    return {site["name"]: site for site in world.fleet.status()["sites"]}.get(name, {})


async def test_status_shows_round_trip_and_rate(world: World) -> None:
    world.open_site("field-a")
    world.open_site("field-b")
    await world.until(lambda: len(world.systems()) == 2)

    def asked() -> bool:
        world.fleet._session.ask_round_trips()
        return all(site_of(world, name)["round_trip_s"] for name in ("field-a", "field-b"))

    await world.until(asked)
    assert 0 < site_of(world, "field-a")["round_trip_s"] < 5
    assert site_of(world, "field-a")["vehicles"][0]["rate_hz"] > 0
    shown = await run("fleet", "status")
    head, *rows = [line.split() for line in shown.splitlines() if line.strip()][1:]
    assert head == ["site", "ms", "system", "id", "here", "Hz", "age", "s", "lost"]
    assert {row[0] for row in rows} >= {"field-a", "field-b"}
    listed = json.loads(await run("fleet", "status", "--json"))
    assert {site["name"] for site in listed["sites"]} == {"field-a", "field-b"}


async def test_metrics_contain_sites_and_vehicles(world: World) -> None:
    world.open_site("field-a")
    await world.until(lambda: bool(world.systems()))
    port = free_port()
    world.fleet._metrics.listen(port)
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
    text = (await reader.read()).decode()
    writer.close()
    assert "mavgate_fleet_linked 1.0" in text
    assert 'mavgate_fleet_site_here{site="field-a"} 1.0' in text
    assert 'mavgate_fleet_vehicle_lost_total{id="1",site="field-a",system="1"} 0.0' in text
    assert "mavgate_hub_forwarded_total" in text


async def test_two_sites_of_one_name_are_reported(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    first = world.open_site("field-a")
    await world.until(lambda: site_of(world, "field-a").get("sessions") == 1)
    world.open_site("field-a")
    await world.until(lambda: site_of(world, "field-a")["sessions"] == 2)
    assert "2 sites are called 'field-a'" in caplog.text
    assert "2 of this name" in await run("fleet", "status")
    first.close()
    await world.until(lambda: site_of(world, "field-a")["sessions"] == 1)
    assert site_of(world, "field-a")["is_here"], "the other one is there still"


async def test_excluded_vehicle_is_not_shown(world: World, tmp_path: Path) -> None:
    world.open_site("field-a")
    world.open_site("field-b")
    await world.until(lambda: len(world.systems()) == 2)
    await run("fleet", "id", "field-a/1", "0")

    def one_is_left() -> bool:
        del world.got[:-100]
        return len(world.got) == 100 and len(world.systems()) == 1

    await world.until(one_is_left)
    assert "excluded: field-a/1" in await run("fleet", "status")
    assert json.loads((tmp_path / "fleet.json").read_text())["field-a/1"] == 0
    params = {"site": "field-a", "system_id": 1, "own_id": 9}
    path = world.fleet.control_socket
    await asyncio.to_thread(request, path, "fleet.id", params, timeout_s=LIMIT_S)
    await world.until(lambda: 9 in world.systems())
