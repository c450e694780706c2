"""Sites and a fleet with real sessions: frames, presence, loops, ids, status, metrics."""

import asyncio
import json
import socket
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.fleet import server as fleet_server
from gateway.fleet.id_map import LAST_ID
from gateway.fleet.server import FleetServer
from gateway.fleet.settings import FleetSettings
from gateway.hub.settings import HubSettings
from gateway.hub.transports.zenoh.session import site_key
from gateway.live.control_socket import ControlError
from gateway.wire.mavlink_signing import EPOCH_2015_US, TICK_US, key_from_passphrase
from tests.fleet.conftest import World, announce, opened_world, run
from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S, Process, wait_for
from tests.ports import free_port

pytestmark = pytest.mark.io


@pytest.fixture
def _polls_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_server, "POLL_S", 0.01)


async def test_two_aircraft_1_get_two_ids_and_a_command_reaches_the_right_one(world: World) -> None:
    world.open_site("office")
    await world.open("field-a", "field-b")
    ids = world.ids()
    assert set(ids) == {("field-a", 1), ("field-b", 1)}
    assert set(ids.values()) == world.systems() == {1, 2}
    world.station.send(world.station.sender.command(ids["field-b", 1], 1))
    await world.until(lambda: world.commands("field-b"))
    (command,) = world.commands("field-b")
    assert (command.target_system, command.get_srcSystem()) == (1, 255)
    assert not world.commands("field-a")
    ack = mavlink.MAVLink_command_ack_message(512, 0, 0, 0, 255, 190)
    world.rig.publish(world.sites["field-b"], world.vehicles["field-b"].pack(ack))
    await world.until(lambda: any(m.get_type() == "COMMAND_ACK" for m in world.got))
    answer = next(m for m in world.got if m.get_type() == "COMMAND_ACK")
    assert (answer.get_srcSystem(), answer.target_system) == (ids["field-b", 1], 255)


@pytest.mark.usefixtures("_polls_often")
@pytest.mark.parametrize("ids", [{f"field-many/{n}": n for n in range(1, LAST_ID + 1)}])
async def test_id_of_an_abandoned_vehicle_is_passed_on(
    world: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fleet_server, "ABANDONED_US", 0)
    await world.open("field-a")
    (own_id,) = world.systems()
    assert world.ids() == {("field-a", 1): own_id}
    assert (
        f"id {own_id} of field-many/{own_id}, not received for an hour, is now of field-a/1"
        in caplog.text
    )


@pytest.mark.usefixtures("_polls_often")
async def test_abandoned_site_is_removed_when_sites_are_full(
    world: World, forger: Any, settings: FleetSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_server, "MAX_SITES", 3)
    tokens = {name: announce(forger, name) for name in ("field-1", "field-2", "field-3", "field-4")}
    await world.until(lambda: world.fleet.status()["bad_names"])
    assert list(world.shown()) == ["field-1", "field-2", "field-3"]
    tokens["field-2"].undeclare()
    await world.until(lambda: not world.shown()["field-2"]["is_here"])
    # Ids are saved at the intervals at which room is made: once for each of the vehicles.
    saved = Path(settings.ids_file)
    for system in (1, 2):
        forger.put(site_key("field-1", system, "out"), world.rig.sender(system).heartbeat())
        await world.until(lambda n=system: saved.exists() and f"1/{n}" in saved.read_text())
    assert "field-2" in world.shown()
    monkeypatch.setattr(fleet_server, "ABANDONED_US", 0)
    await world.until(lambda: "field-2" not in world.shown())
    tokens["field-4"].undeclare()
    tokens["field-4"] = announce(forger, "field-4")
    await world.until(lambda: "field-4" in world.shown())
    assert list(world.shown()) == ["field-1", "field-3", "field-4"]
    assert "field-2" not in {client.name for client in world.fleet.status()["clients"]}


async def test_frames_of_one_site_never_reach_another(world: World) -> None:
    await world.open("field-a", "field-b")
    await world.until(lambda: len(world.got) > 200)
    assert world.vehicles["field-a"].heartbeat() == world.vehicles["field-b"].heartbeat()
    looped = [site["looped"] for site in world.shown().values()]
    assert looped == [0, 0], "equal frames of two vehicles are no loop"
    for name, hub in world.sites.items():
        assert {each.frame[5] for each in world.received[name]} <= {255}
        assert hub.clients()[0].systems == ((255, 190),)


async def test_disconnected_site_is_reported_once(world: World) -> None:
    await world.open("field-a", "field-b")
    world.sites.pop("field-b").close()
    await world.until(lambda: any(m.get_type() == "STATUSTEXT" for m in world.got))
    later = len(world.got) + 40
    await world.until(lambda: len(world.got) > later)
    texts = [m.text for m in world.got if m.get_type() == "STATUSTEXT"]
    assert texts == ["Site field-b disconnected"]
    is_here = {name: site["is_here"] for name, site in world.shown().items()}
    assert is_here == {"field-a": True, "field-b": False}


@pytest.mark.parametrize("ids", [{"field-a/1": 7}])
async def test_frames_fed_back_by_a_site_go_round_once(rig: Rig, settings: FleetSettings) -> None:
    port = free_port()
    hub = HubSettings(endpoints=(f"udp:127.0.0.1:{port}",))
    async with opened_world(rig, settings, hub) as world:
        world.open_site("field-a", extra=f"udp-listen:127.0.0.1:{port}")
        await world.until(lambda: 7 in world.systems())
        world.station.send(world.station.sender.command(7, 1))
        await world.until(lambda: world.shown()["field-a"]["looped"] > 50)
        assert world.ids() == {("field-a", 1): 7}
        assert json.loads(Path(settings.ids_file).read_text()) == {"field-a/1": 7}
        assert len(world.commands("field-a")) == 1
        assert "looped frames dropped" in await run("fleet", "status")


async def test_rejected_frames_of_a_site_with_passphrase_are_counted(world: World) -> None:
    hub = world.open_site("field-s")
    world.open_site("field-a")
    vehicle = world.rig.sender(1, signed=True)
    vehicle.link.signing.secret_key = key_from_passphrase("secret")
    vehicle.link.signing.timestamp = (time.time_ns() // 1000 - EPOCH_2015_US) // TICK_US
    world.vehicles["field-s"] = vehicle
    await world.until(lambda: len(world.systems()) == 2)
    forged, recorded = world.rig.sender(1, signed=True), vehicle.attitude()
    frames = (forged.attitude(), world.rig.sender(1).attitude(), recorded, recorded)
    world.rig.publish(hub, *frames)

    def counts() -> list[int]:
        return [world.shown()["field-s"][kind] for kind in ("forged", "unsigned", "replayed")]

    await world.until(lambda: counts() == [1, 1, 1])
    shown = await run("fleet", "status")
    assert "frames of field-s dropped: 1 unsigned, 1 forged, 1 replayed" in shown


async def test_garbage_and_invalid_site_names_are_counted(world: World, forger: Any) -> None:
    forger.put("mavlink/field-x/1/out", b"no MAVLink at all")
    forger.put("mavlink/field- x/1/out", b"\xfd")
    await world.until(lambda: world.fleet.status()["bad_names"])
    assert {name: site["bytes_garbage"] for name, site in world.shown().items()} == {"field-x": 17}


ASSIGNED = {"site": "field-a", "system_id": 1, "own_id": 77}


async def test_assigned_id_is_used_shown_and_saved(world: World, settings: FleetSettings) -> None:
    await world.open("field-a")
    assert await world.ask("fleet.id", **ASSIGNED) == ["field-a/1 = 77"]
    await world.until(lambda: 77 in world.systems())
    [site] = (await world.ask("fleet.status"))["sites"]
    assert site["vehicles"][0]["id"] == 77
    assert json.loads(Path(settings.ids_file).read_text()) == {"field-a/1": 77}


@pytest.mark.usefixtures("_polls_often")
@pytest.mark.parametrize("ids", [{"field-a/1": 5}])
async def test_id_that_cannot_be_saved_is_an_error(world: World, settings: FleetSettings) -> None:
    with pytest.raises(ControlError, match=r"unknown site 'field-z'; known: .*field-a"):
        await world.ask("fleet.id", **ASSIGNED | {"site": "field-z"})
    file = Path(settings.ids_file)
    file.unlink()
    file.mkdir()
    with pytest.raises(ControlError, match=r"not saved: .*fleet\.json: Invalid argument"):
        await world.ask("fleet.id", **ASSIGNED)
    file.rmdir()
    await world.until(file.exists)
    assert json.loads(file.read_text()) == {"field-a/1": 77}


@pytest.mark.parametrize(
    ("text", "words"),
    [("[]", "object"), ('{"x": 1}', "SITE/SYSTEM"), ('{"a/1": 5, "b/1": 5}', "twice")],
)
def test_malformed_file_of_ids_is_refused(settings: FleetSettings, text: str, words: str) -> None:
    Path(settings.ids_file).write_text(text)
    with pytest.raises(ValueError, match=words):
        FleetServer(settings, HubSettings())


@pytest.mark.parametrize("site", ["a/b", "", "a**", "a b", "$*"])
def test_malformed_site_pattern_is_refused(settings: FleetSettings, site: str) -> None:
    with pytest.raises(ValueError, match="site"):
        FleetServer(FleetSettings(sites=(site,), ids_file=settings.ids_file), HubSettings())


def command(folder: Path, *words: str) -> Process:
    """Run a fleet that waits for its router for an hour."""
    patient = folder / "patient.json5"
    patient.write_text("{transport: {unicast: {open_timeout: 3600000}}}")
    config = f'[fleet]\nids_file = "{folder}/ids.json"\nzenoh_config = "{patient}"\n'
    return Process(folder, "fleet", *words, "--endpoint", "udp:127.0.0.1:9", config=config)


def test_fleet_ends_on_sigterm(tmp_path: Path, settings: FleetSettings) -> None:
    host, port = settings.listen.removeprefix("tcp/").split(":")

    def answers() -> bool:
        with suppress(ConnectionRefusedError), socket.create_connection((host, int(port))):
            return True
        return False

    with command(tmp_path, "--listen", settings.listen) as fleet:
        wait_for(answers)
        assert fleet.end() == 0


def test_fleet_ends_on_sigterm_while_its_router_does_not_answer(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        mute.settimeout(START_LIMIT_S)
        locator = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        with command(tmp_path, "--connect", locator) as fleet, mute.accept()[0]:
            assert fleet.end() == 0


@pytest.mark.usefixtures("_polls_often")
@pytest.mark.parametrize("hub_settings", [HubSettings(endpoints=(), ping_interval_s=0.05)])
async def test_status_shows_round_trip_and_rate(world: World) -> None:
    names = ("field-a", "field-b")
    await world.open(*names)
    await world.until(lambda: all(world.shown()[name]["round_trip_s"] for name in names))
    site = world.shown()["field-a"]
    assert 0 < site["round_trip_s"] < 5
    assert site["vehicles"][0]["rate_hz"] > 0
    shown = await run("fleet", "status")
    head, *rows = [line.split() for line in shown.splitlines() if line.strip()][1:]
    assert head == ["site", "RTT", "ms", "system", "id", "here", "Hz", "age", "s", "lost"]
    assert {row[0] for row in rows} >= {*names}
    listed = json.loads(await run("fleet", "status", "--json"))
    assert {site["name"] for site in listed["sites"]} == {*names}


async def test_metrics_contain_sites_and_vehicles(rig: Rig, settings: FleetSettings) -> None:
    port = free_port()
    hub = HubSettings(endpoints=(), metrics_port=port)
    async with opened_world(rig, settings, hub) as world:
        await world.open("field-a")
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
        text = (await reader.read()).decode()
        writer.close()
    assert "mavgate_fleet_linked 1.0" in text
    assert 'mavgate_fleet_site_here{site="field-a"} 1.0' in text
    assert 'mavgate_fleet_vehicle_lost_total{id="1",site="field-a",system="1"} 0.0' in text
    assert "mavgate_hub_forwarded_total" in text


async def test_sites_of_one_name_are_reported(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    def sessions() -> int:
        return world.shown().get("field-a", {}).get("sessions", 0)

    first = world.open_site("field-a")
    await world.until(lambda: sessions() == 1)
    world.open_site("field-a")
    await world.until(lambda: sessions() == 2)
    assert "2 sites are called 'field-a'" in caplog.text
    assert "2 of this name" in await run("fleet", "status")
    first.close()
    await world.until(lambda: sessions() == 1)
    assert world.shown()["field-a"]["is_here"], "the other one is there still"


async def test_session_under_many_names_takes_ids_of_one_site(world: World, forger: Any) -> None:
    tokens = [announce(forger, f"field-{n}") for n in range(6)]

    def forge(least: int) -> bool:
        for number in range(6):
            for system in range(1, 60):
                key = site_key(f"field-{number}", system, "out")
                forger.put(key, world.rig.sender(system).heartbeat())
        return len(world.ids()) >= least

    # Those of the one site that the session may announce, and of all without a session.
    await world.until(lambda: forge(100))
    world.open_site("field-late")
    await world.until(lambda: forge(101))
    await world.until(lambda: ("field-late", 1) in world.ids())
    assert len(world.ids()) == 101
    assert len(world.fleet.status()["without_session"]) == 5
    assert "sharing the ids of one site: field-" in await run("fleet", "status")
    for token in tokens:
        token.undeclare()


async def test_excluded_vehicle_is_not_shown(world: World, settings: FleetSettings) -> None:
    await world.open("field-a", "field-b")
    await run("fleet", "id", "field-a/1", "0")

    def one_is_left() -> bool:
        del world.got[:-100]
        return len(world.got) == 100 and len(world.systems()) == 1

    await world.until(one_is_left)
    assert "excluded: field-a/1" in await run("fleet", "status")
    assert json.loads(Path(settings.ids_file).read_text())["field-a/1"] == 0
    await world.ask("fleet.id", **ASSIGNED | {"own_id": 9})
    await world.until(lambda: 9 in world.systems())
