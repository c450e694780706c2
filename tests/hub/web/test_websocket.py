"""The hub's WebSockets: pages and programs, stalled and closed, and their rights."""

import asyncio
import contextlib
import shutil
import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from wsproto.events import RejectConnection, TextMessage

from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from tests.hub.web.conftest import hung_up
from tests.kit.hub import Rig, receive
from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io

LISTEN = "ws-listen:127.0.0.1:0"
Visit = Callable[..., Any]


class TestPages:
    async def test_text_message_is_counted_as_garbage(self, rig: Rig, visit: Visit) -> None:
        hub = rig.hub(LISTEN)
        page = await visit(hub)
        page.writer.write(page.web.send(TextMessage(data="hello")))
        await rig.until(lambda: hub.clients()[0].bytes_garbage == 5)
        assert hub.clients()[0].state == "open"

    async def test_page_of_a_foreign_origin_is_refused_and_reported(
        self, rig: Rig, visit: Visit, caplog: pytest.LogCaptureFixture
    ) -> None:
        hub = rig.hub(LISTEN)
        page = await visit(hub, "https://example.org")
        assert isinstance(page.events[0], RejectConnection)
        assert page.events[0].status_code == 403
        await page.end()
        assert not hub.clients()
        assert hub.listeners()[0].turned_away == 1
        assert "'https://example.org' was refused" in caplog.text

    async def test_page_of_an_allowed_origin_may_connect(self, rig: Rig, visit: Visit) -> None:
        hub = rig.hub(f"{LISTEN}?origins=https://example.org,null&trusted=no")
        rig.publish(hub, rig.vehicle.heartbeat())
        page = await visit(hub, "https://example.org")
        assert page.is_open
        assert (await visit(hub, "null")).is_open
        assert not (await visit(hub, "https://example.com")).is_open
        page.send(rig.sender(255, 190).command(1, 1))
        await rig.until(lambda: bool(rig.incoming))
        assert not rig.incoming[0].trusted

    async def test_closing_port_sends_a_close(self, rig: Rig, visit: Visit) -> None:
        hub = rig.hub(LISTEN)
        page = await visit(hub)
        hub.close()
        await page.end()
        assert page.events[-1].code == 1001


class TestTrouble:
    async def test_client_that_sends_pings_and_never_reads_is_dropped(self, rig: Rig) -> None:
        hub = rig.hub(LISTEN)
        sock = await rig.connect(hub.listening_ports()[0], room_bytes=4096)
        await self.shake_hands(rig, hub, sock)
        ping = b"\x89\xfd" + bytes(4 + 125)
        async with asyncio.timeout(START_LIMIT_S):
            while hub.clients():
                try:
                    await asyncio.get_running_loop().sock_sendall(sock, ping * 30)
                except ConnectionError:
                    break
        await rig.until(lambda: not hub.clients())

    async def test_page_that_stops_answering_pings_is_dropped(self, rig: Rig, visit: Visit) -> None:
        """Half-open: its machine is gone, and no packet reports it."""
        hub = rig.hub(LISTEN, idle_timeout_s=9)
        page, mute = [await visit(hub) for _ in range(2)]
        mute.answers_pings = False
        rig.tick(hub, 3)
        pings = len(page.events) + 1
        await page.until(lambda: len(page.events) >= pings)
        await rig.quiet()
        page.answers_pings = False
        for _ in range(2):
            rig.tick(hub, 4)
            assert len(hub.clients()) == 2
        rig.tick(hub, 4)
        (left,) = hub.clients()
        assert left.client_id == 2, "one that never answered pings is left to the kernel"

    @pytest.mark.parametrize("closes", [False, True])
    async def test_connection_without_handshake_is_dropped(self, rig: Rig, closes: bool) -> None:
        hub = rig.hub(LISTEN)
        sock = await rig.connect(hub.listening_ports()[0])
        await asyncio.get_running_loop().sock_sendall(sock, b"GET / HTTP/1.1\r\n")
        await rig.quiet()
        assert not hub.clients()
        if closes:
            hub.close()
        else:
            rig.tick(hub, 5)
        assert await hung_up(sock)

    async def test_connections_without_handshake_do_not_keep_pages_out(
        self, rig: Rig, visit: Visit
    ) -> None:
        hub = rig.hub(LISTEN, max_clients=3)
        port = hub.listening_ports()[0]
        idle = [await rig.connect(port) for _ in range(20)]
        assert await hung_up(idle[0])
        pages = [await visit(hub) for _ in range(3)]
        assert all(page.is_open for page in pages)
        assert len(hub.clients()) == 3
        assert await hung_up(await rig.connect(port))
        assert len(hub.clients()) == 3

    @pytest.mark.parametrize("seed", range(10))
    async def test_garbage_ends_only_its_own_connection(
        self, rig: Rig, visit: Visit, seed: int
    ) -> None:
        hub = rig.hub(LISTEN)
        page = await visit(hub)
        sock = await rig.connect(hub.listening_ports()[0])
        if seed % 2:
            await self.shake_hands(rig, hub, sock)
        await asyncio.get_running_loop().sock_sendall(sock, bytes(range(seed, 250)) * 20)
        with contextlib.suppress(ConnectionError):
            while await receive(sock):
                continue
        await rig.until(lambda: len(hub.clients()) == 1)
        rig.publish(hub, rig.vehicle.attitude())
        assert len(await page.frames(1)) == 1

    @staticmethod
    async def shake_hands(rig: Rig, hub: Any, sock: socket.socket) -> None:
        before = len(hub.clients())
        await asyncio.get_running_loop().sock_sendall(
            sock,
            b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        )
        await rig.until(lambda: len(hub.clients()) > before)


class TestCalling:
    async def test_server_that_refuses_is_reported(self, rig: Rig) -> None:
        async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n")
            writer.close()

        server = await asyncio.start_server(refuse, "127.0.0.1", 0)
        hub = rig.hub(f"ws:127.0.0.1:{server.sockets[0].getsockname()[1]}")
        await rig.until(lambda: hub.clients()[0].state == "refused")
        assert hub.clients()[0].reason == "the server answers HTTP 403"
        hub.close()
        server.close()
        await rig.quiet()

    async def test_server_that_never_answers_is_given_up(self, rig: Rig) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            hub = rig.hub(f"ws:127.0.0.1:{server.getsockname()[1]}")
            server.setblocking(False)
            connection, _ = await asyncio.get_running_loop().sock_accept(server)
            rig.closing.append(connection.close)
            await rig.quiet()
            rig.tick(hub, 5)
            assert hub.clients()[0].state == "refused"
            assert hub.clients()[0].reason == "no handshake"
            hub.close()


class TestTls:
    @pytest.mark.parametrize(
        ("host", "authority", "reason"),
        [
            ("127.0.0.1", False, "tls: certificate verify failed: self-signed certificate"),
            # The reason shows whether its name, its date or its authority is to be mended.
            ("localhost", True, "certificate is not valid for 'localhost'"),
        ],
    )
    async def test_server_without_a_valid_certificate_is_refused(
        self, rig: Rig, secure: Hub, certificate: Path, host: str, authority: bool, reason: str
    ) -> None:
        known = str(certificate) if authority else ""
        hub = rig.hub(f"wss:{host}:{secure.listening_ports()[0]}", tls_authority=known)
        await rig.until(lambda: hub.clients()[0].state == "refused")
        assert reason in hub.clients()[0].reason
        await rig.until(lambda: secure.listeners()[0].turned_away == 1)
        assert not secure.clients()

    async def test_plain_http_at_a_tls_port_is_refused(
        self, rig: Rig, secure: Hub, caplog: pytest.LogCaptureFixture
    ) -> None:
        sock = await rig.connect(secure.listening_ports()[0])
        sock.send(b"GET / HTTP/1.1\r\n\r\n")
        await rig.until(lambda: secure.listeners()[0].turned_away == 1)
        assert "tls: http request" in caplog.text

    async def test_missing_or_replaced_certificate_applies_to_the_next_connection(
        self, rig: Rig, visit: Visit, certificate: Path, tmp_path: Path
    ) -> None:
        file, tls = tmp_path / "mine.pem", ssl.create_default_context(cafile=certificate)
        hub = rig.hub("wss-listen:127.0.0.1:0", tls_certificate=str(file))
        assert hub.listeners()[0].reason == "No such file or directory"
        shutil.copy(certificate, file)
        rig.tick(hub, 2)
        assert (await visit(hub, tls=tls)).is_open
        file.write_text("no certificate")
        with pytest.raises(ConnectionError):
            await visit(hub, tls=tls)
        shutil.copy(certificate, file)
        assert (await visit(hub, tls=tls)).is_open

    def test_settings_without_a_certificate_are_refused(self) -> None:
        with pytest.raises(ValueError, match="needs a tls_certificate"):
            HubSettings(endpoints=("wss-listen:127.0.0.1:56781",))
