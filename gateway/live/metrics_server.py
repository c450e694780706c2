"""Prometheus text of a gateway's state, on a loopback port."""

import asyncio
import logging
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final

from gateway.hub.endpoint import names_loopback
from gateway.hub.stats import ListenerStats
from gateway.hub.transports.sockets import accept_each
from gateway.printable import reason_of

log = logging.getLogger(__name__)

REQUEST_LIMIT_S: Final = 5.0
MAX_REQUEST_BYTES: Final = 8192
MAX_CONNECTIONS: Final = 8
HOST: Final = re.compile(rb"^host:(.*?)\r$", re.IGNORECASE | re.MULTILINE)
CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
RETRY_S: Final = 5.0
"""Interval of attempts to bind a port in use: about the interval of a scraper."""


class MetricsServer:
    """Answer HTTP with the present metrics, except to pages that use another host name."""

    def __init__(self, text: Callable[[], Iterator[str]]) -> None:
        """Serve the pieces of text that `text` returns."""
        self._text = text
        self._wanted = 0
        self._reason = ""
        self._sockets: list[socket.socket] = []
        self._retry: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def port(self) -> int:
        """The port that is bound; 0 before, or if another program has it."""
        return self._sockets[0].getsockname()[1] if self._sockets else 0

    def listen(self, port: int) -> None:
        """Serve on a loopback port, now or as soon as it is free; 0 ends it."""
        if port != self._wanted:
            self.close()
            self._wanted = port
            if port:
                self._bind()

    def close(self) -> None:
        """Stop serving."""
        self._wanted, self._reason = 0, ""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        for each in self._sockets:
            asyncio.get_running_loop().remove_reader(each)
            each.close()
        self._sockets = []

    def listeners(self) -> tuple[ListenerStats, ...]:
        """Return the port's state, if one is configured."""
        if not self._wanted:
            return ()
        url = f"http://127.0.0.1:{self._wanted}/metrics"
        state = "closed" if self._reason else "open"
        count = len(self._tasks)
        return (ListenerStats("metrics", url, state, self._reason, self.port, count, 0),)

    def _bind(self) -> None:
        try:
            self._sockets.append(socket.create_server(("127.0.0.1", self._wanted)))
        except OSError as error:
            self._report(error)
            self._retry = asyncio.get_running_loop().call_later(RETRY_S, self._bind)
            return
        # Some machines have no IPv6.
        with suppress(OSError):
            second = socket.create_server(("::1", self._wanted), family=socket.AF_INET6)
            self._sockets.append(second)
        self._report(None)
        for each in self._sockets:
            each.setblocking(False)
            accept_each(each, self._on_connection, self._report)

    def _report(self, error: OSError | None) -> None:
        reason = "" if error is None else reason_of(error)
        if reason and reason != self._reason:
            log.warning("no metrics on port %d yet: %s", self._wanted, reason)
        self._reason = reason

    def _on_connection(self, connection: socket.socket, _: object) -> None:
        if len(self._tasks) >= MAX_CONNECTIONS:
            connection.close()
            return
        task = asyncio.get_running_loop().create_task(self._serve(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        reader, writer = await asyncio.open_connection(sock=connection, limit=MAX_REQUEST_BYTES)
        try:
            async with asyncio.timeout(REQUEST_LIMIT_S):
                request = await reader.readuntil(b"\r\n\r\n")
                writer.write(await self._respond(request))
                await writer.drain()
        except (OSError, EOFError, asyncio.LimitOverrunError) as error:
            log.debug("metrics request failed: %s", error)
        finally:
            writer.close()

    async def _respond(self, request: bytes) -> bytes:
        method = request.partition(b" ")[0]
        if method not in (b"GET", b"HEAD"):
            return b"HTTP/1.1 405 Method Not Allowed\r\nContent-Length: 0\r\n\r\n"
        host = HOST.search(request)
        if host is not None and not names_loopback(host[1].decode("latin-1")):
            return b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n"
        pieces = []
        for piece in self._text():
            # All pieces take some milliseconds, so telemetry is processed between two.
            await asyncio.sleep(0)
            pieces.append(piece.encode())
        await asyncio.sleep(0)
        body = b"".join(pieces)
        head = (
            f"HTTP/1.1 200 OK\r\nContent-Type: {CONTENT_TYPE}\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        )
        return head.encode() + (body if method == b"GET" else b"")
