"""The commands about clients, against a control socket with canned answers."""

import asyncio
import dataclasses
import io
import json
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from gateway.cli.live import clients
from gateway.config import load
from gateway.hub.stats import HubCounters, ListenerStats
from gateway.live.control_socket import ControlError, ControlServer, Verbs, socket_path
from gateway.records import LinkReport, LoggedRequest, NodeId, NodeLink, NodeStatus
from gateway.status import AircraftStatus, RelativeLocation, Snapshot
from tests.client_stats import TABLET
from tests.kit.cli import invoke
from tests.kit.records import NOTHING

pytestmark = pytest.mark.io

CLIENT = dataclasses.replace(
    TABLET,
    endpoint="udp:10.0.0.7:14550?name=tablet",
    systems=((255, 190),),
    sent=5000,
    dropped=2,
    bytes_sent=200_000,
    received=10,
    bytes_received=200,
    queued=3,
    heard_us=1_000_000,
    round_trip_us=1500,
)
RADIO = dataclasses.replace(
    CLIENT,
    endpoint="udp:10.0.0.8:14550",
    name="radio",
    state="unreachable",
    reason="No such device",
    systems=tuple((n, 1) for n in range(1, 250)),
)
OPEN = ListenerStats("udp-listen:0.0.0.0:14551", "", "open", "", 14551, 1, 0)
CLOSED = ListenerStats(
    "observers", "tcp-listen:[::]:5760?name=observers", "closed", "Address already in use", 0, 0, 8
)
NODE = NodeLink(NodeId(1, 2), 0, 100, 7, 0, 0, 1, 60.0, 0, 0.0)
SNAPSHOT = Snapshot(
    time_us=3_723_000_000,
    report=LinkReport(0, True, "/dev/ttyUSB0", 0, 103, 4, (), (NODE,), None),
    states=((1, msgspec.structs.replace(NOTHING, lat_deg=47.5)),),
    clients=(CLIENT, RADIO),
    sent=((30, 9),),
    hub=HubCounters(published=9, looped=1),
    aircraft=(
        AircraftStatus(
            1,
            None,
            RelativeLocation(47.0, 8.0, 500.0, 1234.4, 271.2),
            RelativeLocation(47.0, 8.0, 1.0, None, None),
            (NodeStatus(0, NodeId(1, 2), 0, (1, 4), 1, 7, 0, 12, 3, 450, 900, 100, 3290),),
        ),
    ),
    listeners=(OPEN, CLOSED),
    refused=3,
    requests=(
        LoggedRequest(
            1, 255, 190, "COMMAND_LONG REQUEST_MESSAGE 62", "UNSUPPORTED", 3, 3_720_000_000
        ),
    ),
)


@pytest.fixture
async def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[list[object]]:
    """What is asked of a gateway."""
    asked: list[object] = []

    def add(url: str) -> list[str]:
        asked.append(url)
        return ["udp:127.0.0.1:14550", url]

    def mark(
        lat_deg: float | None, lon_deg: float | None, alt_amsl_m: float | None,
        vehicle_id: int | None,
    ) -> str:  # fmt: skip
        asked.append((lat_deg, lon_deg, alt_amsl_m, vehicle_id))
        return "marked"

    def remove(name: str) -> list[str]:
        raise ControlError(f"no endpoint is called {name!r}")

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "140")
    verbs: Verbs = {
        "status": lambda: SNAPSHOT,
        "clients.list": lambda: SNAPSHOT.clients,
        "clients.add": add,
        "clients.remove": remove,
        "reload": lambda: "settings of the hub applied",
        "mark": mark,
    }
    server = ControlServer(socket_path("run"), verbs)
    await server.start()
    yield asked
    server.close()


async def run(*words: object, code: int = 0) -> str:
    return (await asyncio.to_thread(invoke, *words, code=code)).output


async def test_status_is_printed_as_text(asked: list[object]) -> None:
    text = await run("status")
    assert "up 1:02:03, receiver: /dev/ttyUSB0 connected" in text
    assert "serial: 103 frames, 4 lost; radio: 100 payloads, 7 lost" in text
    assert "aircraft 1: 47.500000 —, — m" in text
    assert "aircraft 1: home 1234 m, 271°" in text
    assert "mark" not in text
    assert "MAVLink frames: 9 published, 1 looped" in text
    assert "requests: 3 refused" in text
    assert "tablet" in text
    assert "255.190" in text
    assert "radio: No such device" in text
    assert "radio 1.1 2.1 3.1 4.1 5.1 6.1 7.1 8.1 and 241 more unreachable" in " ".join(
        text.split()
    )
    rows = [line.split() for line in text.splitlines()]
    assert ["1", "IMU", "60", "100", "7", "1", "3.29", "12", "3", "450", "—", "1.4"] in rows
    assert ["udp-listen:0.0.0.0:14551", "open", "1", "0"] in rows
    assert ["observers", "Address", "already", "in", "use", "0", "8"] in rows


async def test_failed_requests_are_listed(asked: list[object]) -> None:
    rows = [line.split() for line in (await run("status", "--requests")).splitlines()]
    request = ["COMMAND_LONG", "REQUEST_MESSAGE", "62"]
    assert ["1", "255.190", *request, "UNSUPPORTED", "3", "3.0"] in rows
    assert json.loads(await run("status", "--requests", "--json"))[0]["count"] == 3


async def test_status_is_printed_as_json(asked: list[object]) -> None:
    found = json.loads(await run("status", "--json"))
    assert found["clients"][0]["round_trip_us"] == 1500
    assert found["states"][0][1]["lon_deg"] is None
    assert found["hub"]["published"] == 9


async def test_clients_are_listed_added_removed_and_applied_again(asked: list[object]) -> None:
    assert "3722.0" in (await run("clients", "list"))
    assert json.loads(await run("clients", "list", "--json"))[0]["name"] == "tablet"
    assert (await run("clients", "add", CLIENT.endpoint)) == f"added {CLIENT.name}\n"
    assert asked == [CLIENT.endpoint]
    reported = "observers: Address already in use; trying again until it works"
    assert reported in (await run("clients", "add", CLOSED.endpoint))
    assert "no endpoint is called 'phone'" in await run("clients", "remove", "phone", code=2)
    assert "settings of the hub applied" in await run("clients", "reload")


def test_client_fits_on_one_line_of_a_narrow_terminal() -> None:
    client = dataclasses.replace(
        CLIENT,
        name="udp:127.0.0.1:14550",
        state="refused",
        sent=1234567,
        systems=(),
        heard_us=SNAPSHOT.time_us - 12_300_000,
    )
    paper = io.StringIO()
    terminal = Console(file=paper, width=80, force_terminal=True, color_system=None)
    found = json.loads(msgspec.json.encode([client]))
    terminal.print(clients._clients(found, SNAPSHOT.time_us))
    [row] = [line.split()[:3] for line in paper.getvalue().splitlines()[2:]]
    assert row == ["udp:127.0.0.1:14550", "refused", "1234567"]


async def test_piped_tables_and_texts_are_never_wrapped(
    asked: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    lines = (await run("status")).splitlines()
    assert "up 1:02:03, receiver: /dev/ttyUSB0 connected" in lines
    assert ["observers", "Address", "already", "in", "use", "0", "8"] in map(str.split, lines)


async def test_mark_accepts_negative_coordinates(asked: list[object]) -> None:
    assert (await run("clients", "mark", "-7.76", "-110.4", "-3")) == "marked\n"
    assert asked == [(-7.76, -110.4, -3.0, None)]
    await run("clients", "mark", "--hight", "3", code=2)


async def test_added_client_is_saved_on_request(asked: list[object], tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"
    words = ("clients", "add", "udp:127.0.0.1:9", "--save", "--config", file)
    assert f"saved in {file}" in await run(*words)
    assert "udp:127.0.0.1:9" in load(file).hub.endpoints
    assert "added, but not saved" in await run(*words, code=2)


def test_missing_gateway_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert "nothing runs" in invoke("status", code=2).output
