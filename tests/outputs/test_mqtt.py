"""MQTT with a real broker, mosquitto."""

import asyncio
import getpass
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from gateway.outputs import mqtt
from gateway.outputs.mqtt import MAX_WAITING
from gateway.units import US_PER_S
from tests.kit.messages import at, beat, gps
from tests.kit.process import START_LIMIT_S, running, until
from tests.outputs.conftest import OutputRig
from tests.ports import free_ports

pytestmark = [
    pytest.mark.io,
    pytest.mark.skipif(shutil.which("mosquitto") is None, reason="needs mosquitto"),
]


ANSWER = b"\x20\x02\x00\x00"
"""The broker's answer to a connection."""


class Mosquitto:
    """A broker with a plain and a TLS port, and a subscriber to everything."""

    def __init__(self, folder: Path, certificate: Path) -> None:
        self.port, self.tls_port = free_ports(2)
        self.login = folder / "login"
        self.login.write_text("pilot:top secret\n")
        passwords, settings = folder / "passwords", folder / "mosquitto.conf"
        subprocess.run(
            ["mosquitto_passwd", "-b", "-c", passwords, "pilot", "top secret"], check=True
        )
        own = folder / "certificate.pem"
        own.write_bytes(certificate.read_bytes())
        settings.write_text(
            f"listener {self.port} 127.0.0.1\nlistener {self.tls_port} 127.0.0.1\n"
            f"certfile {own}\nkeyfile {own}\npassword_file {passwords}\nallow_anonymous false\n"
            # Another user could not read these files; this one need not be root.
            f"user {getpass.getuser()}\n"
        )
        self.words = "mosquitto", "-c", settings

    async def subscriber(self) -> aiomqtt.Client:
        client = aiomqtt.Client("127.0.0.1", self.port, username="pilot", password="top secret")
        await client.__aenter__()
        await client.subscribe("#")
        return client

    def listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0


@pytest.fixture
async def broker(tmp_path: Path, certificate: Path) -> AsyncIterator[Mosquitto]:
    made = Mosquitto(tmp_path, certificate)
    with running(*made.words):
        await until(made.listens, 0.01)
        yield made


async def next_of(client: aiomqtt.Client) -> tuple[str, Any, bool]:
    """Return topic and text of the next message, and whether it was retained."""
    async with asyncio.timeout(START_LIMIT_S):
        message = await anext(aiter(client.messages))
    data = message.payload.decode()
    return str(message.topic), json.loads(data) if "{" in data else data, message.retain


@pytest.mark.parametrize("is_tls", [False, True])
async def test_messages_of_all_systems_have_topics(
    outputs: OutputRig, broker: Mosquitto, certificate: Path, *, is_tls: bool
) -> None:
    client = await broker.subscriber()
    where = f"tls:127.0.0.1:{broker.tls_port}" if is_tls else f"tcp:127.0.0.1:{broker.port}"
    await outputs.output(f"mqtt:{where}?login={broker.login}&authority={certificate}")
    assert outputs.shown.state == "open", outputs.shown.reason
    assert await next_of(client) == ("mavgate/status", "online", False)
    for seconds in (0.0, 0.5, 1.0):
        outputs.clock.now_us = round(seconds * US_PER_S)
        for system in (1, 255):
            outputs.hear(at(), system=system)
    for _ in range(2):
        for system in (1, 255):
            topic, found, _ = await next_of(client)
            assert topic == f"mavgate/{system}/GLOBAL_POSITION_INT"
            assert found["header"]["system_id"] == system
            assert found["message"]["type"] == "GLOBAL_POSITION_INT"
            assert found["message"]["lat"] == 473977420
    assert outputs.shown.sent == 4
    outputs.close()
    assert await next_of(client) == ("mavgate/status", "offline", False)
    await client.__aexit__(None, None, None)


async def test_presence_is_retained_and_the_last_will_ends_it(
    outputs: OutputRig, broker: Mosquitto
) -> None:
    options = f"login={broker.login}&topic=field/7&deny=HEARTBEAT"
    output = await outputs.output(f"mqtt:tcp:127.0.0.1:{broker.port}?{options}")
    client = await broker.subscriber()
    assert await next_of(client) == ("field/7/status", "online", True)
    outputs.hear(beat(), at())
    assert (await next_of(client))[0] == "field/7/1/GLOBAL_POSITION_INT"
    # As when the gateway is killed: the socket closes without a farewell.
    output.carrier.client._client.socket().shutdown(socket.SHUT_RDWR)
    assert await next_of(client) == ("field/7/status", "offline", False)
    await outputs.until(lambda: outputs.shown.state == "unreachable")
    outputs.tick(outputs.of_hub, 2)
    assert await next_of(client) == ("field/7/status", "online", False)
    await client.__aexit__(None, None, None)


async def test_wrong_password_is_reported(
    outputs: OutputRig, broker: Mosquitto, tmp_path: Path
) -> None:
    wrong = tmp_path / "wrong"
    wrong.write_text("pilot:guess")
    await outputs.output(f"mqtt:tcp:127.0.0.1:{broker.port}?login={wrong}")
    assert outputs.shown.state == "unreachable"
    assert "Not authorized" in outputs.shown.reason


async def test_messages_are_dropped_while_the_broker_is_slow(
    outputs: OutputRig, broker: Mosquitto
) -> None:
    await outputs.output(f"mqtt:tcp:127.0.0.1:{broker.port}?login={broker.login}")
    for system in range(1, 255):
        outputs.hear(beat(), at(), gps(), system=system)
    assert (outputs.shown.sent, outputs.shown.dropped) == (MAX_WAITING, 3 * 254 - MAX_WAITING)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        pytest.param(b"\x20\xff\xff\xff\x7f", "packet of 268435455", id="256 MB, no answer"),
        pytest.param(ANSWER + b"\x30\xff\xff\xff\x7f", "packet of 268435455", id="256 MB"),
        pytest.param(ANSWER + b"\x34\x06\x00\x01x\x00\x01", "packet of 6", id="a message"),
    ],
)
async def test_packet_that_is_no_answer_ends_the_connection(
    outputs: OutputRig, data: bytes, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt, "CONNECT_LIMIT_S", 0.05)
    has_ended = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(data + bytes(1000))
        with suppress(ConnectionError):
            await reader.read()
        has_ended.set()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        await outputs.output(f"mqtt:tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}")
        await has_ended.wait()
    await outputs.until(lambda: why in outputs.shown.reason)


async def test_missing_extra_is_reported(
    outputs: OutputRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    await outputs.output("mqtt:tcp:127.0.0.1:1")
    assert "needs the extra mqtt" in outputs.shown.reason
