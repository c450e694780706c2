"""Several gateways on one machine: each is found, and the same vehicle to one client is noticed."""

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.live import control_socket
from gateway.live.control_socket import ControlServer, Verbs, socket_path
from gateway.live.other_gateways import conflicts, identity_verb, log_other_gateways, other_gateways
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.cli import invoke
from tests.kit.mavlink import Sender
from tests.kit.recordings import START_US, make_tlog

pytestmark = pytest.mark.io

STATION = "udp:127.0.0.1:14550"
Open = Callable[..., object]


@pytest.fixture
async def listen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Open]:
    """Open the socket of a program of another process."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(control_socket, "SERVICE_FOLDER", tmp_path / "service")
    servers = []

    async def listen(name: str, *systems: int, to: str = STATION, pid: int | None = 1) -> None:
        found = {"pid": pid, "since_s": 1.8e9, "systems": systems, "endpoints": [to]}
        verbs: Verbs = {} if pid is None else {"identity": lambda: found}
        server = ControlServer(socket_path(name), verbs)
        await server.start()
        servers.append(server)

    yield listen
    for server in servers:
        server.close()


async def test_all_gateways_but_this_process_are_found(listen: Open) -> None:
    for name in ("run", "run", "play", "fleet"):
        await listen(name, 1)
    await listen("run", pid=os.getpid())
    await listen("run", pid=None)
    found = await asyncio.to_thread(other_gateways)
    assert [(Path(one.socket).name, one.pid) for one in found] == [
        ("run.sock", 1), ("run-2.sock", 1), ("run-4.sock", None), ("play.sock", 1),
        ("fleet.sock", 1),
    ]  # fmt: skip
    assert [one.command for one in found] == ["run", "run", "run", "play", "fleet"]


def test_identity_contains_process_vehicles_and_endpoints() -> None:
    found: Any = identity_verb(lambda: {7, 2}, lambda: (STATION,))["identity"]()
    assert found.pop("since_s") > 1e9
    assert found == {"pid": os.getpid(), "systems": [2, 7], "endpoints": [STATION]}


async def test_same_vehicle_to_the_same_endpoint_is_a_conflict(listen: Open) -> None:
    await listen("run", 1, 2)
    for ids, endpoint, ids_of_other in (
        ((1,), STATION, "1"),
        ((1, 2, 3), "udp:localhost:14550?name=tablet", "1, 2"),
        ((3,), STATION, ""),
        ((1,), "udp:127.0.0.1:14551", ""),
        ((1,), "udp:192.168.1.7:14550", ""),
        ((1,), "tcp:127.0.0.1:14550", ""),
    ):
        found = await asyncio.to_thread(conflicts, ids, [endpoint])
        assert len(found) == bool(ids_of_other), endpoint
        for text in found:
            assert f"vehicle {ids_of_other} is sent to {STATION} by another gateway" in text


async def test_start_next_to_others_names_their_process_and_socket(
    listen: Open, caplog: pytest.LogCaptureFixture
) -> None:
    await listen("run", 1)
    with caplog.at_level(logging.INFO, "gateway.live.other_gateways"):
        await asyncio.to_thread(log_other_gateways)
    (line,) = caplog.messages
    assert "another gateway runs here: pid 1, since 2027-01-15 08:00:00 UTC, socket" in line
    assert line.endswith("run.sock")


@pytest.mark.parametrize("command", ["demo", "play"])
async def test_vehicle_that_another_gateway_sends_is_refused(
    tmp_path: Path, listen: Open, command: str
) -> None:
    await listen("run", 1)
    heartbeat = Sender(1).pack(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3))
    file = tmp_path / "a.tlog"
    file.write_bytes(make_tlog([RecordedFrame(START_US, heartbeat)]))
    words = [command, *([file] if command == "play" else []), "--endpoint", STATION]
    done = await asyncio.to_thread(invoke, *words, code=2)
    assert f"vehicle 1 is sent to {STATION} by another gateway" in done.output
    assert "--duplicate-ids" in done.output


async def test_status_lists_all_gateways(listen: Open) -> None:
    await listen("play", 7)
    text = (await asyncio.to_thread(invoke, "status")).output
    assert "play.sock" in text
    assert "2027-01-15" in text
    await listen("run", 1)
    await listen("run", 2)
    text = (await asyncio.to_thread(invoke, "status")).output
    assert all(name in text for name in ("play.sock", "run.sock", "run-2.sock"))
