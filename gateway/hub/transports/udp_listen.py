"""A UDP port that serves every peer that sends MAVLink to it.

The port's own socket receives only from unknown peers: each new client gets a connected socket on
the same port, which the kernel prefers for that client's datagrams. `SO_REUSEPORT` allows that,
and is set only after the bind, so that a second gateway on the same port still gets an error. The
new socket is read only after all datagrams that waited in the port's own: so a client's frames stay
in order.

Clients are identified only by the addresses they send from. One is removed after a timeout; one
that returns on another port (a restarted ground station) replaces its old entry as soon as that has
missed a few heartbeats, so that no client is served twice.
"""

import asyncio
import itertools
import math
import socket
from contextlib import suppress
from typing import Final, NamedTuple

from gateway.hub.endpoint import Endpoint, host_and_port, is_of_this_machine
from gateway.hub.forwarding_step import MAX_DATAGRAM, READS
from gateway.hub.transports.base import RETRY_US, STALE_AFTER_US, Client, HubContext
from gateway.hub.transports.datagram import (
    IP_PKTINFO,
    Address,
    DatagramPeer,
    gone_clients,
    local_host_of,
)
from gateway.hub.transports.listener import Listener, crowded_host
from gateway.hub.transports.sockets import bound_socket
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import DatagramSplitter, MavFrame

ANCILLARY_BYTES: Final = 64
LEAST_WAITING_BYTES: Final = 512
"""Memory that the kernel counts for a waiting datagram at least: that of its own records."""
REMOVALS: Final = 32
"""Maximum dead clients removed at one tick; those left until the next cost nothing."""


class _Held(NamedTuple):
    """State of a new client whose own socket is not read yet."""

    read_until: int
    """Number of datagrams of the port's socket after which none of them is the client's."""
    first: list[tuple[bytes, Address]]
    """Datagrams of any peer that arrived before its socket was connected, or soon after."""
    local_host: str


class UdpListener(Listener[DatagramPeer]):
    """The listening port and its clients."""

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        super().__init__(context, endpoint)
        self._by_address: dict[Address, DatagramPeer] = {}
        self._full_until_us = 0
        """Until then no client of a full port can have become stale."""
        self._splitter = DatagramSplitter()
        """Splitter for peers that have not sent a complete frame yet."""
        self._received = self._most_waiting = 0
        """Datagrams of the port's own socket: read so far, and the most that may wait in it."""
        self._held: dict[DatagramPeer, _Held] = {}
        self._next: asyncio.Handle | None = None

    def tick(self, now_us: int) -> None:
        """Bind again if that failed, and remove clients that have gone."""
        super().tick(now_us)
        if self._socket is not None and now_us >= self._retry_us:
            # Whether the next client can be admitted is decided when it arrives.
            self.reason, self._retry_us = "", now_us + RETRY_US
        clients = self._by_address.values()
        idle_us = round(self._context.settings.idle_timeout_s * US_PER_S)
        dead = itertools.islice((each for each in clients if each.has_died(now_us)), REMOVALS)
        for client in dict.fromkeys([*dead, *gone_clients(clients, idle_us, now_us)]):
            self.leave(client)

    def leave(self, client: Client) -> None:
        """Remove one client."""
        assert isinstance(client, DatagramPeer)
        self._by_address.pop(client.address, None)
        self._held.pop(client, None)
        super().leave(client)

    def _bind(self) -> socket.socket:
        sock = bound_socket((self.endpoint.host, self.endpoint.port), shared=False)
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, IP_PKTINFO, 1)
        return sock

    def _watch(self, sock: socket.socket) -> None:
        most_bytes = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self._most_waiting = most_bytes // LEAST_WAITING_BYTES
        self._loop.add_reader(sock, self._on_readable, sock)

    def _on_readable(self, sock: socket.socket) -> None:
        if self._next is None:
            self._read(sock)

    def _read(self, sock: socket.socket) -> None:
        """Process datagrams of new clients, and at most one of another peer."""
        self._next = None
        if self._socket is not sock:
            return
        size, is_client, is_empty = 0, True, False
        while is_client and size < self._context.read_bytes:
            try:
                data, ancillary, flags, address = sock.recvmsg(MAX_DATAGRAM, ANCILLARY_BYTES)
            except OSError:
                is_empty = True
                break
            self._received += 1
            size += max(len(data), 1)
            # To admit a client takes as long as to serve the others several times.
            is_client = address[:2] in self._by_address
            self._accept(data, address, local_host_of(ancillary))
            if flags & socket.MSG_TRUNC and (sender := self._by_address.get(address[:2])):
                sender.counters.cut += 1
        read = math.inf if is_empty else self._received
        due = itertools.takewhile(lambda each: each[1].read_until <= read, self._held.items())
        for client, held in [*due]:
            self._release(client, held)
        if self._held:
            self._next = self._loop.call_soon(self._read, sock)

    def _release(self, client: DatagramPeer, held: _Held) -> None:
        """Read a new client's own socket from now on."""
        self._held.pop(client, None)
        for data, address in held.first:
            self._accept(data, address, held.local_host)
        client.begin_reading()

    def _accept(self, data: bytes, address: Address, local_host: str) -> None:
        now_us = self._context.now_us()
        if client := self._by_address.get(address[:2]):
            client.accept_rest(data, now_us)
            return
        events = self._splitter.feed(data, now_us, address[:2])
        first = next((event for event in events if isinstance(event, MavFrame)), None)
        client = self._admit(first, address, local_host, now_us) if first is not None else None
        if client is not None:
            client.receive(events, len(data), now_us)

    def _admit(
        self, first: MavFrame, address: Address, local_host: str, now_us: int
    ) -> DatagramPeer | None:
        """Admit a new client, which has sent a frame, if there is room."""
        if not self._has_room(str(address[0]), now_us):
            self.turned_away += 1
            return None
        try:
            sock = bound_socket((local_host, self.port), shared=True)
        except OSError as error:
            self._report(error)
            return None
        try:
            sock.connect(address)
        except OSError:
            # There is no route to the claimed address.
            sock.close()
            return None
        self._report(None)
        peer, client_id = host_and_port(*address[:2]), self._context.new_client_id()
        client = DatagramPeer(
            self._context, client_id, self.endpoint, peer, self.endpoint.name_of(peer)
        )
        client.identity, client.address = first.origin, address[:2]
        client.splitter = self._splitter.split_off(client.address)
        self._clients[client_id] = self._by_address[client.address] = client
        client.adopt(sock, is_read=False)
        if is_of_this_machine(client.host, local_host):
            client.prove()
        self._context.appear(client)
        self._context.greet(client_id)
        read_until = self._received + self._most_waiting
        self._held[client] = _Held(read_until, _waiting_in(sock, address), local_host)
        return client

    def _has_room(self, host: str, now_us: int) -> bool:
        """Return whether there is room; cheap while the port is full of live clients."""
        most = self._context.settings.max_clients
        is_full = len(self._clients) >= most
        if is_full and now_us < self._full_until_us:
            return False
        has_room = super()._has_room(host, now_us)
        if not has_room and crowded_host(self._clients.values(), most) is None:
            stalest_us = min(client.last_us for client in self._clients.values())
            self._full_until_us = stalest_us + STALE_AFTER_US
        return has_room


def _waiting_in(sock: socket.socket, peer: Address) -> list[tuple[bytes, Address]]:
    """Return the datagrams that have arrived at a socket, and their senders."""
    found = []
    with suppress(OSError):
        for _ in range(READS):
            data, address = sock.recvfrom(MAX_DATAGRAM)
            found.append((data, address or peer))
    return found
