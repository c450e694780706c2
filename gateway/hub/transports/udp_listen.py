"""A UDP port that serves everybody who sends MAVLink to it.

The port's own socket receives only from unknown peers: each new client gets a connected socket on
the same port, which the kernel prefers for that client's datagrams. `SO_REUSEPORT` allows that,
and is set only after the bind, so that a second gateway on the same port still fails loudly.
"""

import itertools
import socket
import struct
from typing import Final

from gateway.hub.client_table import SILENT_AFTER_US, ClientTable, Presence
from gateway.hub.endpoint import Endpoint, host_and_port
from gateway.hub.transports.base import READ_BYTES, HubContext
from gateway.hub.transports.listener import RETRY_US, Listener
from gateway.hub.transports.udp import (
    MAX_DATAGRAM,
    READ_BUDGET,
    RECEIVE_BUFFER_BYTES,
    DatagramClient,
)
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import origin_of, split_datagram

IP_PKTINFO: Final = 8
"""Not exported by `socket` before Python 3.14; gives the local address of a datagram."""
ANCILLARY_BYTES: Final = 64
PARTINGS: Final = 32
"""Dead clients removed at one tick; they cost nothing until then."""

Address = tuple[str | int, ...]


class UdpPeer(DatagramClient):
    """A client of a listening port."""

    def revive(self) -> None:
        """Note that the client is reachable after all."""
        self._end_hold()
        super().revive()

    def tick(self, now_us: int) -> None:
        """Clear a problem that was not repeated; retry a client that refused."""
        if self._socket is None:
            return
        self._end_hold()
        if self.refused_us is None or now_us - self.refused_us >= RETRY_US:
            self.become("open")

    def _note_refusal(self) -> None:
        """Stop sending until the next tick: a dead client costs more than a live one."""
        super()._note_refusal()
        if self.write == self._direct:
            self.write = self._hold

    def _hold(self, data: bytes) -> None:
        self.counters.unheard += 1
        self.counters.sent -= 1
        self.counters.bytes_sent -= len(data)

    def _end_hold(self) -> None:
        if self.write == self._hold:
            self.write = self._direct

    def has_died(self, now_us: int) -> bool:
        """Return whether it failed, or is silent and its machine reports a closed port."""
        if self._socket is None:
            return True
        heard_us = self.heard_us if self.heard_us is not None else self.since_us
        return self.refused_us is not None and now_us - heard_us >= SILENT_AFTER_US


class UdpListener(Listener[UdpPeer]):
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
        self._note_speakers()
        dead = (p for p in self.table.presences() if self._clients[p.client_id].has_died(now_us))
        for presence in itertools.islice(dead, PARTINGS):
            self.table.remove(presence)
            self._leave(presence)
        for presence in self.table.expire(now_us):
            self._leave(presence)

    def _bind(self) -> socket.socket:
        sock = _bound((self.endpoint.host, self.endpoint.port), shared=False)
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, IP_PKTINFO, 1)
        return sock

    def _watch(self, sock: socket.socket) -> None:
        self._loop.add_reader(sock, self._on_readable, sock)

    def _on_readable(self, sock: socket.socket) -> None:
        # One at a wake-up: admitting a stranger takes as long as serving the others several times.
        try:
            data, ancillary, _, address = sock.recvmsg(MAX_DATAGRAM, ANCILLARY_BYTES)
        except OSError:
            return
        self._take(data, address, _local_host(ancillary))

    def _take(self, data: bytes, address: Address, local_host: str) -> None:
        presence = self.table.find((str(address[0]), int(address[1])))
        if presence is None:
            presence = self._admit(data, address, local_host)
        if presence is not None:
            self._clients[presence.client_id].accept(data, self._context.now_us())

    def _admit(self, data: bytes, address: Address, local_host: str) -> Presence | None:
        """Admit a new client if it sends MAVLink and there is room."""
        first = next((event for event in split_datagram(data) if isinstance(event, bytes)), None)
        if first is None:
            return None
        now_us = self._context.now_us()
        if self.table.is_full(now_us):
            self.turned_away += 1
            return None
        host, port = str(address[0]), int(address[1])
        self._note_speakers()
        presence, leaver = self.table.admit((host, port), self._context.new_client_id(), now_us)
        if leaver is not None:
            self._leave(leaver)
        if presence is None:
            self.turned_away += 1
            return None
        try:
            sock = _bound((local_host, self.port), shared=True)
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
        presence.identity = origin_of(first)
        peer = host_and_port(host, port)
        client = UdpPeer(
            self._context, presence.client_id, self.endpoint, peer, self.endpoint.name_of(peer)
        )
        self._clients[presence.client_id] = client
        client.adopt(sock, sock.send)
        self._context.appear(client)
        self._context.greet(client)
        self._return_strays(sock, address, local_host)
        return presence

    def _note_speakers(self) -> None:
        """Update the table with when its clients, which have their own sockets, were last heard."""
        for presence in self.table.presences():
            presence.heard_us = self._clients[presence.client_id].heard_us or presence.heard_us

    def _return_strays(self, sock: socket.socket, peer: Address, local_host: str) -> None:
        """Process datagrams of others that came between bind and connect of a client's socket."""
        size = 0
        for _ in range(READ_BUDGET):
            try:
                data, address = sock.recvfrom(MAX_DATAGRAM)
            except OSError:
                return
            if size < READ_BYTES:
                self._take(data, address or peer, local_host)
            size += len(data)

    def _leave(self, presence: Presence) -> None:
        self.leave(self._clients[presence.client_id])


def _bound(place: tuple[str, int], *, shared: bool) -> socket.socket:
    family = socket.AF_INET6 if ":" in place[0] else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if shared:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        sock.bind(place)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    except OSError:
        sock.close()
        raise
    return sock


def _local_host(ancillary: list[tuple[int, int, bytes]]) -> str:
    """Return the address of ours that a datagram was sent to."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, IP_PKTINFO):
            return socket.inet_ntoa(struct.unpack("=I4s4s", data[:12])[1])
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO):
            host = socket.inet_ntop(socket.AF_INET6, data[:16])
            interface = struct.unpack("=I", data[16:20])[0]
            return f"{host}%{interface}" if host.startswith("fe80:") else host
    return ""
