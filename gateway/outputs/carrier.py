"""Carriers of an output's bytes: UDP, TCP, TLS, a listening port, or a serial line.

Outputs are slow and periodic, so the transports of asyncio serve: a peer that does not keep up
loses whole messages, and the next ones are newer.
"""

import asyncio
import os
import ssl
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final

import serial

from gateway.hub.endpoint import Endpoint, EndpointKind, parse_endpoint
from gateway.printable import reason_of

MAX_WAITING_BYTES: Final = 8192
"""Some seconds of an output; a peer for which more waits is sent no more meanwhile."""
TLS: Final = "tls"
LISTEN: Final = EndpointKind.TCP_LISTEN
DATAGRAMS: Final = frozenset(
    {EndpointKind.UDP, EndpointKind.UDP_BROADCAST, EndpointKind.UDP_MULTICAST}
)
CONNECT_LIMIT_S: Final = 10.0


def target_of(location: str, kinds: Collection[str]) -> tuple[str, Endpoint]:
    """Read the carrier and its address from the rest of an output's URL, as `udp:HOST:PORT`.

    Raises ValueError if it is none of `kinds`.
    """
    word, _, rest = location.partition(":")
    inner = parse_endpoint(f"tcp:{rest}" if word == TLS else location)
    kind = TLS if word == TLS else inner.kind
    if kind not in kinds:
        raise ValueError(f"{location!r} is not carried by one of {', '.join(sorted(kinds))}")
    return kind, inner


class Carrier:
    """Carry bytes to all present peers of one target, such as `tcp-listen:127.0.0.1:10110`.

    It may be one of `kinds`, and a listening port has at most `max_clients`. `on_state` is called
    with a state and its reason when they change, and `tls` makes the context of TLS.
    """

    def __init__(
        self,
        location: str,
        kinds: Collection[str],
        on_state: Callable[[str, Exception | None], None],
        max_clients: int,
        tls: Callable[[], ssl.SSLContext] = ssl.create_default_context,
    ) -> None:
        self._kind, self._inner = target_of(location, kinds)
        self._on_state, self._max_clients, self._tls = on_state, max_clients, tls
        self._peers: set[Any] = set()
        self._server: asyncio.Server | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is open, or is being opened."""
        return bool(self._peers or self._server or self._task)

    @property
    def port(self) -> int:
        """The port that is bound, or 0."""
        return self._server.sockets[0].getsockname()[1] if self._server else 0

    def open(self) -> None:
        """Open it; the state is reported."""
        self._task = asyncio.get_running_loop().create_task(self._open())

    def send(self, data: bytes) -> tuple[int, int]:
        """Send to every peer that has room; return how many have and have not."""
        free = [peer for peer in self._peers if peer.get_write_buffer_size() <= MAX_WAITING_BYTES]
        for peer in free:
            (peer.sendto if self._kind in DATAGRAMS else peer.write)(data)
        return len(free), len(self._peers) - len(free)

    def close(self) -> None:
        """Close all connections."""
        if self._task is not None:
            self._task.cancel()
        if self._server is not None:
            self._server.close()
            self._server = None
        for peer in list(self._peers):
            self._peers.discard(peer)
            peer.abort()

    async def _open(self) -> None:
        try:
            async with asyncio.timeout(CONNECT_LIMIT_S):
                await self._connect(asyncio.get_running_loop())
        except ConnectionRefusedError:
            self._on_state("refused", None)
        except (OSError, ValueError, ssl.CertificateError) as error:
            # An invalid name raises a ValueError.
            self._on_state("unreachable", error)
        else:
            self._on_state("open", None)
        finally:
            self._task = None

    async def _connect(self, loop: asyncio.AbstractEventLoop) -> None:
        host, port = self._inner.host, self._inner.port
        if self._kind == EndpointKind.SERIAL:
            self.add(SerialLine(host, port, self.lose))
        elif self._kind == LISTEN:
            self._server = await loop.create_server(lambda: _Link(self), host, port)
        elif self._kind in DATAGRAMS:
            is_broadcast = self._kind == EndpointKind.UDP_BROADCAST
            await loop.create_datagram_endpoint(
                lambda: _Link(self), remote_addr=(host, port), allow_broadcast=is_broadcast
            )
        else:
            context = self._tls() if self._kind == TLS else None
            await loop.create_connection(lambda: _Link(self), host, port, ssl=context)

    def add(self, peer: Any) -> None:
        """Add a connection, if there is room."""
        if len(self._peers) >= self._max_clients:
            peer.abort()
        else:
            self._peers.add(peer)

    def lose(self, peer: Any, error: Exception | None) -> None:
        """Note the end of a connection."""
        if peer in self._peers:
            self._peers.discard(peer)
            if self._server is None:
                self._on_state("unreachable", error or ConnectionError("the peer hung up"))

    def refuse(self, error: Exception) -> None:
        """Note that nobody listens where datagrams are sent to."""
        self._on_state("open", ConnectionError(f"nobody listens there: {reason_of(error)}"))


class _Link(asyncio.Protocol, asyncio.DatagramProtocol):
    """One connection; received bytes are discarded."""

    def __init__(self, carrier: Carrier) -> None:
        self._carrier = carrier
        self._transport: Any = None

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        self._carrier.add(transport)

    def connection_lost(self, error: Exception | None) -> None:
        self._carrier.lose(self._transport, error)

    def error_received(self, error: Exception) -> None:
        self._carrier.refuse(error)


class SerialLine:
    """A serial port that is only written; bytes that it has no room for wait here.

    Not a pipe of the event loop: uvloop closes its descriptor, which pyserial then closes again.

    Raises OSError or ValueError if it cannot be opened.
    """

    def __init__(
        self, device: str, baud: int, lose: Callable[[Any, Exception | None], None]
    ) -> None:
        self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        self._lose = lose
        self._waiting = b""

    def get_write_buffer_size(self) -> int:
        """Return the number of bytes that wait."""
        return len(self._waiting)

    def write(self, data: bytes) -> None:
        """Write as much as there is room for."""
        self._waiting += data
        try:
            self._waiting = self._waiting[os.write(self._port.fileno(), self._waiting) :]
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(self, error)
            self.abort()

    def abort(self) -> None:
        """Close the port."""
        self._port.close()


def client_context(authority: str, certificate: str, key: str) -> ssl.SSLContext:
    """Return the context of TLS to a server, with a certificate of our own if one is given.

    Raises OSError if a file cannot be read or is invalid.
    """
    cafile = str(Path(authority).expanduser()) if authority else None
    context = ssl.create_default_context(cafile=cafile)
    if certificate:
        own_key = Path(key).expanduser() if key else None
        context.load_cert_chain(Path(certificate).expanduser(), own_key)
    return context
