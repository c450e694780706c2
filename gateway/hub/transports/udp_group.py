"""UDP broadcast and multicast: one datagram for all receivers.

Two sockets. One sends and receives the unicast answers; the other has joined a multicast group and
receives the datagrams of others. It also receives our own, which are recognised by the address of
the first.
"""

import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from gateway.hub.endpoint import EndpointKind
from gateway.hub.transports.datagram import Address, DatagramClient
from gateway.hub.transports.sockets import new_socket

MULTICAST_HOPS: Final = 1
"""Hop limit of multicast datagrams: the local network only."""


class GroupClient(DatagramClient):
    """A broadcast address or a multicast group as one client."""

    _listening: socket.socket | None = None
    _own_address = ("", 0)

    def tick(self, now_us: int) -> None:
        """Open the sockets again if they failed."""
        if not self._is_retry_due(now_us):
            return
        if self.state == "unreachable":
            self.close()
        if self._socket is None:
            self._open()

    def close(self) -> None:
        """Close both sockets."""
        super().close()
        if self._listening is not None:
            self.loop.remove_reader(self._listening)
            self._listening.close()
            self._listening = None

    def _open(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        multicast = self.endpoint.kind is EndpointKind.UDP_MULTICAST
        try:
            flags = socket.AI_NUMERICHOST
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=flags)
            family, _, _, _, address = found[0]
            with new_socket(family, socket.SOCK_DGRAM) as sock:
                if multicast:
                    self._listening = _listening_socket(family, address)
                    self.loop.add_reader(self._listening, self._read_each, self._listening)
                    _prepare_sender(sock, address)
                else:
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                host, _, *scope = _route_source(family, address)
                sock.bind((host, 0, *scope))
        except OSError as error:
            self.close()
            self.become("unreachable", error)
            return
        self._own_address = sock.getsockname()[:2]
        self.adopt(sock, lambda data: sock.sendto(data, address))

    def _reader(self, sock: socket.socket) -> Callable[[], None]:
        # The compiled step does not distinguish senders.
        return partial(self._read_each, sock)

    def _accept_from(self, data: bytes, address: Address) -> None:
        if address[:2] != self._own_address:
            self.accept_rest(data, self.context.now_us(), address[:2])


def _route_source(family: int, address: tuple[object, ...]) -> tuple[Any, ...]:
    """Return our socket address from which the group is reached."""
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        probe.connect(address)
        return tuple(probe.getsockname())


def _prepare_sender(sock: socket.socket, address: tuple[object, ...]) -> None:
    if sock.family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, MULTICAST_HOPS)
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, int(str(address[3])))
    else:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, MULTICAST_HOPS)


def _listening_socket(family: int, address: tuple[object, ...]) -> socket.socket:
    """Open a socket that has joined the group."""
    with new_socket(family, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)
        group = socket.inet_pton(family, str(address[0]).partition("%")[0])
        if family == socket.AF_INET6:
            member = group + struct.pack("=I", address[3])
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, member)
        else:
            source = socket.inet_aton(_route_source(family, address)[0])
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + source)
        return sock
