"""A WebSocket port: its clients and its pending handshakes."""

import logging
import socket
from typing import Final

from gateway.hub.endpoint import TLS_KINDS, Endpoint, admits_page
from gateway.hub.stats import LogRateLimiter
from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.stream import StreamListener
from gateway.hub.transports.tls import TlsLayer, server_context
from gateway.hub.transports.websocket import WebStream
from gateway.hub.transports.ws_protocol import WsProtocol, WsServer

log = logging.getLogger(__name__)

REFUSED_IN_FULL: Final = 5
"""Refused connections that are logged one by one in a minute."""


class WsPeer(WebStream):
    """A connection that a page or a program made."""

    listener: "WsListener"
    local_host: str
    """Our address to which it has connected."""

    def _protocol(self) -> WsProtocol:
        return WsServer(lambda origin: admits_page(origin, self.local_host, self.endpoint.origins))

    def _secure(self) -> TlsLayer:
        return TlsLayer(server_context(self.context.settings))

    def _opened(self) -> None:
        self.listener.welcome(self)
        super()._opened()

    def give_up(self, reason: str) -> None:
        """Close the connection for good."""
        if self.state != "open":
            self.listener.count_refusal(f"{self.remote}: {reason}")
        self._broke()

    def _broke(self) -> None:
        self.listener.leave(self)


class WsListener(StreamListener[WsPeer]):
    """A WebSocket port, its clients, and its pending handshakes."""

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        self._handshakes: dict[int, WsPeer] = {}
        self._refused = LogRateLimiter(REFUSED_IN_FULL, "more connections were refused")
        super().__init__(context, endpoint)

    def tick(self, now_us: int) -> None:
        """Bind again if that failed, and drop handshakes that take too long."""
        super().tick(now_us)
        for handshake in list(self._handshakes.values()):
            handshake.tick(now_us)
        self._warn(self._refused.poll(now_us))

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options; connected pages stay, even if no longer allowed."""
        super().reconfigure(endpoint)
        for handshake in self._handshakes.values():
            handshake.endpoint = endpoint

    def close(self) -> None:
        """Remove all clients and close the port."""
        for handshake in list(self._handshakes.values()):
            self.leave(handshake)
        super().close()

    def leave(self, client: Client) -> None:
        """Remove one client."""
        self._handshakes.pop(client.client_id, None)
        super().leave(client)

    def _bind(self) -> socket.socket:
        if self.endpoint.kind in TLS_KINDS:
            server_context(self._context.settings)
        return super()._bind()

    def _admit(self, connection: socket.socket, peer: str) -> None:
        """Start a handshake; if there is no room, the oldest one is dropped."""
        if len(self._clients) + len(self._handshakes) >= self._context.settings.max_clients:
            next(iter(self._handshakes.values())).give_up(
                "no handshake yet, and other connections wait"
            )
        client_id = self._context.new_client_id()
        name = self.endpoint.name_of(peer)
        handshake = WsPeer(self._context, client_id, self.endpoint, peer, name, self.leave)
        handshake.listener, handshake.local_host = self, str(connection.getsockname()[0])
        self._handshakes[client_id] = handshake
        handshake.adopt(connection)

    def welcome(self, peer: WsPeer) -> None:
        """Add a client whose handshake is done."""
        self._handshakes.pop(peer.client_id, None)
        self._clients[peer.client_id] = peer
        self._context.appear(peer)

    def count_refusal(self, text: str) -> None:
        """Count and log a connection that was refused."""
        self.turned_away += 1
        self._warn(self._refused.add(text, self._context.now_us()))

    def _warn(self, lines: list[str]) -> None:
        for line in lines:
            log.warning("%s: %s", self.endpoint.name, line)
