"""Limits on connections of clients that have not logged in, with a server on loopback."""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from gateway.panel import connections
from gateway.panel.admission import Holder, Role, address_group
from gateway.panel.connections import (
    CONNECTIONS_OF_ADDRESS,
    CONNECTIONS_OF_ROLE,
    CONNECTIONS_OF_SESSION,
    MAX_HEADER,
    ConnectionLimits,
    LimitedProtocol,
    LimitedServer,
)
from tests.panel.web_client import write_certificate

pytestmark = pytest.mark.io
REQUEST = b"GET /%s HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n"


@pytest.fixture
def make() -> Iterator[Callable[[], socket.socket]]:
    opened: list[socket.socket] = []

    def one() -> socket.socket:
        pair = socket.socketpair()
        opened.extend(pair)
        return pair[0]

    yield one
    for sock in opened:
        sock.close()


def log_in(
    limits: ConnectionLimits,
    sock: socket.socket,
    role: Role,
    address: str = "10.0.0.1",
    port: int = 1,
) -> None:
    """Open a connection, and log in on it; each role has a session of its own."""
    limits.admit((address, port), sock)
    limits.authenticate((address, port), Holder(role, str(role), address))


def is_shut(sock: socket.socket) -> bool:
    sock.setblocking(False)
    try:
        return sock.recv(1) == b""
    except BlockingIOError:
        return False


def test_connection_without_a_place_is_closed(make: Callable[[], socket.socket]) -> None:
    limits = ConnectionLimits()
    known, first = make(), make()
    log_in(limits, known, Role.VIEWER)
    limits.admit(("10.0.0.1", 2), first)
    for port in range(CONNECTIONS_OF_ADDRESS):
        limits.admit(("10.0.0.1", 100 + port), make())
    assert is_shut(first)
    assert not is_shut(known)


def test_connections_of_a_viewer_leave_places_for_all(make: Callable[[], socket.socket]) -> None:
    limits = ConnectionLimits()
    operator, viewers = make(), [make() for _ in range(300)]
    log_in(limits, operator, Role.OPERATOR, "10.0.0.2")
    for port, sock in enumerate(viewers):
        log_in(limits, sock, Role.VIEWER, port=port)
    assert sum(not is_shut(sock) for sock in viewers) == CONNECTIONS_OF_SESSION
    newcomer = make()
    limits.admit(("10.0.0.1", 1000), newcomer)
    assert not is_shut(newcomer)
    assert not is_shut(operator)


def test_closed_connections_are_not_counted(make: Callable[[], socket.socket]) -> None:
    limits, first = ConnectionLimits(), make()
    log_in(limits, first, Role.VIEWER)
    for port in range(2, 2 * CONNECTIONS_OF_ROLE):
        sock = make()
        log_in(limits, sock, Role.VIEWER, port=port)
        sock.close()
    assert not is_shut(first)


@pytest.mark.parametrize(
    ("host", "group"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::ffff:1", "2001:db8::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("not an address", "not an address"),
    ],
)
def test_address_group(host: str, group: str) -> None:
    assert address_group(host) == group


async def answers_all(scope: Scope, receive: Receive, send: Send) -> None:
    await PlainTextResponse("hello")(scope, receive, send)


@asynccontextmanager
async def served(**options: Any) -> AsyncIterator[int]:
    config = uvicorn.Config(
        answers_all, http=LimitedProtocol, log_config=None, lifespan="off", **options
    )
    config.load()
    server = LimitedServer(config, ConnectionLimits())
    sock = socket.socket()
    sock.bind(("127.0.0.1", 0))
    opened = asyncio.Event()
    serving = asyncio.create_task(server.serve_on(sock, opened.set))
    port: int = sock.getsockname()[1]
    await opened.wait()
    yield port
    server.should_exit = True
    await serving


@asynccontextmanager
async def connected() -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    async with served() as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        yield reader, writer
        writer.close()


async def test_page_is_served_over_tls(tmp_path: Path) -> None:
    certificate, key = write_certificate(tmp_path)
    async with served(ssl_certfile=certificate, ssl_keyfile=key) as port:
        trusted = ssl.create_default_context(cafile=str(certificate))
        async with httpx.AsyncClient(verify=trusted) as client:
            assert (await client.get(f"https://127.0.0.1:{port}/")).text == "hello"


async def test_idle_connections_do_not_block_a_user() -> None:
    async with served() as port:
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(300)]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(REQUEST % b"")
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")
        assert await silent[0][0].read() == b""
        for _, stream in [*silent, (reader, writer)]:
            stream.close()


@pytest.mark.parametrize("sent", [b"", b"GET / HT", REQUEST[:-2] % b"", REQUEST % b"" + b"GET /"])
async def test_incomplete_header_is_closed(sent: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HEADER_S", 0.2)
    async with connected() as (reader, writer):
        writer.write(sent)
        try:
            data = await reader.read()
        except ConnectionResetError:
            data = b""
        assert data.count(b"HTTP/1.1 200") == sent.count(b"\r\n\r\n")


async def test_connection_with_an_endless_header_is_closed() -> None:
    async with connected() as (reader, writer):
        writer.write(b"GET / HTTP/1.1\r\n")
        writer.write((b"x: " + b"y" * 1000 + b"\r\n") * (MAX_HEADER // 500))
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await reader.readexactly(1)


@pytest.mark.parametrize("size", [1000, MAX_HEADER, 300_000, 1_000_000])
async def test_body_that_arrives_with_its_header_is_no_part_of_it(size: int) -> None:
    async with connected() as (reader, writer):
        head = f"POST / HTTP/1.1\r\nhost: x\r\ncontent-length: {size}\r\n\r\n".encode()
        # Another request follows in the same piece as the end of the body.
        for _ in range(3):
            writer.write(head + bytes(size) + REQUEST % b"")
            for _ in range(2):
                answer = await reader.readuntil(b"hello")
                assert answer.startswith(b"HTTP/1.1 200"), answer


async def test_complete_header_that_is_too_long_is_refused() -> None:
    async with connected() as (reader, writer):
        writer.write(b"GET / HTTP/1.1\r\nx: " + b"y" * MAX_HEADER + b"\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            assert b"200" not in await reader.readline()
