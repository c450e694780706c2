"""The gateway and its panel as processes: what scripts read is what UDP clients decode."""

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink
from websockets.sync.client import connect as follow

from gateway.panel.doors.message_json import template
from tests.end_to_end.processes import START_LIMIT_S, Client, Gateway
from tests.end_to_end.test_demo import EXPECTED
from tests.panel.doors.test_message_json import as_pymavlink_tells

pytestmark = [pytest.mark.io, pytest.mark.slow]

ASKED = {"PARAM_VALUE", "AUTOPILOT_VERSION", "MISSION_COUNT", "COMMAND_ACK"}


@contextmanager
def panel(listen_port: int, folder: Path) -> Iterator[str]:
    """Start the panel's process; yield its host and port."""
    command = [
        *(sys.executable, "-m", "gateway.cli", "panel", "--port", "0"),
        *("--connect", f"udp:127.0.0.1:{listen_port}"),
    ]
    env = os.environ | {"HOME": str(folder), "XDG_RUNTIME_DIR": str(folder)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=env, text=True)
    try:
        assert process.stdout is not None
        link = next(line for line in process.stdout if "http://" in line)
        yield link.split("http://")[1].strip().rstrip("/")
    finally:
        process.terminate()
        process.wait(10)
        process.stdout.close()


def requests() -> list[dict[str, Any]]:
    """Return what a ground station asks at first."""
    header = {"system_id": 255, "component_id": 0, "sequence": 0}
    target = {"target_system": 1, "target_component": 1}
    version = {"command": {"type": "MAV_CMD_REQUEST_MESSAGE"}, "param1": 148.0}
    messages = [
        {**template("PARAM_REQUEST_LIST"), **target},
        {**template("MISSION_REQUEST_LIST"), **target},
        {**template("COMMAND_LONG"), **target, **version},
    ]
    return [{"header": header, "message": message} for message in messages]


class Ear:
    """What a UDP client decodes, in the form that the door gives."""

    def __init__(self, client: Client) -> None:
        self._sock = client.sock
        self._reader = mavlink.MAVLink(None)
        self.decoded: set[str] = set()

    def read(self, wait_s: float) -> None:
        """Take what there is; return once nothing comes for so long."""
        self._sock.settimeout(wait_s)
        with suppress(TimeoutError, BlockingIOError):
            for _ in range(500):
                for message in self._reader.parse_buffer(self._sock.recv(65_536)) or []:
                    self.decoded.add(json.dumps(as_pymavlink_tells(message)))


def hear(stream: Any, ear: Ear) -> dict[str, list[dict[str, Any]]]:
    """Follow the vehicle until every kind of message has come."""
    told: dict[str, list[dict[str, Any]]] = {}
    while not told.keys() >= EXPECTED | ASKED:
        text = str(stream.recv(timeout=START_LIMIT_S))
        ear.read(0)
        if text.startswith("{"):
            heard = json.loads(text)
            if heard["header"]["system_id"] == 1:
                told.setdefault(heard["message"]["type"], []).append(heard["message"])
    return told


def test_json_is_what_pymavlink_reads(
    start_gateway: Callable[..., Gateway], connect: Callable[..., Client], tmp_path: Path
) -> None:
    gateway = start_gateway("demo")
    station = connect(gateway.port)
    station.until(lambda seen: "ATTITUDE" in seen)
    ear = Ear(station)
    with (
        panel(gateway.listen_port, tmp_path) as place,
        follow(f"ws://{place}/v1/ws/mavlink") as stream,
    ):
        for request in requests():
            stream.send(json.dumps(request))
        told = hear(stream, ear)
        path = "/v1/mavlink/vehicles/1/components/1/messages/PARAM_VALUE/message/param_count"
        with urllib.request.urlopen(f"http://{place}{path}") as answer:
            count = json.load(answer)
    # What was said in the last moment may be on its way to the other client.
    ear.read(0.5)
    assert count == told["PARAM_VALUE"][0]["param_count"]
    to_one_client = ASKED | {"HOME_POSITION", "TIMESYNC", "PING"}
    compared = [fields for kind in told.keys() - to_one_client for fields in told[kind]]
    assert len(compared) > len(EXPECTED)
    assert [fields for fields in compared if json.dumps(fields) not in ear.decoded] == []
