"""Listening sockets at the limit of file descriptors."""

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from gateway.hub.transports import sockets as accepting
from gateway.hub.transports.sockets import accept_each
from gateway.live.control_socket import ControlServer
from gateway.live.metrics_server import MetricsServer
from tests.kit.hub import no_descriptors, receive
from tests.kit.process import until
from tests.ports import free_port

pytestmark = pytest.mark.io


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accepting, "ACCEPT_AGAIN_S", 0.001)


@pytest.fixture
async def listening() -> AsyncIterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        sock.setblocking(False)
        yield sock
        if sock.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(sock)


async def test_socket_closed_during_the_pause_is_not_watched_again(
    listening: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, later = asyncio.get_running_loop(), list[Callable[[], None]]()
    accept_each(listening, lambda *_: None, lambda _: None)
    monkeypatch.setattr(accepting, "ACCEPT_AGAIN_S", -1.0)
    call_later = loop.call_later
    monkeypatch.setattr(
        loop,
        "call_later",
        lambda wait_s, *work: later.append(*work) if wait_s < 0 else call_later(wait_s, *work),
    )
    with socket.socket() as caller, no_descriptors():
        caller.connect(listening.getsockname())
        await until(lambda: bool(later))
        # A socket that is still watched would wake the loop again.
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    listening.close()
    (watch,) = later
    watch()


async def test_metrics_server_keeps_its_port_and_reports_missing_descriptors() -> None:
    server = MetricsServer(lambda: iter(["text"]))
    server.listen(free_port())
    port = server.port
    with socket.socket() as caller:
        with no_descriptors():
            caller.connect(("127.0.0.1", port))
            await until(lambda: server.listeners()[0].reason == "Too many open files")
            assert server.listeners()[0].state == "closed"
        await until(lambda: server.listeners()[0].clients == 1)
        assert (server.listeners()[0].state, server.port) == ("open", port)
    server.close()


async def test_control_socket_answers_later_and_logs_missing_descriptors_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    server = ControlServer(tmp_path / "run.sock")
    await server.start()
    with socket.socket(socket.AF_UNIX) as caller:
        caller.setblocking(False)
        with no_descriptors():
            caller.connect(str(server.path))
            await until(lambda: bool(caplog.records))
            # Long enough for some more attempts.
            await asyncio.sleep(0.01)
        await asyncio.get_running_loop().sock_sendall(caller, b'{"verb":"verbs"}\n')
        assert await receive(caller)
    server.close()
    assert caplog.messages == ["control socket: Too many open files; it is tried again"]
