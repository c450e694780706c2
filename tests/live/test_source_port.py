"""The transports of sources: each brings bytes, and opens again what was lost."""

import asyncio
import os
import socket
from pathlib import Path
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.transports import base
from gateway.live import source_port
from gateway.live.control_socket import ControlError
from gateway.live.control_verbs import source_verbs
from gateway.live.source_port import SourcePort
from gateway.records import NodeId
from gateway.sources.kinds import make_decoder
from gateway.sources.settings import parse_source
from gateway.sources.source import SourceInput
from tests.kit.mavlink import packed
from tests.kit.process import until
from tests.ports import free_port

pytestmark = pytest.mark.io


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "RETRY_US", 10_000)
    monkeypatch.setattr(source_port, "TICK_S", 0.01)
    monkeypatch.setattr(source_port, "RETRY_S", 0.01)
    monkeypatch.setattr(source_port, "FILE_POLL_S", 0.01)
    monkeypatch.setattr(source_port, "POLL_S", 0.01)


class Opened:
    """A source that is open, and the bytes that it has brought."""

    def __init__(self, url: str) -> None:
        parsed, node = parse_source(url), NodeId(1, 8)
        self.source = SourceInput(parsed, node, make_decoder(parsed, node))
        self.data = b""
        self.parts: list[bytes] = []
        hub = Hub(HubSettings(), lambda _: None, GatewayClock())
        self.port = SourcePort(self.source, self._take, hub)

    def _take(self, _source: SourceInput, data: bytes) -> None:
        self.data += data
        self.parts.append(data)

    async def __aenter__(self) -> "Opened":
        self.port.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.port.close()
        await asyncio.sleep(0)


async def test_file_is_followed_from_its_beginning_and_again_after_it_is_replaced(
    tmp_path: Path,
) -> None:
    path = tmp_path / "log"
    async with Opened(f"lines:file:{path}") as opened:
        await until(lambda: "No such file" in opened.source.reason)
        path.write_bytes(b"one\n")
        await until(lambda: opened.data == b"one\n")
        with path.open("ab") as file:
            file.write(b"two\n")
        await until(lambda: opened.data == b"one\ntwo\n")
        path.write_bytes(b"3\n")
        await until(lambda: opened.data == b"one\ntwo\n3\n")


async def test_standard_input_that_is_a_file_is_read_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path := tmp_path / "input").write_bytes(b"one\ntwo\n")
    for name, content in ((path, b"one\ntwo\n"), (Path(os.devnull), b"")):
        with name.open() as file:
            monkeypatch.setattr("sys.stdin", file)
            async with Opened("lines:stdin") as opened:
                await until(lambda o=opened: o.source.reason == "its end was reached")
                assert opened.data == content


async def test_serial_device_is_opened_again_after_it_was_unplugged(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    async with Opened(f"lines:{link}") as opened:
        await until(lambda: "No such file" in opened.source.reason)
        for word in (b"one", b"two"):
            opened.data = b""
            master, slave = os.openpty()
            link.symlink_to(os.ttyname(slave))
            await until(lambda: opened.source.connected)
            os.write(master, word)
            await until(lambda w=word: opened.data == w)
            link.unlink()
            os.close(slave)
            os.close(master)
            await until(lambda: not opened.source.connected)


async def test_newest_client_of_a_listening_source_is_used(
    caplog: pytest.LogCaptureFixture,
) -> None:
    port = free_port()
    async with Opened(f"lines:tcp-listen:127.0.0.1:{port}") as opened:
        await until(lambda: opened.source.reason == "no client is connected")
        # A board that has lost its supply closes nothing.
        boards = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
        for word, board in zip((b"1", b"2", b"3"), boards, strict=True):
            await asyncio.sleep(0)
            board.sendall(word)
        await until(lambda: opened.data.endswith(b"3"))
        (peer,) = cast("Any", opened.port.peers).values()
        assert peer._socket.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert peer.remote.endswith(f":{boards[2].getsockname()[1]}")
        for board in boards:
            board.close()
    assert "Traceback" not in caplog.text
    assert "CancelledError" not in caplog.text


@pytest.mark.parametrize(
    ("url", "data", "most"),
    [
        ("crsf:udp", b"\xc8\x02\x0b\x00" * 5000, source_port.PART),
        ("lines:udp", b"x\n" * 10_000, source_port.PART),
        ("lines:udp", b"a" * 3000 + b"\n" + b"b" * 10, 3001),
        ("crsf:tcp-listen", bytes(20_000), source_port.PART),
        ("lines:file", b"x\n" * 10_000, source_port.PART),
    ],
    ids=["frames", "lines", "long line", "stream", "file"],
)
async def test_large_input_is_processed_in_parts(
    url: str, data: bytes, most: int, tmp_path: Path
) -> None:
    kind, transport = url.split(":")
    where = str(tmp_path / "log") if transport == "file" else f"127.0.0.1:{free_port()}"
    (tmp_path / "log").write_bytes(data)
    async with Opened(f"{url}:{where}") as opened:
        await until(lambda: opened.source.connected or "client" in opened.source.reason)
        address = ("127.0.0.1", int(where.rpartition(":")[2] or 0)) if ":" in where else None
        if transport == "udp":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.sendto(data, address)
        elif address is not None:
            with socket.create_connection(address) as board:
                board.sendall(data)
        await until(lambda: len(opened.data) == len(data))
        assert opened.data == data
        assert max(map(len, opened.parts)) <= most
        if kind == "lines":
            assert all(part.endswith(b"\n") for part in opened.parts[:-1])


@pytest.mark.parametrize(
    ("answer", "data"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/json\r\n\r\n{\n}", b"{ }\n"),
        (b"HTTP/1.1 404 Not Found\r\n\r\n{}", b""),
        (b"HTTP/1.1 200 OK\r\n\r\n" + bytes(2000), b""),
        (b"x", b""),
        (b"", b""),
    ],
    ids=["answer", "not found", "too large", "not HTTP", "closed"],
)
async def test_server_is_polled_with_the_requests_of_the_decoder(
    answer: bytes, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source_port, "MAX_ANSWER", 1000)
    asked = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append(await reader.readuntil(b"\r\n\r\n"))
        writer.write(answer)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, Opened(f"phone:poll:127.0.0.1:{port}") as opened:
        await until(lambda: len(asked) > 2 and opened.data[:4] == data)
        assert opened.source.connected == bool(data)
    assert asked[0].startswith(b"GET /get?acc_time=&accX=&")
    assert asked[0].split(b"\r\n")[0].endswith(b" HTTP/1.0")


async def test_posted_content_is_taken_with_the_token_and_others_are_counted() -> None:
    secret = "a.secret_of_mine-1"
    async with Opened(f"phone:push?token={secret}") as one, Opened("lines:push") as other:
        assert "posted" in other.source.reason
        verbs = source_verbs([one.port, other.port])
        assert verbs["source.tokens"]() == {secret: "phone:push", other.port.token: "lines:push"}
        assert len(other.port.token) == 16
        verbs["source.push"](secret, "")
        assert not one.source.connected
        verbs["source.push"](secret, "abc")
        assert (one.data, other.data, one.source.connected) == (b"abc", b"", True)
        for wrong in ("", secret[:-1], "sécret"):
            with pytest.raises(ControlError, match="no source has this token"):
                verbs["source.push"](wrong, "abc")
        assert other.source.report(0).faults == (("token", 3),)


async def test_recording_of_other_messages_leaves_the_loop_to_others(tmp_path: Path) -> None:
    """A turn of the loop for each block that is read."""
    blocks = 20
    frame = packed(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))
    record = bytes(8) + frame
    path = tmp_path / "other.tlog"
    async with Opened(f"lines:file:{path}") as opened:
        await until(lambda: "No such file" in opened.source.reason)
        path.write_bytes(record * (blocks * source_port.READ_SIZE // len(record)))
        await until(lambda: opened.source.connected)
        turns = 0
        while opened.source.reason != "its end was reached":
            await asyncio.sleep(0)
            turns += 1
        assert turns >= blocks
