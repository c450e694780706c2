"""UDP to a single peer, on a connected socket.

A connected socket costs a fifth less per datagram than `sendto`, the kernel reports an ICMP
refusal on the socket that it concerns, and with its own send buffer a peer behind a slow interface
does not fill that of others.
"""

import asyncio
import socket
from typing import Any, Final

from gateway.hub.endpoint import host_and_port, is_numeric
from gateway.hub.transports.base import RETRY_US
from gateway.hub.transports.datagram import DatagramClient
from gateway.hub.transports.sockets import RECEIVE_BUFFER_BYTES, new_socket
from gateway.units import US_PER_S

RESOLVE_AGAIN_US: Final = 60 * US_PER_S
"""Interval of look-ups: names of home networks change their address a few times a day at most."""


class UdpClient(DatagramClient):
    """A UDP peer at a configured address.

    A name may resolve only later, or to another address later: it is resolved again while nothing
    is received from there. Of several addresses, as `localhost` has, the next is tried when one
    refuses.
    """

    _port = 0
    _resolve_us = 0
    _task: asyncio.Task[None] | None = None

    def __post_init__(self) -> None:
        """Start without an address."""
        super().__post_init__()
        self._addresses: list[tuple[int, tuple[Any, ...]]] = []
        self.become("resolving")

    def tick(self, now_us: int) -> None:
        """Open the socket or look the name up again; clear a refusal that was not repeated."""
        if not self._is_retry_due(now_us):
            return
        if self.state == "unreachable":
            super().close()
        if self.refused_us is not None:
            if len(self._addresses) > 1:
                self._addresses.append(self._addresses.pop(0))
                self._connect()
            elif now_us - self.refused_us >= RETRY_US:
                self._revive()
        if self._task is None and (self._socket is None or self._wants_look_up(now_us)):
            self._resolve_us = now_us + RESOLVE_AGAIN_US
            self._task = self.loop.create_task(self._open())

    def close(self) -> None:
        """Close the socket and stop resolving."""
        if self._task is not None:
            self._task.cancel()
        super().close()

    def _wants_look_up(self, now_us: int) -> bool:
        idle = self.heard_us is None or now_us - self.heard_us > RESOLVE_AGAIN_US
        return idle and now_us >= self._resolve_us and not is_numeric(self.endpoint.host)

    async def _open(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        try:
            found = await self.loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except (OSError, ValueError) as error:
            # An invalid name raises a ValueError.
            if self._socket is None:
                self.become("resolving", error)
        else:
            self._addresses = [(family, address) for family, _, _, _, address in found]
            known = {host_and_port(*address[:2]) for _, address in self._addresses}
            if self._socket is None or self.remote not in known:
                self._connect()
        finally:
            self._task = None

    def _connect(self) -> None:
        """Use the first address that has a route."""
        super().close()
        for family, address in self._addresses:
            try:
                sock = self._connected(family, address)
            except OSError as error:
                self.become("unreachable", error)
                continue
            self.remote = host_and_port(*address[:2])
            self.adopt(sock)
            return

    def _connected(self, family: int, address: tuple[Any, ...]) -> socket.socket:
        """Open a socket that keeps the port it had, so that the peer sees the same client."""
        port, self._port = self._port, 0
        with new_socket(family, socket.SOCK_DGRAM) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            sock.bind(("", port))
            sock.connect(address)
            self._port = sock.getsockname()[1]
            return sock
