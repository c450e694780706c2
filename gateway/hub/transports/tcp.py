"""TCP connections that the gateway makes, and makes again when they break."""

import asyncio
import socket
from typing import Any

from gateway.hub.endpoint import host_and_port
from gateway.hub.transports.sockets import new_socket
from gateway.hub.transports.stream import StreamClient, StreamListener


class TcpClient(StreamClient):
    """A connection that the gateway makes, and remakes when it breaks."""

    _task: asyncio.Task[None] | None = None

    def tick(self, now_us: int) -> None:
        """Connect if there is no connection and the last attempt is long enough ago."""
        if self._socket is None and self._task is None and self._is_retry_due(now_us):
            self._task = self.loop.create_task(self._connect())

    def close(self) -> None:
        """Close the connection and stop connecting."""
        if self._task is not None:
            self._task.cancel()
        super().close()

    def _broke(self) -> None:
        super().close()
        self.become("connecting")

    async def _connect(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        try:
            found = await self.loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            for family, _, _, _, address in found:
                if await self._connect_to(family, address):
                    break
        except (OSError, ValueError) as error:
            # An invalid name raises a ValueError.
            self.become("resolving", error)
        finally:
            self._task = None

    async def _connect_to(self, family: int, address: tuple[Any, ...]) -> bool:
        try:
            with new_socket(family, socket.SOCK_STREAM) as sock:
                await self.loop.sock_connect(sock, address)
        except ConnectionRefusedError:
            self.become("refused")
            return False
        except OSError as error:
            self.become("unreachable", error)
            return False
        if sock.getsockname() == sock.getpeername():
            # A closed local port may be chosen as our own and so connect to itself.
            sock.close()
            self.become("refused")
            return False
        self.remote = host_and_port(*address[:2])
        self.adopt(sock)
        return True


class TcpPeer(StreamClient):
    """A connection that a client made."""

    def _broke(self) -> None:
        assert self.leave is not None
        self.leave(self)


class TcpListener(StreamListener[TcpPeer]):
    """A TCP port and its clients."""

    def _admit(self, connection: socket.socket, peer: str) -> None:
        client_id, name = self._context.new_client_id(), self.endpoint.name_of(peer)
        client = TcpPeer(self._context, client_id, self.endpoint, peer, name, self.leave)
        self._clients[client_id] = client
        self._context.appear(client)
        client.adopt(connection)
