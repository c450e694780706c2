"""A UDP port that serves every peer that sends MAVLink to it.

The port's own socket receives only from unknown peers: each new client gets a connected socket on
the same port, which the kernel prefers for that client's datagrams. `SO_REUSEPORT` allows that,
and is set only after the bind, so that a second gateway on the same port still gets an error.
"""

import itertools
import socket
from typing import Final

from gateway.hub.endpoint import Endpoint, host_and_port
from gateway.hub.limits import ClientTable, Presence
from gateway.hub.transports.base import READ_BYTES, RETRY_US, HubContext, Listener
from gateway.hub.transports.datagram import (
    IP_PKTINFO,
    MAX_DATAGRAM,
    READS,
    DatagramPeer,
    bound_socket,
    local_host_of,
)
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame, split_datagram

ANCILLARY_BYTES: Final = 64
REMOVALS: Final = 32
"""Dead clients removed at one tick; they cost nothing until then."""

Address = tuple[str | int, ...]


class UdpListener(Listener[DatagramPeer]):
    """The listening port and its clients."""

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        settings = context.settings
        self.table = ClientTable(settings.max_clients, round(settings.idle_timeout_s * US_PER_S))
        super().__init__(context, endpoint)

    def tick(self, now_us: int) -> None:
        """Bind again if that failed, and remove clients that have gone."""
        super().tick(now_us)
        if self._socket is not None and now_us >= self._retry_us:
            # Whether the next one can be admitted shows only when it comes.
            self.reason, self._retry_us = "", now_us + RETRY_US
        settings = self._context.settings
        self.table.max_clients = settings.max_clients
        self.table.idle_timeout_us = round(settings.idle_timeout_s * US_PER_S)
        self._update_table()
        dead = (p for p in self.table.presences() if self._clients[p.client_id].has_died(now_us))
        for presence in itertools.islice(dead, REMOVALS):
            self.table.remove(presence)
            self._leave(presence)
        for presence in self.table.expire(now_us):
            self._leave(presence)

    def _bind(self) -> socket.socket:
        sock = bound_socket((self.endpoint.host, self.endpoint.port), shared=False)
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, IP_PKTINFO, 1)
        return sock

    def _watch(self, sock: socket.socket) -> None:
        self._loop.add_reader(sock, self._on_readable, sock)

    def _on_readable(self, sock: socket.socket) -> None:
        # One at a wake-up: to admit a client takes as long as to serve the others several times.
        try:
            data, ancillary, _, address = sock.recvmsg(MAX_DATAGRAM, ANCILLARY_BYTES)
        except OSError:
            return
        self._accept(data, address, local_host_of(ancillary))

    def _accept(self, data: bytes, address: Address, local_host: str) -> None:
        presence = self.table.find((str(address[0]), int(address[1])))
        if presence is None:
            presence = self._admit(data, address, local_host)
        if presence is not None:
            self._clients[presence.client_id].accept(data, self._context.now_us())

    def _admit(self, data: bytes, address: Address, local_host: str) -> Presence | None:
        """Admit a new client if it sends MAVLink and there is room."""
        first = next((event for event in split_datagram(data) if isinstance(event, MavFrame)), None)
        if first is None:
            return None
        now_us = self._context.now_us()
        if self.table.is_full(now_us):
            self.turned_away += 1
            return None
        host, port = str(address[0]), int(address[1])
        self._update_table()
        presence, removed = self.table.admit((host, port), self._context.new_client_id(), now_us)
        if removed is not None:
            self._leave(removed)
        if presence is None:
            self.turned_away += 1
            return None
        try:
            sock = bound_socket((local_host, self.port), shared=True)
        except OSError as error:
            self._report(error)
            self.table.remove(presence)
            return None
        try:
            sock.connect(address)
        except OSError:
            # There is no route to the address that it claims.
            sock.close()
            self.table.remove(presence)
            return None
        self._report(None)
        presence.identity = first.origin
        peer = host_and_port(host, port)
        client = DatagramPeer(
            self._context, presence.client_id, self.endpoint, peer, self.endpoint.name_of(peer)
        )
        self._clients[presence.client_id] = client
        client.adopt(sock, sock.send)
        self._context.appear(client)
        self._context.greet(client)
        self._pass_on_others(sock, address, local_host)
        return presence

    def _update_table(self) -> None:
        """Update the table with when its clients, which have their own sockets, were last heard."""
        for presence in self.table.presences():
            presence.heard_us = self._clients[presence.client_id].heard_us or presence.heard_us

    def _pass_on_others(self, sock: socket.socket, peer: Address, local_host: str) -> None:
        """Process datagrams of others that arrived between bind and connect of a socket."""
        size = 0
        for _ in READS:
            try:
                data, address = sock.recvfrom(MAX_DATAGRAM)
            except OSError:
                return
            if size < READ_BYTES:
                self._accept(data, address or peer, local_host)
            size += len(data)

    def _leave(self, presence: Presence) -> None:
        self.leave(self._clients[presence.client_id])
