"""WebSocket, with or without TLS, on the sockets and queues of TCP clients.

A page that stalls fills its own queue and loses its own oldest telemetry. An idle peer is pinged:
one that has answered before and stops is gone; one that never answers, as simple programs do, is
left to the kernel, which closes a connection that acknowledges nothing.
"""

import contextlib
import logging
import socket
from typing import Final

from wsproto.frame_protocol import CloseReason

from gateway.hub.endpoint import TLS_KINDS, Endpoint, admits_page
from gateway.hub.stats import LogRateLimiter
from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.stream import StreamListener
from gateway.hub.transports.tcp import TcpClient
from gateway.hub.transports.tls import TlsLayer, TlsStream, client_context, server_context
from gateway.hub.transports.ws_protocol import WsCaller, WsInput, WsProtocol, WsServer
from gateway.printable import reason_of
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame

log = logging.getLogger(__name__)

HANDSHAKE_US: Final = 5 * US_PER_S
"""Maximum time from connection to upgrade; a slower client only occupies a slot."""
PINGS: Final = 3
"""Pings within the idle timeout, so that one lost answer does not break the connection."""
REFUSED_IN_FULL: Final = 5
"""Refused connections that are logged one by one in a minute."""
UNREAD_BYTES: Final = 65_536
"""Maximum bytes outside the queue: answers to a peer that sends requests and never reads."""


class WebStream(TlsStream):
    """A peer behind a WebSocket, with or without TLS."""

    _web: WsProtocol
    _is_gathering = False
    _connected_us = _received_us = _pinged_us = 0
    _answers = False

    def _begin(self) -> None:
        """Start the handshake."""
        assert self._socket is not None
        self._connected_us = self._received_us = self.context.now_us()
        self._answers = False
        self.become("connecting")
        self._web = self._protocol()
        try:
            if self.endpoint.kind in TLS_KINDS:
                self.begin_tls(self._secure())
            elif self._web.hello:
                self._write(self._socket, self._web.hello)
        except OSError as error:
            self.give_up(reason_of(error))

    def secured(self) -> None:
        """Request the upgrade."""
        if self._web.hello:
            self._send_control(self._web.hello)

    def _protocol(self) -> WsProtocol:
        """Create the protocol of a new connection."""
        raise NotImplementedError

    def _secure(self) -> TlsLayer:
        """Create the TLS layer, or raise OSError."""
        raise NotImplementedError

    def _opened(self) -> None:
        """Add the client: the handshake is done."""
        self.become("open")
        self.context.greet(self.client_id)

    def _wrap(self, frames: bytes) -> bytes:
        return self.encrypt(self._web.wrap(frames))

    @property
    def is_direct(self) -> bool:
        """False, because each frame is wrapped in a message."""
        return False

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame at once, or queue it if others wait or are to be packed with it."""
        if not self.endpoint.pack_bytes or self.state != "open":
            super().transmit(frame)
            return
        self._push(frame)
        if self._queue.size >= self.endpoint.pack_bytes:
            self._flush()
        elif not self._is_gathering:
            self._is_gathering = True
            self.context.flush_soon(self.endpoint.pack_wait_s, self._flush)

    def accept(self, data: bytes, now_us: int) -> None:
        """Process received bytes."""
        self._received_us = now_us
        plain = self.decrypt(data)
        if not plain or self._socket is None:
            return
        found = self._web.feed(plain)
        self._answers |= found.ponged
        if found.reply and not self._send_control(found.reply):
            return
        if found.opened:
            self._opened()
        self._receive_payload(found, now_us)
        if found.ended:
            self.give_up(found.ended)

    def _send_control(self, data: bytes) -> bool:
        """Send a protocol message before the queue; return whether the peer is still connected."""
        assert self._socket is not None
        data = self.encrypt(data)
        if not self._partial:
            self._write(self._socket, data)
        elif len(self._partial) < UNREAD_BYTES:
            self._partial += data
        else:
            self.give_up("sends requests and does not read")
        return self._socket is not None

    def tick(self, now_us: int) -> None:
        """Ping an idle peer, and drop one that does not answer."""
        super().tick(now_us)
        if self._socket is None:
            return
        if self.state != "open":
            if now_us - self._connected_us >= HANDSHAKE_US:
                self.give_up("no handshake")
            return
        timeout_us = round(self.context.settings.idle_timeout_s * US_PER_S)
        idle_us = now_us - self._received_us
        if self._answers and idle_us >= timeout_us:
            self.give_up("no answer to pings")
        elif min(idle_us, now_us - self._pinged_us) >= timeout_us // PINGS:
            self._pinged_us = now_us
            self._send_control(self._web.ping())

    def close(self) -> None:
        """Send a close message if there is room, and close; waiting frames are lost."""
        if self._socket is not None and self.state == "open" and not self._partial:
            with contextlib.suppress(OSError):
                self._socket.send(self.encrypt(self._web.close(CloseReason.GOING_AWAY)))
        super().close()

    def _receive_payload(self, found: WsInput, now_us: int) -> None:
        if found.payload:
            self.feed(found.payload, now_us)
        if found.text_size:
            self.count_garbage(found.text_size)

    def _flush(self) -> None:
        """Send the gathered frames."""
        self._is_gathering = False
        if self._socket is not None and not self._partial:
            self._on_writable(self._socket)


class WsClient(WebStream, TcpClient):
    """A connection that the gateway makes, and remakes when it breaks."""

    def _protocol(self) -> WsProtocol:
        return WsCaller(self.endpoint.address, self.endpoint.path)

    def _secure(self) -> TlsLayer:
        return TlsLayer(client_context(self.context.settings.tls_authority), self.endpoint.host)

    def give_up(self, reason: str) -> None:
        """Close the connection, and keep the reason until another is made."""
        was_open = self.state == "open"
        self._broke()
        if not was_open:
            self.state = "refused"
        self.reason = reason


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
