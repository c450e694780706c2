"""The control socket: its rights, its words, and what it says to nonsense."""

import asyncio
import socket
import stat
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from gateway.edges.operator.control_socket import (
    MAX_CONNECTIONS,
    MAX_LINE,
    ControlError,
    ControlServer,
    NoParams,
    request,
    socket_path,
)

pytestmark = pytest.mark.io


class Seek(msgspec.Struct, forbid_unknown_fields=True):
    offset_s: float


@pytest.fixture
async def server(tmp_path: Path) -> AsyncIterator[ControlServer]:
    made = ControlServer(tmp_path / "mavgate" / "run.sock")

    async def seek(params: Seek) -> dict[str, float]:
        return {"position_s": params.offset_s}

    def refuse(_: NoParams) -> None:
        raise ControlError("not now")

    made.register("seek", Seek, seek)
    made.register("refuse", NoParams, refuse)
    await made.start()
    yield made
    made.close()


async def ask(server: ControlServer, verb: str, params: dict[str, Any] | None = None) -> Any:
    return await asyncio.to_thread(request, server.path, verb, params)


async def test_a_request_is_answered(server: ControlServer) -> None:
    assert await ask(server, "seek", {"offset_s": 80}) == {"position_s": 80.0}
    assert await ask(server, "verbs") == ["refuse", "seek", "verbs"]


@pytest.mark.parametrize(
    ("verb", "params", "text"),
    [
        ("refuse", {}, "not now"),
        ("fly", {}, "no such verb: fly; there are refuse, seek, verbs"),
        ("seek", {}, "missing required field `offset_s`"),
        ("seek", {"offset_s": "x"}, "Expected `float`"),
        ("seek", {"offset_s": 1, "far": 2}, "unknown field `far`"),
    ],
)
async def test_what_cannot_be_granted_is_refused_with_a_reason(
    server: ControlServer, verb: str, params: dict[str, Any], text: str
) -> None:
    with pytest.raises(ControlError, match=text):
        await ask(server, verb, params)


@pytest.mark.parametrize("line", [b"\n", b"nonsense\n", b"[]\n", b'{"verb": 3}\n', b"\xff\xfe\n"])
async def test_nonsense_is_answered_too(server: ControlServer, line: bytes) -> None:
    answer = msgspec.json.decode(await server.answer(line))
    assert answer["ok"] is False
    assert answer["error"]


async def test_only_the_user_may_open_it(server: ControlServer) -> None:
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(server.path.parent.stat().st_mode) == 0o700


async def test_several_requests_on_one_connection(server: ControlServer) -> None:
    reader, writer = await asyncio.open_unix_connection(str(server.path))
    writer.write(b'{"verb":"seek","params":{"offset_s":1}}\n{"verb":"refuse"}\n')
    first, second = await reader.readline(), await reader.readline()
    assert msgspec.json.decode(first)["ok"] is True
    assert msgspec.json.decode(second) == {"ok": False, "result": None, "error": "not now"}
    writer.close()
    await writer.wait_closed()


async def test_a_line_without_end_ends_the_connection_alone(server: ControlServer) -> None:
    reader, writer = await asyncio.open_unix_connection(str(server.path))
    writer.write(b"x" * (2 * MAX_LINE))
    assert await reader.read() == b""
    writer.close()
    assert await ask(server, "verbs")


async def test_too_many_connections_are_turned_away(server: ControlServer) -> None:
    links = [await asyncio.open_unix_connection(str(server.path)) for _ in range(MAX_CONNECTIONS)]
    for reader, writer in links:
        writer.write(b'{"verb":"verbs"}\n')
        await reader.readline()
    with pytest.raises(ControlError, match="no answer"):
        await ask(server, "verbs")
    for _, writer in links:
        writer.close()
        await writer.wait_closed()


async def test_a_second_gateway_is_refused(server: ControlServer) -> None:
    with pytest.raises(ControlError, match="another gateway"):
        await ControlServer(server.path).start()
    assert await ask(server, "verbs")


async def test_the_socket_of_a_killed_gateway_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "run.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    server = ControlServer(path)
    await server.start()
    assert await ask(server, "verbs") == ["verbs"]
    server.close()
    assert not path.exists()


def test_nobody_there_is_said_plainly(tmp_path: Path) -> None:
    with pytest.raises(ControlError, match=r"nothing runs.*: start `mavgate run` or"):
        request(tmp_path / "run.sock", "status")
    with pytest.raises(ControlError, match=r"nothing runs.*: start `mavgate play` first"):
        request(tmp_path / "play.sock", "status")


def test_the_socket_is_in_the_runtime_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1")
    assert socket_path("run") == Path("/run/user/1/mavgate/run.sock")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setenv("XDG_STATE_HOME", "/home/x/state")
    assert socket_path("play") == Path("/home/x/state/mavgate/play.sock")
