"""Limits on connections of clients that have not logged in, with a server on loopback."""

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager

import pytest
import uvicorn
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from gateway.panel import connections
from gateway.panel.connections import (
    MAX_ANONYMOUS,
    MAX_ANONYMOUS_OF_ADDRESS,
    MAX_CONNECTIONS,
    MAX_HEADER,
    ConnectionLimits,
    LimitedProtocol,
    LimitedServer,
    address_group,
)

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


def is_shut(sock: socket.socket) -> bool:
    sock.setblocking(False)
    try:
        return sock.recv(1) == b""
    except BlockingIOError:
        return False


def test_oldest_anonymous_connection_of_an_address_is_closed(
    make: Callable[[], socket.socket],
) -> None:
    limits = ConnectionLimits()
    known, first = make(), make()
    assert limits.admit(("10.0.0.1", 1), known)
    limits.authenticate(("10.0.0.1", 1))
    assert limits.admit(("10.0.0.1", 2), first)
    other = make()
    assert limits.admit(("10.0.0.2", 3), other)
    for port in range(MAX_ANONYMOUS_OF_ADDRESS):
        assert limits.admit(("10.0.0.1", 100 + port), make())
    assert is_shut(first)
    assert not is_shut(known)
    assert not is_shut(other)
    assert limits.refused == 1


def test_anonymous_connections_of_many_addresses_do_not_block_users(
    make: Callable[[], socket.socket],
) -> None:
    limits = ConnectionLimits()
    users = [make() for _ in range(MAX_CONNECTIONS - MAX_ANONYMOUS)]
    for port, sock in enumerate(users):
        client = (f"10.0.{port}.1", port)
        assert limits.admit(client, sock)
        limits.authenticate(client)
    for port in range(300):
        assert limits.admit((f"10.1.{port}.1", port), make())
    assert limits.refused == 300 - MAX_ANONYMOUS
    assert not any(map(is_shut, users))


def test_closed_connections_are_not_counted(make: Callable[[], socket.socket]) -> None:
    limits = ConnectionLimits()
    for port in range(2 * MAX_CONNECTIONS):
        sock = make()
        assert limits.admit(("10.0.0.1", port), sock)
        limits.authenticate(("10.0.0.1", port))
        sock.close()
    assert limits.refused == 0


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
async def served() -> AsyncIterator[int]:
    config = uvicorn.Config(answers_all, http=LimitedProtocol, log_config=None, lifespan="off")
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


@pytest.mark.io
async def test_idle_connections_do_not_block_a_user() -> None:
    async with served() as port:
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(300)]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(REQUEST % b"")
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")
        assert await silent[0][0].read() == b""
        for _, stream in [*silent, (reader, writer)]:
            stream.close()


@pytest.mark.io
@pytest.mark.parametrize(
    "sent", [b"", b"GET / HT", REQUEST[:-2] % b"", (REQUEST % b"") + b"GET /sec"]
)
async def test_connection_with_an_incomplete_header_is_closed(
    sent: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "HEADER_S", 0.2)
    async with served() as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(sent)
        try:
            data = await reader.read()
        except ConnectionResetError:
            data = b""
        assert data.count(b"HTTP/1.1 200") == sent.count(b"\r\n\r\n")
        writer.close()


@pytest.mark.io
async def test_connection_with_an_endless_header_is_closed() -> None:
    async with served() as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET / HTTP/1.1\r\n")
        writer.write((b"x: " + b"y" * 1000 + b"\r\n") * (MAX_HEADER // 500))
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await reader.readexactly(1)
        writer.close()
