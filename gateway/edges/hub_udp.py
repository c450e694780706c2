"""UDP to clients: one connected socket for each that is configured, one port for all that call.

A connected socket costs a fifth less per datagram than an addressed one, and the kernel reports an
ICMP refusal on exactly the socket that it concerns.
"""

import asyncio
import logging
import socket
from typing import Final, Protocol

from gateway.edges.hub_link import Link, is_loopback
from gateway.routing.clients import ClientTable, Presence
from gateway.routing.endpoint import Endpoint
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import SplitFault, origin_of, split_datagram

log = logging.getLogger(__name__)

MAX_DATAGRAM: Final = 65535
READ_BUDGET: Final = 64
"""Datagrams taken at one wake-up, so that one flooding peer cannot starve the others."""
RETRY_US: Final = US_PER_S
"""Between attempts to open a socket again: soon for a person, never spinning."""
RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""The default holds only about 256 small datagrams; a parameter upload bursts more."""


class HubContext(Protocol):
    """What a transport asks of the hub."""

    def now_us(self) -> int:
        """Return the gateway time."""

    def deliver(self, link: Link, frame: bytes) -> None:
        """Take one received frame."""

    def appear(self, link: Link) -> None:
        """Let a link take part and greet it."""

    def vanish(self, link: Link) -> None:
        """Forget a link."""

    def new_client_id(self) -> int:
        """Return an id that no client had before."""


class UdpLink(Link):
    """A UDP peer at a fixed address."""

    __slots__ = ("_context", "_failing", "_loop", "_port", "_retry_us", "_socket", "_task")

    def __init__(self, context: HubContext, client_id: int, endpoint: Endpoint) -> None:
        super().__init__(
            client_id=client_id,
            endpoint=endpoint,
            remote=f"{endpoint.host}:{endpoint.port}",
            trusted=endpoint.trusted is not False,
            since_us=context.now_us(),
            name=endpoint.name,
            state="resolving",
        )
        self._context = context
        self._loop = asyncio.get_running_loop()
        self._socket: socket.socket | None = None
        self._port = 0
        self._retry_us = 0
        self._failing = False
        self._task: asyncio.Task[None] | None = None
        self.tick(context.now_us())

    def transmit(self, frame: bytes, message_id: int) -> None:  # noqa: ARG002
        """Send one frame; count it as dropped if the network does not take it."""
        sock = self._socket
        counters = self.counters
        if sock is None:
            counters.dropped += 1
            return
        try:
            sock.send(frame)
        except OSError as error:
            if not self._sent_after_all(sock, frame, error):
                counters.dropped += 1
                return
        counters.sent += 1
        counters.bytes_sent += len(frame)

    def tick(self, now_us: int) -> None:
        """Open the socket again if it failed; call a refusal off that was not repeated."""
        if now_us < self._retry_us:
            return
        self._retry_us = now_us + RETRY_US
        if self._failing:
            self._failing = False
            if self.state == "unreachable":
                self._drop_socket()
        elif self._socket is not None:
            self.state = "open"
        if self._socket is None and self._task is None:
            self._task = self._loop.create_task(self._open())

    def close(self) -> None:
        """Close the socket and stop resolving."""
        if self._task is not None:
            self._task.cancel()
        self._drop_socket()

    async def _open(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        try:
            found = await self._loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            family, _, _, _, address = found[0]
            self._socket = self._connected(family, address)
            self.state = "open"
            self.remote = f"{address[0]!s}:{address[1]!s}"
            self._loop.add_reader(self._socket, self._on_readable)
        except socket.gaierror:
            self.state = "resolving"
        except OSError:
            self.state = "unreachable"
        finally:
            self._task = None

    def _connected(self, family: int, address: tuple[object, ...]) -> socket.socket:
        """Open a socket that keeps the port it had, so that the peer sees the same client."""
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            sock.bind(("", self._port))
            sock.connect(address)
        except OSError:
            sock.close()
            self._port = 0
            raise
        self._port = sock.getsockname()[1]
        return sock

    def _drop_socket(self) -> None:
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _sent_after_all(self, sock: socket.socket, frame: bytes, error: OSError) -> bool:
        """Judge a failed send; a refusal belongs to an earlier datagram, so this one may go."""
        if isinstance(error, BlockingIOError):
            return False
        self._failing = True
        if not isinstance(error, ConnectionRefusedError):
            self.state = "unreachable"
            return False
        self.state = "refused"
        try:
            sock.send(frame)
        except OSError:
            return False
        return True

    def _on_readable(self) -> None:
        sock = self._socket
        for _ in range(READ_BUDGET):
            if sock is None:
                return
            try:
                data = sock.recv(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                self._failing = True
                refused = isinstance(error, ConnectionRefusedError)
                self.state = "refused" if refused else "unreachable"
                return
            self.state = "open"
            now_us = self._context.now_us()
            self.receive(split_datagram(data), len(data), now_us, self._context.deliver)


class UdpPeer(Link):
    """A client of a listening port."""

    __slots__ = ("_address", "_socket")

    def __init__(
        self,
        context: HubContext,
        presence: Presence,
        listener: Endpoint,
        sock: socket.socket,
        address: tuple[str | int, ...],
    ) -> None:
        host, port = presence.address
        super().__init__(
            client_id=presence.client_id,
            endpoint=listener,
            remote=f"{host}:{port}",
            trusted=is_loopback(host) if listener.trusted is None else listener.trusted,
            since_us=context.now_us(),
            name=f"{host}:{port}",
        )
        self._socket = sock
        self._address = address

    def transmit(self, frame: bytes, message_id: int) -> None:  # noqa: ARG002
        """Send one frame; count it as dropped if the network does not take it."""
        counters = self.counters
        try:
            self._socket.sendto(frame, self._address)
        except OSError as error:
            counters.dropped += 1
            if not isinstance(error, BlockingIOError):
                self.state = "unreachable"
            return
        counters.sent += 1
        counters.bytes_sent += len(frame)

    def tick(self, now_us: int) -> None:  # noqa: ARG002
        """Believe in the network again until the next failure."""
        self.state = "open"


class UdpListener:
    """A port that serves everybody who speaks MAVLink to it."""

    def __init__(
        self, context: HubContext, endpoint: Endpoint, max_clients: int, idle_timeout_us: int
    ) -> None:
        self.endpoint = endpoint
        self.table = ClientTable(max_clients, idle_timeout_us)
        self._context = context
        self._loop = asyncio.get_running_loop()
        self._links: dict[int, UdpPeer] = {}
        self._socket: socket.socket | None = None
        self._retry_us = 0
        self.tick(context.now_us())

    @property
    def port(self) -> int:
        """The port that is bound, or 0."""
        return self._socket.getsockname()[1] if self._socket else 0

    def tick(self, now_us: int) -> None:
        """Bind again if that failed, and part from clients that have gone."""
        if self._socket is None and now_us >= self._retry_us:
            self._retry_us = now_us + RETRY_US
            self._bind()
        for presence in self.table.expire(now_us):
            self._leave(presence)

    def close(self) -> None:
        """Part from all clients and close the port."""
        for link in self._links.values():
            self._context.vanish(link)
        self._links.clear()
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _bind(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            sock.bind((host, port))
        except OSError as error:
            sock.close()
            log.warning("cannot listen at %s: %s", self.endpoint.name, error)
            return
        self._socket = sock
        self._loop.add_reader(sock, self._on_readable, sock)

    def _on_readable(self, sock: socket.socket) -> None:
        for _ in range(READ_BUDGET):
            try:
                data, address = sock.recvfrom(MAX_DATAGRAM)
            except OSError:
                return
            self._take(sock, data, address)

    def _take(self, sock: socket.socket, data: bytes, address: tuple[str | int, ...]) -> None:
        events = split_datagram(data)
        place = (str(address[0]), int(address[1]))
        now_us = self._context.now_us()
        presence = self.table.find(place) or self._admit(sock, events, address, place, now_us)
        if presence is not None:
            presence.heard_us = now_us
            link = self._links[presence.client_id]
            link.receive(events, len(data), now_us, self._context.deliver)

    def _admit(
        self,
        sock: socket.socket,
        events: list[bytes | SplitFault],
        address: tuple[str | int, ...],
        place: tuple[str, int],
        now_us: int,
    ) -> Presence | None:
        """Take in a new client if what it says is MAVLink and there is room."""
        first = next((event for event in events if isinstance(event, bytes)), None)
        if first is None:
            return None
        presence, leaver = self.table.admit(place, self._context.new_client_id(), now_us)
        if leaver is not None:
            self._leave(leaver)
        if presence is not None:
            presence.identity = origin_of(first)
            link = UdpPeer(self._context, presence, self.endpoint, sock, address)
            self._links[presence.client_id] = link
            self._context.appear(link)
        return presence

    def _leave(self, presence: Presence) -> None:
        self._context.vanish(self._links.pop(presence.client_id))
