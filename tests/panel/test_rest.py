"""The REST API as scripts use it: a server, a hub with a vehicle, and HTTP between them."""

import asyncio
import json
import math
import re
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import httpx
import pytest
import uvicorn
import websockets
from fastapi import FastAPI
from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.systems import NO_FILTER
from gateway.panel.access import COOKIE, AccessControl
from gateway.panel.logins import Logins, hash_password
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.rest_api import MAX_WAITING_BYTES, RestApi, Subscriber, names_matching
from gateway.panel.state.fleet import FleetState
from gateway.panel.uplink import ControlClient, Uplink
from gateway.records import Incoming, Outgoing
from gateway.wire.mavlink_json import template

pytestmark = pytest.mark.io

LIMIT_S = 60.0
ATTITUDE = "/v1/mavlink/vehicles/1/components/1/messages/ATTITUDE"


@dataclass
class World:
    """A vehicle behind a hub, and the panel's server that hears it."""

    hub: Hub
    heard: list[Incoming]
    url: str
    client: httpx.AsyncClient
    vehicle: Any

    def send(self, message: Any) -> None:
        frame = bytes(message.pack(self.vehicle))
        self.vehicle.seq = (self.vehicle.seq + 1) % 256
        self.hub.send(Outgoing(frame, message.get_msgId()))

    def attitude(self, roll: float) -> None:
        self.send(mavlink.MAVLink_attitude_message(5, roll, 0.25, 0, 0, 0, 0))

    async def until_json(self, path: str, value: Any) -> None:
        async with asyncio.timeout(LIMIT_S):
            while (answer := await self.client.get(path)).text != json.dumps(value):
                assert answer.status_code in (200, 404)
                await asyncio.sleep(0.01)

    def commands(self) -> list[Any]:
        link = mavlink.MAVLink(None)
        found = (link.decode(bytearray(incoming.frame)) for incoming in self.heard)
        return [message for message in found if message.get_type() == "COMMAND_LONG"]

    async def until_commanded(self) -> Any:
        async with asyncio.timeout(LIMIT_S):
            while not self.commands():
                await asyncio.sleep(0.01)
        return self.commands()[-1]


@pytest.fixture(scope="module")
def password() -> str:
    return hash_password("secret")


@asynccontextmanager
async def open_world(folder: Path, settings: PanelSettings) -> AsyncIterator[World]:
    heard: list[Incoming] = []
    clock = GatewayClock()
    hub = Hub(HubSettings(endpoints=("udp-listen:127.0.0.1:0",)), heard.append, clock)
    hub.start()
    fleet, control = FleetState(), ControlClient(folder / "none")
    uplink = Uplink(f"udp:127.0.0.1:{hub.listening_ports()[0]}", fleet, control, clock)
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url="/docs.json")
    for router in RestApi(uplink).routers():
        app.include_router(router)
    guard = AccessControl(app, settings, Logins(settings.password, settings.viewer_password))
    sock = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(guard, log_level="warning", lifespan="off"))
    serving = asyncio.create_task(server.serve(sockets=[sock]))
    uplink.start()
    url = f"127.0.0.1:{sock.getsockname()[1]}"
    async with httpx.AsyncClient(base_url=f"http://{url}", timeout=LIMIT_S) as client:
        world = World(hub, heard, url, client, mavlink.MAVLink(None, 1, 1))
        world.send(mavlink.MAVLink_heartbeat_message(1, 0, 81, 0, 4, 3))
        async with asyncio.timeout(LIMIT_S):
            while not hub.clients():
                await asyncio.sleep(0.01)
        yield world
    server.should_exit = True
    await serving
    uplink.close()
    hub.close()


@pytest.fixture
async def world(tmp_path: Path) -> AsyncIterator[World]:
    async with open_world(tmp_path, PanelSettings()) as world:
        yield world


class TestReading:
    async def test_message_fields_and_status_are_read(self, world: World) -> None:
        world.attitude(0.5)
        await world.until_json(f"{ATTITUDE}/message/roll", 0.5)
        answer = await world.client.get(ATTITUDE)
        assert answer.headers["content-type"] == "application/json"
        found = answer.json()
        assert found["message"]["pitch"] == 0.25
        assert sorted(found["status"]["time"]) == [
            "counter", "first_update", "frequency", "last_update"
        ]  # fmt: skip
        assert answer.text == json.dumps(found, indent=2)
        world.attitude(0.75)
        await world.until_json(f"{ATTITUDE}/status/time/counter", 2)
        await world.until_json(f"{ATTITUDE.removeprefix('/v1')}/message/roll", 0.75)
        everything = (await world.client.get("/v1/mavlink")).json()
        assert everything["vehicles"]["1"]["components"]["1"]["messages"].keys() >= {"ATTITUDE"}

    async def test_unknown_path_is_answered_by_none(self, world: World) -> None:
        for path in ("vehicles/9", "vehicles/", "ATTITUDE"):
            answer = await world.client.get(f"/v1/mavlink/{path}")
            assert (answer.status_code, answer.text) == (200, "None")
            assert answer.headers["content-type"] == "application/json"

    async def test_helper_returns_an_empty_message(self, world: World) -> None:
        answer = (await world.client.get("/v1/helper/mavlink?name=COMMAND_LONG")).json()
        assert answer["header"] == {"system_id": 255, "component_id": 0, "sequence": 0}
        assert answer["message"]["command"] == {"type": "MAV_CMD_NAV_WAYPOINT"}
        wrong = await world.client.get("/helper/mavlink?name=NO_SUCH")
        assert (wrong.status_code, wrong.json()) == (404, "Invalid message name.")
        assert (await world.client.get("/v1/helper/mavlink")).status_code == 400

    async def test_info_and_api_documents_are_served(self, world: World) -> None:
        info = (await world.client.get("/info")).json()
        assert info["version"] == 0
        assert info["service"]["name"] == "mavgate"
        assert info["service"]["sha"]
        paths = (await world.client.get("/docs.json")).json()["paths"]
        assert {"/info", "/v1/mavlink", "/v1/mavlink/{path}", "/v1/helper/mavlink"} == set(paths)
        assert "docs.json" in (await world.client.get("/docs")).text


COMMAND = {
    "header": {"system_id": 255, "component_id": 0, "sequence": 0},
    "message": {
        **template("COMMAND_LONG"),
        "command": {"type": "MAV_CMD_COMPONENT_ARM_DISARM"},
        "param1": 1.0,
        "target_system": 1,
        "target_component": 1,
    },
}


COMMAND_IN_JSON5 = """
// Arm, as the README of mavlink2rest comments its examples.
{
    header: {system_id: 255, component_id: 0, sequence: 0,},
    message: {
        type: 'COMMAND_LONG', command: {type: 'MAV_CMD_COMPONENT_ARM_DISARM'},
        param1: +1, param2: .5, param3: NaN, param4: 0., param5: 0, param6: 0, param7: 0,
        target_system: 0x1, target_component: 1, confirmation: 0, /* the end */
    },
}
"""


class TestWriting:
    async def test_command_is_sent_and_its_answer_readable(self, world: World) -> None:
        answer = await world.client.post("/v1/mavlink", json=COMMAND)
        assert (answer.status_code, answer.text) == (200, "Ok.")
        command = await world.until_commanded()
        assert (command.command, command.param1) == (400, 1.0)
        assert (command.get_srcSystem(), command.get_srcComponent()) == (255, 0)
        world.send(mavlink.MAVLink_command_ack_message(400, 0, 0, 0, 255, 0))
        path = "/v1/mavlink/vehicles/1/components/1/messages/COMMAND_ACK/message/result/type"
        await world.until_json(path, "MAV_RESULT_ACCEPTED")
        sent = "/v1/mavlink/vehicles/255/components/0/messages/COMMAND_LONG"
        found = (await world.client.get(sent)).json()
        assert found["message"] == COMMAND["message"]
        assert (await world.client.post("/v1/mavlink", json=COMMAND)).status_code == 200
        await world.until_json(f"{sent}/status/time/counter", 2)

    async def test_message_in_json5_is_sent(self, world: World) -> None:
        pytest.importorskip("pyjson5", reason="older than the lock file: install it again")
        answer = await world.client.post("/v1/mavlink", content=COMMAND_IN_JSON5)
        assert (answer.status_code, answer.text) == (200, "Ok.")
        command = await world.until_commanded()
        assert (command.command, command.param1, command.param2) == (400, 1.0, 0.5)
        assert math.isnan(command.param3)
        assert command.target_system == 1

    async def test_command_with_the_ids_of_the_vehicle_is_sent(self, world: World) -> None:
        """A gateway takes what bears its own id for a loop; and the telemetry must go on."""
        world.attitude(0.5)
        await world.until_json(f"{ATTITUDE}/message/roll", 0.5)
        header = {"system_id": 1, "component_id": 1, "sequence": 0}
        answer = await world.client.post("/v1/mavlink", json={**COMMAND, "header": header})
        assert answer.status_code == 200
        assert (await world.until_commanded()).get_srcSystem() == 253
        world.attitude(0.25)
        await world.until_json(f"{ATTITUDE}/message/roll", 0.25)

    @pytest.mark.parametrize(
        "body",
        [
            b"", b"[]", b"{}", b"[" * 100_000, b'{"message": {"type": "ATTITUDE"}}',
            json.dumps({"message": COMMAND["message"]}).encode(),
            json.dumps({**COMMAND, "header": {"system_id": 256}}).encode(),
        ],
        ids=["empty", "list", "object", "deep", "missing", "no header", "id"],
    )  # fmt: skip
    async def test_invalid_message_is_refused(self, world: World, body: bytes) -> None:
        pytest.importorskip("pyjson5", reason="older than the lock file: install it again")
        answer = await world.client.post("/v1/mavlink", content=body)
        assert answer.status_code == 404
        assert answer.text == "Failed to parse message, not a valid MAVLinkMessage."
        assert answer.headers["x-error-detail"].isprintable()
        assert not world.commands()

    async def test_invalid_field_is_named_in_a_header(self, world: World) -> None:
        body = {**COMMAND, "message": {**COMMAND["message"], "param1": "\r\nx: y"}}
        answer = await world.client.post("/v1/mavlink", json=body)
        assert "COMMAND_LONG.param1" in answer.headers["x-error-detail"]
        assert "x" not in answer.headers

    @pytest.mark.parametrize("prefix", ["", "/v1", "/mavlink2rest", "/mavlink2rest/v1"])
    async def test_every_prefix_serves_reading_and_a_command_without_target(
        self, world: World, prefix: str
    ) -> None:
        world.attitude(0.5)
        await world.until_json(f"{ATTITUDE}/message/roll", 0.5)
        path = ATTITUDE.removeprefix("/v1")
        answer = await world.client.get(f"{prefix}{path}/message/roll")
        assert answer.json() == 0.5
        assert (await world.client.get(f"{prefix}/info")).json()["service"]["name"] == "mavgate"
        fields = {k: v for k, v in COMMAND["message"].items() if not k.startswith("target_")}
        sent = await world.client.post(f"{prefix}/mavlink", json={**COMMAND, "message": fields})
        assert sent.status_code == 200
        command = await world.until_commanded()
        assert (command.target_system, command.target_component) == (0, 0)

    async def test_invalid_utf8_is_refused(self, world: World) -> None:
        answer = await world.client.post("/v1/mavlink", content=b"\xff")
        assert answer.status_code == 404
        assert answer.text.startswith("Failed to parse input as UTF-8 string: ")


class TestFollowing:
    async def test_filter_selects_messages_by_name(self, world: World) -> None:
        url = f"ws://{world.url}/v1/ws/mavlink?filter=ATT.*|HOME"
        async with websockets.connect(url) as stream:
            await self.until_followed(world, stream)
            world.send(mavlink.MAVLink_heartbeat_message(1, 0, 81, 0, 4, 3))
            world.attitude(0.5)
            while (got := json.loads(await stream.recv()))["message"]["roll"] != 0.5:
                assert got["message"]["type"] == "ATTITUDE"
            assert got["header"].keys() == {"system_id", "component_id", "sequence"}
            assert got["header"]["system_id"] == 1
            await stream.send(json.dumps(COMMAND))
            while not (answer := str(await stream.recv())).startswith("Ok("):
                assert "ATTITUDE" in answer
            assert (await world.until_commanded()).command == 400
            await stream.send("nonsense")
            assert str(await stream.recv()).startswith("Could not convert input message. ")
            await stream.send(b"\1\2")
            assert await stream.recv() == b"\1\2"

    async def test_filter_by_system_applies_to_both_directions(self, world: World) -> None:
        url = f"ws://{world.url}/v1/ws/mavlink?filter=ATTITUDE&systems="
        async with websockets.connect(url + "2") as other, websockets.connect(url + "1") as stream:
            await self.until_followed(world, stream)
            await stream.send(json.dumps(COMMAND))
            while not (answer := str(await stream.recv())).startswith("Ok("):
                assert "ATTITUDE" in answer
            assert (await world.until_commanded()).target_system == 1
            for target, command in ((1, COMMAND), (0, COMMAND)):
                message = command["message"] | {"target_system": target}
                await other.send(json.dumps(command | {"message": message}))
                # The first text that is received: no attitude of system 1 was sent before.
                assert "excludes its target" in str(await other.recv())
            assert len(world.commands()) == 1

    async def test_answers_and_requests_are_filtered_by_system(self, world: World) -> None:
        world.attitude(0.5)
        await world.until_json(f"{ATTITUDE}/message/roll", 0.5)
        for query, found in (
            ("systems=1", True),
            ("not-systems=1", False),
            ("components=9", False),
        ):
            tree = (await world.client.get(f"/v1/mavlink?{query}")).json()
            assert ("1" in tree["vehicles"]) == found
        wrong = await world.client.get("/v1/mavlink?systems=x")
        assert (wrong.status_code, "is not an id" in wrong.text) == (400, True)
        refused = await world.client.post("/v1/mavlink?systems=2", json=COMMAND)
        assert "excludes its target" in unquote(refused.headers["x-error-detail"])

    async def test_messages_of_cockpit_are_sent_and_answered(self, world: World) -> None:
        header = {"system_id": 255, "component_id": 240, "sequence": 0}
        sync = {"type": "TIMESYNC", "ts1": 8_015_700_000, "tc1": 0}
        zoom = {"type": "COMMAND_LONG", "target_component": 1, "confirmation": 0}
        sent = [
            sync | {"target_system": 1, "target_component": 1},
            zoom
            | {"command": {"type": "MAV_CMD_SET_CAMERA_ZOOM"}}
            | {f"param{number}": 0 for number in range(1, 8)},
        ]

        def heard() -> list[Any]:
            link = mavlink.MAVLink(None)
            messages = (link.decode(bytearray(incoming.frame)) for incoming in world.heard)
            return [m for m in messages if m.get_srcComponent() == 240]

        url = f"ws://{world.url}/mavlink2rest/ws/mavlink?filter=TIMESYNC"
        async with websockets.connect(url) as stream, asyncio.timeout(LIMIT_S):
            for message in sent:
                await stream.send(json.dumps({"header": header, "message": message}))
                assert str(await stream.recv()).startswith("Ok(")
            while len(heard()) < 2:
                await asyncio.sleep(0.01)
            assert heard()[0].ts1 == sync["ts1"]
            assert (heard()[1].command, heard()[1].target_system) == (531, 0)
            world.send(mavlink.MAVLink_timesync_message(7, sync["ts1"]))
            answer = json.loads(await stream.recv())
            assert answer["message"] == sync | {"tc1": 7}

    @staticmethod
    async def until_followed(world: World, stream: Any) -> None:
        async with asyncio.timeout(LIMIT_S):
            while True:
                world.attitude(-1.0)
                with suppress(TimeoutError):
                    await asyncio.wait_for(stream.recv(), 0.05)
                    return

    @pytest.mark.parametrize(
        ("pattern", "word"),
        [
            ("(", "unclosed"),
            ("A" * 301, "300"),
            ("A{9}", "without {}"),
            ("\\w", "without"),
            ("(?=A)", "look-around"),
        ],
    )
    async def test_invalid_filter_is_refused(self, world: World, pattern: str, word: str) -> None:
        async with websockets.connect(f"ws://{world.url}/v1/ws/mavlink?filter={pattern}") as stream:
            assert word in json.loads(await stream.recv())["error"]
            with pytest.raises(websockets.ConnectionClosed):
                await stream.recv()

    def test_expression_that_backtracks_exponentially_in_python_is_matched(self) -> None:
        assert names_matching("(.+)+-") == frozenset()
        assert names_matching("^(ATTITUDE|HEARTBEAT)$") == {"ATTITUDE", "HEARTBEAT"}

    async def test_queue_of_a_subscriber_is_bounded_in_bytes(self) -> None:
        slow = Subscriber(set(), NO_FILTER)
        for size in (MAX_WAITING_BYTES, MAX_WAITING_BYTES // 2, 10, MAX_WAITING_BYTES + 1, 20):
            slow.push(bytes(size))
        assert slow.dropped == 4
        assert await slow.next() == bytes(20)


class TestGuards:
    @pytest.mark.parametrize("who", ["viewer", "nobody"])
    async def test_only_operators_may_send(self, tmp_path: Path, password: str, who: str) -> None:
        settings = PanelSettings(password=hash_password("other"), viewer_password=password)
        async with open_world(tmp_path, settings) as world:
            if who == "viewer":
                await world.client.post("/login", data={"password": "secret"})
            answer = await world.client.post("/v1/mavlink", json=COMMAND)
            assert answer.status_code == (403 if who == "viewer" else 401)
            answer = await world.client.get("/v1/mavlink")
            assert answer.status_code == (200 if who == "viewer" else 401)
            assert not world.commands()
            await world.client.post("/login", data={"password": "other"})
            assert (await world.client.post("/v1/mavlink", json=COMMAND)).status_code == 200

    async def test_viewer_that_sends_is_disconnected_and_logout_ends_a_websocket(
        self, tmp_path: Path, password: str
    ) -> None:
        settings = PanelSettings(password=hash_password("other"), viewer_password=password)
        async with open_world(tmp_path, settings) as world:

            def opened() -> Any:
                cookie = f"{COOKIE}={world.client.cookies[COOKIE]}"
                url = f"ws://{world.url}/v1/ws/mavlink?filter=NONE"
                return websockets.connect(url, additional_headers={"Cookie": cookie})

            await world.client.post("/login", data={"password": "secret"})
            async with opened() as stream:
                await stream.send(b"x" * 1000)
                with pytest.raises(websockets.ConnectionClosed, match="viewers may not send"):
                    await stream.recv()
            await world.client.post("/login", data={"password": "other"})
            async with opened() as stream:
                await world.client.post("/logout")
                with pytest.raises(websockets.ConnectionClosed, match="logged out"):
                    await stream.recv()
            assert not world.commands()

    @pytest.mark.parametrize(("digits", "status"), [(4000, 404), (5000, 404), (30, 200)])
    @pytest.mark.parametrize("field", ["param1", "target_system"])
    async def test_number_of_thousands_of_digits_is_rejected(
        self, world: World, digits: int, status: int, field: str
    ) -> None:
        text = re.sub(rf'("{field}"): 1(\.0)?', rf"\1: {'1' * digits}", json.dumps(COMMAND))
        answer = await world.client.post("/v1/mavlink", content=text)
        assert answer.status_code == (404 if field == "target_system" else status)
        assert len(answer.text) < 400
