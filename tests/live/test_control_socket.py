"""The control socket: its access rights, its requests, and its answers to malformed ones."""

import asyncio
import contextlib
import os
import socket
import stat
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from gateway.live import control_socket
from gateway.live.control_socket import (
    MAX_CONNECTIONS,
    MAX_LINE,
    ControlError,
    ControlServer,
    find_socket,
    request,
    socket_path,
)

pytestmark = pytest.mark.io

LIMIT_S = 60.0
"""After which a connection that nobody closes makes its test fail."""


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folders of a user and of the system service, which is returned."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(control_socket, "SERVICE_FOLDER", tmp_path / "service")
    return tmp_path / "service"


@pytest.fixture
async def server(tmp_path: Path) -> AsyncIterator[ControlServer]:
    async def seek(offset_s: float) -> dict[str, float]:
        return {"position_s": offset_s}

    def refuse() -> None:
        raise ControlError("not now")

    made = ControlServer(tmp_path / "mavgate" / "run.sock", {"seek": seek, "refuse": refuse})
    await made.start()
    yield made
    made.close()


@asynccontextmanager
async def connected(
    server: ControlServer,
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_unix_connection(str(server.path))
    yield reader, writer
    writer.close()


async def ask(server: ControlServer, verb: str, params: dict[str, Any] | None = None) -> Any:
    return await asyncio.to_thread(request, server.path, verb, params)


async def test_request_is_answered(server: ControlServer) -> None:
    assert await ask(server, "seek", {"offset_s": 80}) == {"position_s": 80.0}
    assert await ask(server, "verbs") == ["refuse", "seek", "verbs"]


async def test_refused_requests_get_a_reason(server: ControlServer) -> None:
    for verb, params, text in (
        ("refuse", {}, "not now"),
        ("fly", {}, "no such verb: fly; there are refuse, seek, verbs"),
        ("seek", {}, "missing required field `offset_s`"),
        ("seek", {"offset_s": "x"}, "Expected `float`"),
        ("seek", {"offset_s": 1, "far": 2}, "unknown field `far`"),
    ):
        with pytest.raises(ControlError, match=text):
            await ask(server, verb, params)


async def test_invalid_requests_are_answered_with_an_error(server: ControlServer) -> None:
    for line in (
        *(b"\n", b"nonsense\n", b"[]\n", b'{"verb": 3}\n', b"\xff\xfe\n", b'{"verb": "\xff"}\n'),
        b'{"verb": "verbs", "params": {"a": ' + b"[" * 60_000 + b"\n",
    ):
        answer = msgspec.json.decode(await server.answer(line))
        assert answer["ok"] is False, line[:60]
        assert answer["error"], line[:60]


async def test_several_requests_are_answered_on_one_connection(server: ControlServer) -> None:
    assert stat.S_IMODE(server.path.parent.stat().st_mode) == 0o700
    async with connected(server) as (reader, writer):
        writer.write(b'{"verb":"seek","params":{"offset_s":1}}\n{"verb":"refuse"}\n')
        first, second = await reader.readline(), await reader.readline()
    assert msgspec.json.decode(first)["ok"] is True
    assert msgspec.json.decode(second) == {"ok": False, "result": None, "error": "not now"}


async def test_endless_line_or_idle_connection_is_closed_alone(
    server: ControlServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with connected(server) as (reader, writer):
        writer.write(b"x" * (2 * MAX_LINE))
        assert await reader.read() == b""
    monkeypatch.setattr(control_socket, "IDLE_S", 0.05)
    async with connected(server) as (reader, _):
        assert await reader.read() == b""
    assert await ask(server, "verbs")


async def test_idle_connections_keep_nobody_out(server: ControlServer) -> None:
    links = [await asyncio.open_unix_connection(str(server.path)) for _ in range(MAX_CONNECTIONS)]
    for reader, writer in links:
        writer.write(b'{"verb":"verbs"}\n')
        await reader.readline()
    assert await ask(server, "verbs")
    assert await links[0][0].read() == b"", "the one that has waited longest is closed"
    links[-1][1].write(b'{"verb":"verbs"}\n')
    assert await links[-1][0].readline()
    for _, writer in links:
        writer.close()


@pytest.mark.parametrize("turns", range(5), ids=lambda turns: f"{turns} turns")
async def test_connection_just_before_the_end_is_closed(server: ControlServer, turns: int) -> None:
    """At whichever turn of the loop it is accepted and served."""
    with socket.socket(socket.AF_UNIX) as link:
        link.setblocking(False)
        link.connect(str(server.path))
        for _ in range(turns):
            await asyncio.sleep(0)
        server.close()
        async with asyncio.timeout(LIMIT_S):
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.get_running_loop().sock_recv(link, 1) == b""


async def test_path_too_long_for_a_socket_is_reported(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 100) / "run.sock"
    with pytest.raises(ControlError, match="at most 107; let XDG_RUNTIME_DIR name a shorter"):
        await ControlServer(path).start()
    with pytest.raises(ControlError, match="at most 107"):
        request(path, "verbs")


async def test_gateways_of_one_user_have_a_socket_each(server: ControlServer) -> None:
    others = [ControlServer(server.path) for _ in range(2)]
    for other in others:
        await other.start()
    names = [made.path.name for made in (server, *others)]
    assert names == ["run.sock", "run-2.sock", "run-3.sock"]
    assert await ask(others[0], "verbs") == ["verbs"]
    for other in others:
        other.close()
    assert await ask(server, "verbs"), "closing another's socket leaves this one"


@pytest.mark.parametrize(
    ("user", "groups", "in_service", "is_answered"),
    [(0, (), False, True), (1, (), False, True), (2, (7,), False, False), (2, (7,), True, True),
     (2, (8,), True, False)],
    ids=["root", "owner", "another user", "member of the service", "another user of the service"],
)  # fmt: skip
async def test_only_owner_root_and_group_of_a_service_are_answered(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    user: int,
    groups: tuple[int, ...],
    in_service: bool,
    is_answered: bool,
) -> None:
    """Also where the folder's rights let others in."""
    if in_service:
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    server = ControlServer(tmp_path / "run.sock")
    await server.start()
    assert stat.S_IMODE(server.path.stat().st_mode) == (0o660 if in_service else 0o600)
    monkeypatch.setattr(control_socket, "peer_of", lambda _: (user, groups))
    monkeypatch.setattr(os, "getuid", lambda: 1)
    monkeypatch.setattr(os, "getgid", lambda: 7)
    answered = False
    async with connected(server) as (reader, writer):
        writer.write(b'{"verb":"verbs"}\n')
        with contextlib.suppress(ConnectionResetError):
            answered = bool(await reader.read(1))
    server.close()
    assert answered == is_answered


async def test_user_and_groups_of_a_peer_are_those_of_its_process() -> None:
    ours, theirs = socket.socketpair()
    _, writer = await asyncio.open_unix_connection(sock=ours)
    user, groups = control_socket.peer_of(writer)
    assert user == os.getuid()
    assert os.getgid() in groups
    writer.close()
    theirs.close()


async def test_socket_of_a_killed_gateway_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "run.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    server = ControlServer(path)
    await server.start()
    assert await ask(server, "verbs") == ["verbs"]
    server.close()
    assert not path.exists()


def test_missing_gateway_is_reported(folders: Path) -> None:
    with pytest.raises(ControlError, match="nobody listens at the socket"):
        request(folders / "run.sock", "status")
    for name, starter in {"run": "`mavgate run` or", "play": "`mavgate play` first"}.items():
        with pytest.raises(ControlError, match=f"nothing runs.*: start {starter}"):
            find_socket(name)


async def test_command_finds_the_gateway_of_its_user_before_the_service(
    folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = ControlServer(folders / "run.sock")
    await service.start()
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda *_: False)
        with pytest.raises(ControlError, match="usermod -aG mavgate"):
            find_socket("run")
    assert find_socket("run") == service.path, "the service's, where the user has none"
    first, second = ControlServer(socket_path("run")), ControlServer(socket_path("run"))
    await first.start()
    assert find_socket("run") == first.path, "before the service's"
    await second.start()
    with pytest.raises(ControlError, match=r"several run.*--socket.*run.sock.*run-2.sock"):
        find_socket("run")
    first.close()
    assert find_socket("run") == second.path
    for server in (second, service):
        server.close()


def test_socket_is_in_the_runtime_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1")
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert socket_path("run") == Path("/run/user/1/mavgate/run.sock")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setenv("XDG_STATE_HOME", "/home/x/state")
    assert socket_path("play") == Path("/home/x/state/mavgate/play.sock")
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/mavgate:/run/other")
    assert socket_path("run") == Path("/run/mavgate/run.sock")
