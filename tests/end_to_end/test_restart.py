"""What operators stored is there again when the gateway comes back."""

import asyncio
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.config import GatewaySettings
from gateway.hub.settings import HubSettings
from gateway.live.daemon import Daemon
from gateway.simulator.receiver import simulate
from tests.end_to_end.processes import Client
from tests.end_to_end.station import Station
from tests.kit.ground_station import MISSION, RALLY, content, download, item, upload
from tests.kit.process import START_LIMIT_S
from tests.ports import free_port

pytestmark = [pytest.mark.io, pytest.mark.slow]

ITEMS = [item(seq) for seq in range(30)]
START_UNIX_US = 1_781_187_930_000_000
RALLY_ITEMS = [item(seq, RALLY) for seq in range(3)]


def store(port: int) -> None:
    station = Station.connect(socket.SOCK_STREAM, port, 2)
    station.until_heard()
    for items, kind in ((ITEMS, MISSION), (RALLY_ITEMS, RALLY)):
        # The aircraft ends the transfer of a station that sends nothing for some seconds.
        results = (upload(station, items, kind) for _ in range(10))
        assert mavlink.MAV_MISSION_ACCEPTED in results
    number, place = mavlink.MAV_CMD_DO_SET_HOME, (47.5, 8.5, 400.0)
    command = mavlink.MAVLink_command_long_message(1, 1, number, 0, 0, 0, 0, 0, *place)
    assert station.ask(command, "COMMAND_ACK")[0].result == mavlink.MAV_RESULT_ACCEPTED
    station.close()


def find(port: int) -> tuple[int, int, int]:
    station = Station.connect(socket.SOCK_STREAM, port, 2)
    station.until_heard()
    assert list(map(content, download(station))) == list(map(content, ITEMS))
    assert list(map(content, download(station, RALLY))) == list(map(content, RALLY_ITEMS))
    number, wanted = mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION
    command = mavlink.MAVLink_command_long_message(1, 1, number, 0, wanted, 0, 0, 0, 0, 0, 0)
    [home, *_] = station.ask(command, "HOME_POSITION")
    station.close()
    return home.latitude, home.longitude, home.altitude


def texts_until_file_is_named(client: Client) -> list[str]:
    """Return texts and message names up to the text that names the file."""
    texts = [""]
    while "1.plan.json" not in texts[-1]:
        assert len(texts) < 20_000, texts
        texts += [getattr(m, "text", m.get_type()) for m in client.receive()]
        texts = texts[: next((n + 1 for n, t in enumerate(texts) if "1.plan.json" in t), None)]
    return texts


async def run(folder: Path, use: Callable[[int], Any], *others: str) -> Any:
    """Run the gateway while `use` works with its TCP port, or with another endpoint."""
    port = free_port()
    settings = GatewaySettings(
        hub=HubSettings(endpoints=(f"tcp-listen:127.0.0.1:{port}", *others)),
        aircraft_folder=str(folder / "aircraft"),
    )
    line = simulate(settings.simulator, START_UNIX_US).frames()
    daemon = Daemon(settings, {}, lambda: settings, line)
    assert daemon._receiver is not None
    begin, daemon._receiver.start = daemon._receiver.start, lambda: None
    daemon.start()
    try:
        # Endpoints open off the loop: no aircraft sends before all of them listen.
        async with asyncio.timeout(START_LIMIT_S):
            while any(client.state != "open" for client in daemon._hub.clients()):
                await asyncio.sleep(0.01)
        begin()
        return await asyncio.to_thread(use, port)
    finally:
        daemon.close()
        # The event loop ends the readers of what was closed.
        await asyncio.sleep(0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


async def test_broken_file_is_reported_when_the_aircraft_appears(
    folder: Path, connect: Callable[..., Client]
) -> None:
    file = folder / "aircraft" / "1.plan.json"
    file.parent.mkdir()
    file.write_text("{")
    # It listens before the gateway begins: a later client may miss the text.
    client = connect(port := free_port())
    texts = await run(folder, lambda _: texts_until_file_is_named(client), f"udp:127.0.0.1:{port}")
    assert texts[-1].startswith("Mission, mark and home not stored: 1.plan.json")
    assert "HEARTBEAT" in texts, "ground stations show no text before it"
    assert file.read_text() == "{"


async def test_missions_and_home_survive_a_restart(folder: Path) -> None:
    await run(folder, store)
    assert await run(folder, find) == (475_000_000, 85_000_000, 400_000)
    assert [f.name for f in (folder / "aircraft").iterdir()] == ["1.plan.json"]
