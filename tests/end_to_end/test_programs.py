"""The programs of docs/programs.md, run unchanged on processes of a gateway and its panel.

The JSON of the WebSocket API is also compared with the messages that UDP clients decode.
"""

import json
import math
import re
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink
from websockets.sync.client import connect as follow

from gateway.wire.mavlink_json import template
from tests.end_to_end.processes import EXPECTED, HOME, NEAR_DEG, STEEPEST_DEG, Client, Gateway
from tests.kit.process import START_LIMIT_S, Process
from tests.ports import free_port
from tests.wire.test_mavlink_json import as_pymavlink_reads

pytestmark = [pytest.mark.io, pytest.mark.slow]

PROGRAMS = Path(__file__).resolve().parents[2] / "docs" / "programs.md"
CONFIG = """
[hub]
endpoints = [
    "udp:127.0.0.1:{{port}}", "udp-listen:127.0.0.1:{{listen}}", "ws-listen:127.0.0.1:{web}",
]
[simulator]
gps_first_fix_s = 0.5
"""
REQUEST_INTERVAL_S = 5.0
ASKED = {"PARAM_VALUE", "AUTOPILOT_VERSION", "MISSION_COUNT", "COMMAND_ACK"}


@dataclass
class Apis:
    """A gateway with its panel, a station that receives it, and the addresses of its APIs."""

    station: Client
    udp: str
    web: str
    panel: str


@pytest.fixture(scope="module")
def apis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Apis]:
    """Start both once for all tests: each start takes seconds, and no test changes them."""
    folder, panel_folder = tmp_path_factory.mktemp("gateway"), tmp_path_factory.mktemp("panel")
    web = free_port()
    gateway = Gateway(folder, "demo", config=CONFIG.format(web=web))
    station = Client(gateway.port)
    connect = ("--connect", f"udp:127.0.0.1:{gateway.listen_port}")
    try:
        station.until(lambda seen: "GLOBAL_POSITION_INT" in seen)
        with Process(panel_folder, "panel", "--tcp-port", "0", *connect, config="") as panel:
            address = panel.link().partition("//")[2].rstrip("/")
            yield Apis(station, connect[1].removeprefix("udp:"), f"127.0.0.1:{web}", address)
    finally:
        station.sock.close()
        gateway.end()


def requests() -> list[dict[str, Any]]:
    """Return a ground station's first requests, and one that is refused with a text to all."""
    header = {"system_id": 255, "component_id": 0, "sequence": 0}
    target = {"target_system": 1, "target_component": 1}
    version = {"command": {"type": "MAV_CMD_REQUEST_MESSAGE"}, "param1": 148.0}
    messages = [
        {**template("PARAM_REQUEST_LIST"), **target},
        {**template("MISSION_REQUEST_LIST"), **target},
        {**template("COMMAND_LONG"), **target, **version},
        {**template("COMMAND_LONG"), **target, "command": {"type": "MAV_CMD_COMPONENT_ARM_DISARM"}},
    ]
    return [{"header": header, "message": message} for message in messages]


class UdpReader:
    """The messages that a UDP client decodes, in the form of the API."""

    def __init__(self, client: Client) -> None:
        self._sock = client.sock
        self._reader = mavlink.MAVLink(None)
        self.decoded: set[str] = set()

    def read(self, wait_s: float) -> None:
        """Decode the received messages; return after a gap of that length."""
        self._sock.settimeout(wait_s)
        with suppress(TimeoutError, BlockingIOError):
            for _ in range(500):
                for message in self._reader.parse_buffer(self._sock.recv(65_536)) or []:
                    self.decoded.add(json.dumps(as_pymavlink_reads(message)))


def receive_all(stream: Any, reader: UdpReader) -> dict[str, list[dict[str, Any]]]:
    """Receive from the vehicle until every kind of message has come; request again what is lost."""
    received: dict[str, list[dict[str, Any]]] = {}
    begin_s, next_s = time.monotonic(), 0.0
    while missing := (EXPECTED | ASKED) - received.keys():
        now_s = time.monotonic()
        assert now_s < begin_s + START_LIMIT_S, missing
        if now_s >= next_s:
            next_s = now_s + REQUEST_INTERVAL_S
            for request in requests():
                stream.send(json.dumps(request))
        text = str(stream.recv(timeout=START_LIMIT_S))
        reader.read(0)
        if text.startswith("{"):
            frame = json.loads(text)
            if frame["header"]["system_id"] == 1:
                received.setdefault(frame["message"]["type"], []).append(frame["message"])
    return received


def test_json_equals_messages_of_pymavlink(apis: Apis) -> None:
    reader = UdpReader(apis.station)
    reader.read(0)
    with follow(f"ws://{apis.panel}/v1/ws/mavlink") as stream:
        received = receive_all(stream, reader)
    path = "/v1/mavlink/vehicles/1/components/1/messages/PARAM_VALUE/message/param_count"
    with urllib.request.urlopen(f"http://{apis.panel}{path}") as answer:
        count = json.load(answer)
    assert count == received["PARAM_VALUE"][0]["param_count"]
    to_one_client = ASKED | {"HOME_POSITION", "TIMESYNC", "PING"}
    compared = [fields for kind in received.keys() - to_one_client for fields in received[kind]]
    assert len(compared) > len(EXPECTED)
    # The latest messages may still be on their way to the other client.
    deadline_s = time.monotonic() + START_LIMIT_S
    while missing := [fields for fields in compared if json.dumps(fields) not in reader.decoded]:
        assert time.monotonic() < deadline_s, missing
        reader.read(0.5)


def block(heading: str, apis: Apis) -> str:
    """Return the code below a heading, with the ports of this test."""
    section = re.search(rf"^## {heading}\n(.*?)^## ", PROGRAMS.read_text(), re.M | re.S)
    assert section is not None
    code = "\n".join(re.findall(r"^```\w+\n(.*?)^```$", section[1], re.M | re.S))
    addresses = {"14551": apis.udp, "56781": apis.web, "14590": apis.panel}
    for port, ours in addresses.items():
        code = code.replace(f"127.0.0.1:{port}", ours)
    return code


def run_until(code: str, pattern: str) -> re.Match[str]:
    """Run Python until it prints what a pattern finds."""
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    limit = threading.Timer(START_LIMIT_S, process.kill)
    limit.start()
    printed = ""
    try:
        assert process.stdout is not None
        for line in process.stdout:
            printed += line
            if found := re.search(pattern, line):
                return found
    finally:
        limit.cancel()
        process.kill()
        process.communicate()
    raise AssertionError(f"no {pattern!r} in:\n{printed}")


def test_mavsdk_program_prints_home_position(apis: Apis) -> None:
    position = run_until(block("MAVSDK", apis), r"^(-?\d+\.\d+) (-?\d+\.\d+) (-?\d+\.\d+)$")
    assert float(position[1]) == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert float(position[2]) == pytest.approx(HOME.home_lon_deg, abs=NEAR_DEG)


def test_pymavlink_program_prints_parameter(apis: Apis) -> None:
    assert run_until(block("pymavlink", apis), r"PARAM_VALUE {param_id : PAPER_ACC_CUTOFF,")


@pytest.mark.skipif(shutil.which("curl") is None, reason="there is no curl on this machine")
def test_curl_commands_get_attitude_and_send_command(apis: Apis, tmp_path: Path) -> None:
    script = "set -e\n" + block("curl", apis).replace("curl ", "curl --fail-with-body -sS ")
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    attitude, end = json.JSONDecoder().raw_decode(done.stdout)
    assert attitude["message"]["type"] == "ATTITUDE"
    rest = re.fullmatch(r"(\S+)Ok\.", done.stdout[end:])
    assert rest is not None
    assert abs(float(rest[1])) < math.radians(STEEPEST_DEG)
    asked = json.loads((tmp_path / "command.json").read_text())["message"]
    assert asked["command"] == {"type": "MAV_CMD_REQUEST_MESSAGE"}
    messages = f"http://{apis.panel}/v1/mavlink/vehicles/1/components/1/messages"
    url = f"{messages}/AUTOPILOT_VERSION/message/type"
    deadline_s = time.monotonic() + START_LIMIT_S
    while urllib.request.urlopen(url).read() != b'"AUTOPILOT_VERSION"':
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
