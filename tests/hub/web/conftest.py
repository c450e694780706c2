"""Programs that speak WebSocket to a hub, and a certificate of this machine."""

import asyncio
import socket
import ssl
import subprocess
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, Event, Ping, Request

from gateway.hub.hub import Hub
from gateway.wire.mavlink_splitter import MavlinkSplitter
from tests.kit.hub import Rig, receive
from tests.kit.mavlink import frames_of
from tests.kit.process import START_LIMIT_S


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a PEM file with a certificate of 127.0.0.1 and its key."""
    folder = tmp_path_factory.mktemp("tls")
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"),
            *("-nodes", "-days", "30", "-subj", "/CN=mavgate", "-keyout", key, "-out", certificate),
            *("-addext", "subjectAltName=IP:127.0.0.1"),
        ],
        check=True,
        capture_output=True,
    )
    certificate.write_text(certificate.read_text() + key.read_text())
    return certificate


class Page:
    """A program at the other end, reading and writing without blocking the loop."""

    def __init__(self) -> None:
        self.web = WSConnection(ConnectionType.CLIENT)
        self.splitter = MavlinkSplitter()
        self.events: list[Event] = []
        self.messages: list[bytes] = []
        self.answers_pings = True
        self.writer: asyncio.StreamWriter | None = None

    async def connect(
        self, port: int, origin: str = "", tls: ssl.SSLContext | None = None
    ) -> "Page":
        self.reader, self.writer = await asyncio.open_connection(
            "127.0.0.1", port, ssl=tls, server_hostname="127.0.0.1" if tls else None
        )
        headers = [(b"Origin", origin.encode())] if origin else []
        self.writer.write(
            self.web.send(Request(host=f"127.0.0.1:{port}", target="/", extra_headers=headers))
        )
        await self.until(lambda: bool(self.events))
        return self

    @property
    def is_open(self) -> bool:
        return isinstance(self.events[0], AcceptConnection)

    async def take(self) -> bool:
        """Take the next bytes; return whether there were any before the end."""
        try:
            data = await asyncio.wait_for(self.reader.read(65536), START_LIMIT_S)
        except ConnectionError:
            # The hub closed while something of ours was still unread.
            return False
        if not data:
            return False
        self.web.receive_data(data)
        for event in self.web.events():
            self.events.append(event)
            if isinstance(event, BytesMessage):
                self.messages.append(bytes(event.data))
            elif isinstance(event, Ping) and self.answers_pings:
                self.writer.write(self.web.send(event.response()))
        return True

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(START_LIMIT_S):
            while not condition():
                assert await self.take()

    async def frames(self, count: int) -> list[bytes]:
        """Read until so many messages have come; return their frames."""
        await self.until(lambda: len(self.messages) >= count)
        return [frame for event in self.messages for frame in frames_of(self.splitter.feed(event))]

    async def end(self) -> None:
        """Read until the server has closed."""
        async with asyncio.timeout(START_LIMIT_S):
            while await self.take():
                pass

    def send(self, data: bytes) -> None:
        self.writer.write(self.web.send(BytesMessage(data=data)))

    def close(self) -> None:
        if self.writer is not None:
            self.writer.transport.abort()


@pytest.fixture
async def secure(rig: Rig, certificate: Path) -> Hub:
    """A hub with a port of TLS."""
    return rig.hub("wss-listen:127.0.0.1:0", tls_certificate=str(certificate))


@pytest.fixture
async def visit(rig: Rig) -> AsyncIterator[Callable[..., Any]]:
    """Return a function that opens a WebSocket to a hub's first port."""
    pages: list[Page] = []

    async def open_page(hub: Hub, origin: str = "", tls: ssl.SSLContext | None = None) -> Page:
        pages.append(Page())
        return await pages[-1].connect(hub.listening_ports()[0], origin, tls)

    yield open_page
    for page in pages:
        page.close()
    await rig.quiet()


async def hung_up(sock: socket.socket) -> bool:
    """Return whether the hub closes a bare connection without an answer."""
    try:
        return await receive(sock) == b""
    except ConnectionError:
        return True
