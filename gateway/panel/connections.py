"""Connections to the panel: slots by role, header timeouts, and clients that do not read.

Any client can open connections and send nothing. A connection has no holder until a request on it
has passed access control; see `Slots` for the limits. Each must send a complete request header
in time, of a limited size.
"""

import asyncio
import logging
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from gateway.hub.transports.sockets import accept_each
from gateway.panel.admission import Holder, Slots, address_group

log = logging.getLogger(__name__)

CONNECTIONS_OF_SESSION: Final = 48
"""Maximum connections of a session; a page needs up to eight."""
CONNECTIONS_OF_ADDRESS: Final = 64
CONNECTIONS_OF_ROLE: Final = 128
"""Maximum connections of operators, of viewers, and of clients that have not logged in, each."""
HEADER_S: Final = 10.0
"""Timeout of a TLS handshake, and of a complete request header."""
MAX_HEADER: Final = 1 << 16
"""Maximum bytes of a request header; browsers send less than 8 kB."""
BACKLOG: Final = 128
Client = tuple[str, int]
"""Address and port of a peer."""


class ConnectionLimits:
    """The open connections."""

    def __init__(self) -> None:
        self._sockets: dict[Client, socket.socket] = {}
        self._slots: Slots[Client] = Slots(
            CONNECTIONS_OF_SESSION, CONNECTIONS_OF_ADDRESS, CONNECTIONS_OF_ROLE, self.shut
        )

    def admit(self, client: Client, sock: socket.socket) -> None:
        """Add a connection; an older one without a holder may be closed for it."""
        for other in [other for other, each in self._sockets.items() if each.fileno() < 0]:
            del self._sockets[other]
            self._slots.release(other)
        self._sockets[client] = sock
        self._slots.admit(client, Holder(None, "", address_group(client[0])))

    def authenticate(self, client: Client, holder: Holder) -> None:
        """Set the holder of a connection on which a request has passed access control."""
        if client in self._sockets and self._slots.holder(client) != holder:
            self._slots.admit(client, holder)

    def shut(self, client: Client) -> None:
        """Close a connection, and discard data that waits to be sent."""
        sock = self._sockets.pop(client, None)
        self._slots.release(client)
        with suppress(OSError):
            # The peer may have closed it already.
            if sock is not None:
                sock.shutdown(socket.SHUT_RDWR)


class LimitedProtocol(HttpToolsProtocol):
    """HTTP with a limit of time and size for the header of a request."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self._header_timer: asyncio.TimerHandle | None = None
        self._header_bytes = self._headers = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit of the first header."""
        super().connection_made(transport)
        self._await_header()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the time limit."""
        self._note_header()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse data; close the connection if a header is too long."""
        waits, headers = self._header_timer is not None, self._headers
        super().data_received(data)
        # Only data within one header counts: other data may contain the end of the previous body,
        # or the beginning of the next.
        if waits and self._header_timer is not None and self._headers == headers:
            self._header_bytes += len(data)
            if self._header_bytes > MAX_HEADER:
                self.transport.abort()

    def on_message_begin(self) -> None:
        """Start the time limit of a header."""
        super().on_message_begin()
        if self._header_timer is None:
            self._await_header()

    def on_headers_complete(self) -> None:
        """Stop the time limit of a header; refuse one that is too long."""
        self._headers += 1
        self._note_header()
        if len(self.url) + sum(len(name) + len(value) for name, value in self.headers) > MAX_HEADER:
            raise ValueError(f"a header has at most {MAX_HEADER} bytes")
        super().on_headers_complete()

    def _await_header(self) -> None:
        self._header_bytes = 0
        self._header_timer = self.loop.call_later(HEADER_S, self.transport.abort)

    def _note_header(self) -> None:
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None


class LimitedServer(uvicorn.Server):
    """A server that accepts connections within the limits."""

    def __init__(self, config: uvicorn.Config, limits: ConnectionLimits) -> None:
        super().__init__(config)
        self._limits = limits
        self._opening: set[asyncio.Task[None]] = set()

    async def serve_on(self, sock: socket.socket, on_open: Callable[[], None]) -> None:
        """Serve on a bound socket until `should_exit` is set.

        uvicorn's own `serve` handles the signals of the process, and accepts without a limit.
        """
        self.lifespan = self.config.lifespan_class(self.config)
        await self.startup(sockets=[])
        sock.setblocking(False)
        sock.listen(BACKLOG)
        accept_each(sock, self._admit, _report)
        on_open()
        try:
            await self.main_loop()
        finally:
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()
            await self.shutdown(sockets=[])

    def _admit(self, connection: socket.socket, address: Any) -> None:
        connection.setblocking(False)
        self._limits.admit((str(address[0]), int(address[1])), connection)
        task = asyncio.get_running_loop().create_task(self._open(connection))
        self._opening.add(task)
        task.add_done_callback(self._opening.discard)

    async def _open(self, connection: socket.socket) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                self._protocol,
                connection,
                ssl=self.config.ssl,
                ssl_handshake_timeout=HEADER_S if self.config.ssl else None,
            )
        except (OSError, ssl.SSLError, asyncio.IncompleteReadError) as error:
            log.debug("a connection failed: %s", error)
            connection.close()

    def _protocol(self) -> asyncio.Protocol:
        return LimitedProtocol(
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )


def _report(error: OSError | None) -> None:
    if error is None:
        log.info("connections are accepted again")
    else:
        log.warning("connections cannot be accepted: %s", error)
