"""What operators stored is there again when the gateway comes back."""

import asyncio
import socket
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.cli.prepare import compile_everything
from gateway.config import GatewaySettings
from gateway.daemon import Daemon
from gateway.routing.settings import HubSettings
from gateway.simulator.receiver import simulate
from tests.end_to_end.station import Station
from tests.vehicle.test_mission import RALLY, content, download, item, upload

pytestmark = [pytest.mark.io, pytest.mark.slow]

ITEMS = [item(seq) for seq in range(30)]
START_UNIX_US = 1_781_187_930_000_000
RALLY_ITEMS = [item(seq, RALLY) for seq in range(3)]


def store(port: int) -> None:
    station = Station(socket.SOCK_STREAM, port, 2)
    station.until_heard(30.0)
    assert upload(station, ITEMS) == mavlink.MAV_MISSION_ACCEPTED
    assert upload(station, RALLY_ITEMS, RALLY) == mavlink.MAV_MISSION_ACCEPTED
    number, place = mavlink.MAV_CMD_DO_SET_HOME, (47.5, 8.5, 400.0)
    command = mavlink.MAVLink_command_long_message(1, 1, number, 0, 0, 0, 0, 0, *place)
    assert station.ask(command, "COMMAND_ACK")[0].result == mavlink.MAV_RESULT_ACCEPTED
    station.close()


def find(port: int) -> tuple[int, int, int]:
    station = Station(socket.SOCK_STREAM, port, 2)
    station.until_heard(30.0)
    assert list(map(content, download(station))) == list(map(content, ITEMS))
    assert list(map(content, download(station, RALLY))) == list(map(content, RALLY_ITEMS))
    number, wanted = mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION
    command = mavlink.MAVLink_command_long_message(1, 1, number, 0, wanted, 0, 0, 0, 0, 0, 0)
    [home, *_] = station.ask(command, "HOME_POSITION")
    station.close()
    return home.latitude, home.longitude, home.altitude


async def test_missions_and_home_survive_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compile_everything()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    settings = GatewaySettings(
        hub=HubSettings(endpoints=(f"tcp-listen:127.0.0.1:{port}",)),
        aircraft_folder=str(tmp_path / "aircraft"),
    )
    for use in (store, find):
        line = simulate(settings.simulator, START_UNIX_US).frames()
        daemon = Daemon(settings, {}, lambda: settings, line)
        daemon.start()
        try:
            found = await asyncio.to_thread(use, port)
        finally:
            daemon.close()
        # The event loop ends the readers of what was closed.
        await asyncio.sleep(0)
    assert found == (475_000_000, 85_000_000, 400_000)
    assert [f.name for f in (tmp_path / "aircraft").iterdir()] == ["1.places.json"]
