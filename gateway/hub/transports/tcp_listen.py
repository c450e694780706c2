"""A TCP port and its clients."""

import socket

from gateway.hub.transports.stream import StreamClient, StreamListener


class TcpPeer(StreamClient):
    """A connection that a client made."""

    def broke(self) -> None:
        """Remove the client; it may connect again."""
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
