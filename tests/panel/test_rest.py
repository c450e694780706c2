"""The REST API as scripts use it: a server, a hub with a vehicle, and HTTP between them."""

import asyncio
import gc
import json
import math
import re
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from itertools import product
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
from gateway.hub.systems import NO_FILTER
from gateway.panel.access import COOKIE, AccessControl
from gateway.panel.logins import Logins
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.rest_api import MAX_WAITING_BYTES, RestApi, Subscriber, names_matching
from gateway.panel.state.fleet import FleetState
from gateway.panel.uplink import ControlClient, Uplink
from gateway.wire.mavlink_json import template
from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S as LIMIT_S
from tests.kit.process import until
from tests.panel.web_client import OPERATOR, VIEWER

pytestmark = pytest.mark.io

HEADER = {"system_id": 255, "component_id": 0, "sequence": 0}
ATTITUDE = "/v1/mavlink/vehicles/1/components/1/messages/ATTITUDE"


@dataclass
class World:
    """A vehicle behind a hub, and the panel's server that hears it."""

    rig: Rig
    hub: Hub
    url: str
    client: httpx.AsyncClient

    def send(self, message: Any) -> None:
        self.rig.publish(self.hub, self.rig.vehicle.pack(message))

    def attitude(self, roll: float) -> None:
        self.send(mavlink.MAVLink_attitude_message(5, roll, 0.25, 0, 0, 0, 0))

    async def until_attitude(self, roll: float) -> None:
        """Send an attitude, and wait until it is read."""
        self.attitude(roll)
        await self.until_json(f"{ATTITUDE}/message/roll", roll)

    async def until_json(self, path: str, value: Any) -> None:
        async with asyncio.timeout(LIMIT_S):
            while (answer := await self.client.get(path)).text != json.dumps(value):
                assert answer.status_code in (200, 404)
                await asyncio.sleep(0.01)

    def messages(self) -> list[Any]:
        """Return the messages that the vehicle has received."""
        link = mavlink.MAVLink(None)
        return [link.decode(bytearray(incoming.frame)) for incoming in self.rig.incoming]

    def commands(self) -> list[Any]:
        return [message for message in self.messages() if message.get_type() == "COMMAND_LONG"]

    async def until_commanded(self) -> Any:
        await until(self.commands, 0.01)
        return self.commands()[-1]


@asynccontextmanager
async def open_world(folder: Path, settings: PanelSettings) -> AsyncIterator[World]:
    rig = Rig()
    hub = rig.hub("udp-listen:127.0.0.1:0")
    gateway, control = f"udp:127.0.0.1:{hub.listening_ports()[0]}", ControlClient(folder / "none")
    uplink = Uplink(gateway, FleetState(), control, GatewayClock())
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
        world = World(rig, hub, url, client)
        world.send(mavlink.MAVLink_heartbeat_message(1, 0, 81, 0, 4, 3))
        await until(hub.clients, 0.01)
        yield world
    server.should_exit = True
    await serving
    uplink.close()
    rig.close()


@pytest.fixture
async def world(tmp_path: Path) -> AsyncIterator[World]:
    async with open_world(tmp_path, PanelSettings()) as world:
        yield world


class TestReading:
    async def test_message_fields_and_status_are_read(self, world: World) -> None:
        await world.until_attitude(0.5)
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
        assert answer["header"] == HEADER
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
    "header": HEADER,
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


INVALID = "Failed to parse message, not a valid MAVLinkMessage."


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
        await world.until_attitude(0.5)
        header = HEADER | {"system_id": 1, "component_id": 1}
        answer = await world.client.post("/v1/mavlink", json=COMMAND | {"header": header})
        assert answer.status_code == 200
        assert (await world.until_commanded()).get_srcSystem() == 253
        await world.until_attitude(0.25)

    async def test_invalid_message_is_refused(self, world: World) -> None:
        pytest.importorskip("pyjson5", reason="older than the lock file: install it again")
        no_header, wrong_id = {"message": COMMAND["message"]}, {"header": {"system_id": 256}}
        for body in (
            *(b"", b"[]", b"{}", b"[" * 100_000, b'{"message": {"type": "ATTITUDE"}}', b"\xff"),
            *(json.dumps(content).encode() for content in (no_header, COMMAND | wrong_id)),
        ):
            answer = await world.client.post("/v1/mavlink", content=body)
            text = "Failed to parse input as UTF-8 string: " if body == b"\xff" else INVALID
            assert (answer.status_code, answer.text[: len(text)]) == (404, text), body[:80]
            assert answer.headers.get("x-error-detail", "").isprintable(), body[:80]
        assert not world.commands()

    async def test_invalid_field_is_named_in_a_header(self, world: World) -> None:
        body = COMMAND | {"message": COMMAND["message"] | {"param1": "\r\nx: y"}}
        answer = await world.client.post("/v1/mavlink", json=body)
        assert "COMMAND_LONG.param1" in answer.headers["x-error-detail"]
        assert "x" not in answer.headers

    async def test_prefixes_serve_reading_and_commands(self, world: World) -> None:
        await world.until_attitude(0.5)
        path = ATTITUDE.removeprefix("/v1")
        fields = {k: v for k, v in COMMAND["message"].items() if not k.startswith("target_")}
        prefixes = ("", "/v1", "/mavlink2rest", "/mavlink2rest/v1")
        for prefix in prefixes:
            answer = await world.client.get(f"{prefix}{path}/message/roll")
            assert answer.json() == 0.5, prefix
            info = (await world.client.get(f"{prefix}/info")).json()
            assert info["service"]["name"] == "mavgate", prefix
            sent = await world.client.post(f"{prefix}/mavlink", json={**COMMAND, "message": fields})
            assert sent.status_code == 200, prefix
        await until(lambda: len(world.commands()) == len(prefixes), 0.01)
        assert {(m.target_system, m.target_component) for m in world.commands()} == {(0, 0)}


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
            await self.command_sent(stream)
            assert (await world.until_commanded()).command == 400
            await stream.send("nonsense")
            assert str(await stream.recv()).startswith("Could not convert input message. ")
            await stream.send(b"\1\2")
            assert await stream.recv() == b"\1\2"

    async def test_filter_by_system_applies_to_both_directions(self, world: World) -> None:
        url = f"ws://{world.url}/v1/ws/mavlink?filter=ATTITUDE&systems="
        async with websockets.connect(url + "2") as other, websockets.connect(url + "1") as stream:
            await self.until_followed(world, stream)
            await self.command_sent(stream)
            assert (await world.until_commanded()).target_system == 1
            for target in (1, 0):
                message = COMMAND["message"] | {"target_system": target}
                await other.send(json.dumps(COMMAND | {"message": message}))
                # The first text that is received: no attitude of system 1 was sent before.
                assert "components= excludes" in str(await other.recv())
            assert len(world.commands()) == 1

    async def test_answers_and_requests_are_filtered_by_system(self, world: World) -> None:
        await world.until_attitude(0.5)
        queries = {"systems=1": True, "not-systems=1": False, "components=9": False}
        for query, found in queries.items():
            tree = (await world.client.get(f"/v1/mavlink?{query}")).json()
            assert ("1" in tree["vehicles"]) == found
        wrong = await world.client.get("/v1/mavlink?systems=x")
        assert (wrong.status_code, "is not an id" in wrong.text) == (400, True)
        refused = await world.client.post("/v1/mavlink?systems=2", json=COMMAND)
        assert "components= excludes" in unquote(refused.headers["x-error-detail"])

    async def test_messages_of_cockpit_are_sent_and_answered(self, world: World) -> None:
        sync = {"type": "TIMESYNC", "ts1": 8_015_700_000, "tc1": 0}
        zoom = {"type": "COMMAND_LONG", "target_component": 1, "confirmation": 0}
        zoom |= {"command": {"type": "MAV_CMD_SET_CAMERA_ZOOM"}}
        sent = [
            sync | {"target_system": 1, "target_component": 1},
            zoom | {f"param{number}": 0 for number in range(1, 8)},
        ]

        def heard() -> list[Any]:
            return [m for m in world.messages() if m.get_srcComponent() == 240]

        url = f"ws://{world.url}/mavlink2rest/ws/mavlink?filter=TIMESYNC"
        async with websockets.connect(url) as stream, asyncio.timeout(LIMIT_S):
            for message in sent:
                header = HEADER | {"component_id": 240}
                await stream.send(json.dumps({"header": header, "message": message}))
                assert str(await stream.recv()).startswith("Ok(")
            await until(lambda: len(heard()) == 2, 0.01)
            assert heard()[0].ts1 == sync["ts1"]
            assert (heard()[1].command, heard()[1].target_system) == (531, 0)
            world.send(mavlink.MAVLink_timesync_message(7, sync["ts1"]))
            answer = json.loads(await stream.recv())
            assert answer["message"] == sync | {"tc1": 7}

    @staticmethod
    async def command_sent(stream: Any) -> None:
        await stream.send(json.dumps(COMMAND))
        while not (answer := str(await stream.recv())).startswith("Ok("):
            assert "ATTITUDE" in answer

    @staticmethod
    async def until_followed(world: World, stream: Any) -> None:
        async with asyncio.timeout(LIMIT_S):
            while True:
                world.attitude(-1.0)
                with suppress(TimeoutError):
                    await asyncio.wait_for(stream.recv(), 0.05)
                    return

    async def test_queue_of_a_client_that_leaves_is_freed(self, world: World) -> None:
        def queues() -> int:
            gc.collect()
            return sum(type(each) is Subscriber for each in gc.get_objects())

        async with websockets.connect(f"ws://{world.url}/v1/ws/mavlink") as stream:
            await self.until_followed(world, stream)
            assert queues() == 1
        await until(lambda: not queues(), 0.05)

    async def test_invalid_filter_is_refused(self, world: World) -> None:
        words = {"(": "unclosed", "A" * 301: "300", "A{9}": "without {}", "\\w": "without"}
        for pattern, word in (words | {"(?=A)": "look-around"}).items():
            url = f"ws://{world.url}/v1/ws/mavlink?filter={pattern}"
            async with websockets.connect(url) as stream:
                assert word in json.loads(await stream.recv())["error"], pattern
                with pytest.raises(websockets.ConnectionClosed, match="1007"):
                    await stream.recv()

    def test_expression_that_backtracks_exponentially_in_python_is_matched(self) -> None:
        assert names_matching("(.+)+-") == frozenset()
        assert names_matching("^(ATTITUDE|HEARTBEAT)$") == {"ATTITUDE", "HEARTBEAT"}

    async def test_queue_of_a_subscriber_is_bounded_in_bytes(self) -> None:
        slow = Subscriber(set(), NO_FILTER)
        for size in (MAX_WAITING_BYTES, MAX_WAITING_BYTES // 2, 10, MAX_WAITING_BYTES + 1, 20):
            slow.push(bytes(size))
        assert await slow.next() == bytes(20)


class TestGuards:
    async def test_only_operators_may_send_until_they_log_out(self, tmp_path: Path) -> None:
        settings = PanelSettings(password=OPERATOR, viewer_password=VIEWER)
        async with open_world(tmp_path, settings) as world:
            client = world.client

            def opened() -> Any:
                cookie = f"{COOKIE}={client.cookies[COOKIE]}"
                url = f"ws://{world.url}/v1/ws/mavlink?filter=NONE"
                return websockets.connect(url, additional_headers={"Cookie": cookie})

            async def statuses() -> tuple[int, int]:
                answers = (client.get("/v1/mavlink"), client.post("/v1/mavlink", json=COMMAND))
                reading, sending = [(await answer).status_code for answer in answers]
                return reading, sending

            assert await statuses() == (401, 401), "without a login"
            await client.post("/login", data={"password": "guest"})
            assert await statuses() == (200, 403), "as a viewer"
            async with opened() as stream:
                await stream.send(b"x" * 1000)
                with pytest.raises(websockets.ConnectionClosed, match="viewers may not send"):
                    await stream.recv()
            assert not world.commands()
            await client.post("/login", data={"password": "tower"})
            assert await statuses() == (200, 200), "as an operator"
            async with opened() as stream:
                await client.post("/logout")
                with pytest.raises(websockets.ConnectionClosed, match="logged out"):
                    await stream.recv()

    async def test_number_of_thousands_of_digits_is_rejected(self, world: World) -> None:
        for field, digits in product(("param1", "target_system"), (4000, 5000, 30)):
            text = re.sub(rf'("{field}"): 1(\.0)?', rf"\1: {'1' * digits}", json.dumps(COMMAND))
            answer = await world.client.post("/v1/mavlink", content=text)
            is_valid = (field, digits) == ("param1", 30)
            assert answer.status_code == (200 if is_valid else 404), (field, digits)
            assert len(answer.text) < 400, (field, digits)
