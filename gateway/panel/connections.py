"""Connections to the panel: limits for clients that have not logged in, and header timeouts.

Any client can open connections and send nothing. A connection counts as *anonymous* until a request
on it has passed access control. Anonymous connections are limited per address and in total, beyond
which the oldest one is closed, so connections remain for users; and each must send a complete
request header in time, of a limited size.
"""

import asyncio
import ipaddress
import logging
import socket
import ssl
from collections.abc import Callable
from typing import Any, Final

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from gateway.hub.transports.stream import accept_each

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 256
"""Of all clients; a page needs up to eight."""
MAX_ANONYMOUS: Final = 128
MAX_ANONYMOUS_OF_ADDRESS: Final = 64
"""A user behind the same address still gets in: the oldest ones are closed first."""
HEADER_S: Final = 10.0
"""Longest time for a TLS handshake, and for a complete request header."""
MAX_HEADER: Final = 1 << 16
"""Bytes of a request header; browsers send less than 8 kB."""
BACKLOG: Final = 128
IPV6_PREFIX: Final = 64
"""Bits of the network that one IPv6 subscriber usually gets."""

Client = tuple[str, int]
"""Address and port of a peer."""


def address_group(host: str) -> str:
    """Return the key by which an address is limited: itself, or the network of an IPv6 one."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, IPV6_PREFIX), strict=False))


class ConnectionLimits:
    """The open connections, and which of them are anonymous."""

    def __init__(self) -> None:
        self._anonymous: dict[Client, socket.socket] = {}
        self._known: dict[Client, socket.socket] = {}
        self.refused = 0
        """Connections that were closed to keep to the limits."""

    def admit(self, client: Client, sock: socket.socket) -> bool:
        """Add a connection; the oldest anonymous one may be closed for it."""
        self._remove_closed()
        group = address_group(client[0])
        of_group = [other for other in self._anonymous if address_group(other[0]) == group]
        if len(of_group) >= MAX_ANONYMOUS_OF_ADDRESS:
            self._evict(of_group[0])
        elif len(self._anonymous) >= MAX_ANONYMOUS or (
            self._anonymous and len(self._anonymous) + len(self._known) >= MAX_CONNECTIONS
        ):
            self._evict(next(iter(self._anonymous)))
        if len(self._anonymous) + len(self._known) >= MAX_CONNECTIONS:
            self.refused += 1
            return False
        self._anonymous[client] = sock
        return True

    def authenticate(self, client: Client) -> None:
        """Note that a request of a connection has passed access control."""
        if (sock := self._anonymous.pop(client, None)) is not None:
            self._known[client] = sock

    def _evict(self, client: Client) -> None:
        self.refused += 1
        sock = self._anonymous.pop(client)
        try:
            sock.shutdown(socket.SHUT_RDWR)
        except OSError:
            # The peer has closed it already.
            return

    def _remove_closed(self) -> None:
        for table in (self._anonymous, self._known):
            for client in [client for client, sock in table.items() if sock.fileno() < 0]:
                del table[client]


class LimitedProtocol(HttpToolsProtocol):
    """HTTP with a limit of time and size for the header of a request."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self._header_timer: asyncio.TimerHandle | None = None
        self._header_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit of the first header."""
        super().connection_made(transport)
        self._await_header()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the time limit."""
        self._note_header()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse data, unless a header is too long."""
        if self._header_timer is not None:
            self._header_bytes += len(data)
            if self._header_bytes > MAX_HEADER:
                self.transport.abort()
                return
        super().data_received(data)

    def on_message_begin(self) -> None:
        """Start the time limit of a header."""
        super().on_message_begin()
        if self._header_timer is None:
            self._await_header()

    def on_headers_complete(self) -> None:
        """Stop the time limit of a header."""
        self._note_header()
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

        uvicorn's own `serve` takes over the signals of the process, and accepts without a limit.
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
        if not self._limits.admit((str(address[0]), int(address[1])), connection):
            connection.close()
            return
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
