"""WebSocket to pages and programs, on the sockets and queues of TCP clients.

A page that stalls fills its own queue and loses its own oldest telemetry. A silent peer is pinged:
one that has answered before and stops is gone; one that never answers, as simple programs do, is
left to the kernel, which closes a connection that acknowledges nothing.
"""

import contextlib
import logging
import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from wsproto.frame_protocol import CloseReason

from gateway.hub.endpoint import TLS_KINDS, Endpoint
from gateway.hub.hosts import admits_page
from gateway.hub.log_rate_limiter import Digest
from gateway.hub.transports.base import HubContext
from gateway.hub.transports.tcp import StreamClient, StreamListener, TcpClient
from gateway.hub.transports.tls import TlsLayer, caller_context, server_context
from gateway.hub.transports.ws_protocol import WsCaller, WsInput, WsProtocol, WsServer
from gateway.reasons import reason_of
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import SplitFault, SplitFaultKind

log = logging.getLogger(__name__)

HANDSHAKE_US: Final = 5 * US_PER_S
"""From the connection to the upgrade; one that takes longer only blocks a place."""
PINGS: Final = 3
"""Within the idle time-out, so that one lost answer does not break the connection."""
UNREAD_BYTES: Final = 65_536
"""Most bytes beside the queue: answers to a peer that sends requests and never reads."""
REFUSED_IN_FULL: Final = 5
"""Refused connections that are logged one by one in a minute."""


class WebStream(StreamClient):
    """A peer behind a WebSocket, with or without TLS."""

    _web: WsProtocol
    _tls: TlsLayer | None = None
    _is_gathering = False
    _begun_us = _spoke_us = _pinged_us = 0
    _answers = False

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, before or after the handshake."""
        return self._socket is not None

    def begin(self) -> None:
        """Start the handshake."""
        self._begun_us = self._spoke_us = self.context.now_us()
        self._answers = False
        self.become("connecting")
        try:
            self._tls = self.secure() if self.endpoint.kind in TLS_KINDS else None
        except OSError as error:
            self.give_up(reason_of(error))
            return
        self._web = self.protocol()

    def protocol(self) -> WsProtocol:
        """Create the protocol of a new connection."""
        raise NotImplementedError

    def secure(self) -> TlsLayer:
        """Create the TLS layer, or raise OSError."""
        raise NotImplementedError

    def opened(self) -> None:
        """Add the client: the handshake is done."""
        self.become("open")
        self.context.greet(self)

    def give_up(self, reason: str) -> None:
        """Close the connection and record the reason."""
        raise NotImplementedError

    def wrap(self, frames: bytes) -> bytes:
        """Return the bytes that carry some frames on this connection."""
        return self._seal(self._web.wrap(frames))

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame at once, or queue it if others wait or are to be packed with it."""
        if self.state != "open":
            self.counters.dropped += 1
            return
        if not self.endpoint.pack_bytes:
            super().transmit(frame, message_id)
            return
        self.counters.sent += 1
        self._push(frame, message_id, self._numbering.enter(frame))
        if self._outbox.size >= self.endpoint.pack_bytes:
            self._flush()
        elif not self._is_gathering:
            self._is_gathering = True
            self.context.flush_soon(self._flush, self.endpoint.pack_wait_s)

    def accept(self, data: bytes, now_us: int) -> None:
        """Process received bytes."""
        self._spoke_us = now_us
        plain = self._open_up(data) if self._tls is not None else data
        if not plain or not self.is_connected:
            return
        found = self._web.feed(plain)
        self._answers |= found.ponged
        if found.reply and not self.say(found.reply):
            return
        if found.opened:
            self.opened()
        self._take(found, now_us)
        if found.ended:
            self.give_up(found.ended)

    def say(self, data: bytes) -> bool:
        """Send a protocol message, past the queue; return whether the peer is still connected."""
        assert self._socket is not None
        data = self._seal(data)
        if not self._partial:
            self._write(self._socket, data)
        elif len(self._partial) < UNREAD_BYTES:
            self._partial += data
        else:
            self.give_up("it sends requests and does not read")
        return self.is_connected

    def tick(self, now_us: int) -> None:
        """Ping a silent peer, and drop one that does not answer."""
        super().tick(now_us)
        if self._socket is None:
            return
        if self.state != "open":
            if now_us - self._begun_us >= HANDSHAKE_US:
                self.give_up("no handshake")
            return
        idle_us = round(self.context.settings.idle_timeout_s * US_PER_S)
        silent_us = now_us - self._spoke_us
        if self._answers and silent_us >= idle_us:
            self.give_up("no answer to pings")
        elif min(silent_us, now_us - self._pinged_us) >= idle_us // PINGS:
            self._pinged_us = now_us
            self.say(self._web.ping())

    def close(self) -> None:
        """Send a close message if there is room, and close; waiting frames are lost."""
        if self._socket is not None and self.state == "open" and not self._partial:
            with contextlib.suppress(OSError):
                self._socket.send(self._seal(self._web.close(CloseReason.GOING_AWAY)))
        super().close()

    def _open_up(self, data: bytes) -> bytes:
        """Return the plain bytes of some network bytes."""
        assert self._tls is not None
        assert self._socket is not None
        was_open = self._tls.is_open
        try:
            plain, reply = self._tls.feed(data)
        except ssl.SSLError as error:
            with contextlib.suppress(OSError):
                self._socket.send(self._tls.outgoing())
            text = f"tls: {error.reason or error}".replace("_", " ").lower()
            if isinstance(error, ssl.SSLCertVerificationError):
                text += f": {error.verify_message}"
            self.give_up(text)
            return b""
        if reply:
            self._write(self._socket, reply)
        if self._tls.is_open and not was_open and self.is_connected:
            self.secured()
        if self._tls.is_ended and not plain and self.is_connected:
            self.broke()
        return plain

    def secured(self) -> None:
        """Continue after the TLS handshake."""

    def _seal(self, data: bytes) -> bytes:
        return data if self._tls is None else self._tls.wrap(data)

    def _take(self, found: WsInput, now_us: int) -> None:
        events: list[bytes | SplitFault] = []
        if found.payload:
            events += self._splitter.feed(found.payload)
        if found.text_size:
            events.append(SplitFault(SplitFaultKind.GARBAGE, found.text_size))
        if events or found.payload:
            self.receive(events, len(found.payload) + found.text_size, now_us)

    def _flush(self) -> None:
        """Send the gathered frames."""
        self._is_gathering = False
        if self._socket is not None and not self._partial:
            self._on_writable(self._socket)


class WsClient(WebStream, TcpClient):
    """A connection that the gateway makes, and remakes when it breaks."""

    _caller: WsCaller

    def begin(self) -> None:
        """Start the handshake."""
        super().begin()
        if self._socket is None:
            return
        if self._tls is None:
            self._write(self._socket, self._caller.hello)
        else:
            self._write(self._socket, self._tls.feed(b"")[1])

    def protocol(self) -> WsProtocol:
        """Create the protocol of a new connection."""
        self._caller = WsCaller(self.endpoint.address, self.endpoint.path)
        return self._caller

    def secure(self) -> TlsLayer:
        """Create the TLS layer, or raise OSError."""
        return TlsLayer(caller_context(self.context.settings), self.endpoint.host)

    def secured(self) -> None:
        """Send the upgrade request."""
        self.say(self._caller.hello)

    def give_up(self, reason: str) -> None:
        """Close the connection, and keep the reason until another is made."""
        was_open = self.state == "open"
        self.broke()
        if not was_open:
            self.state = "refused"
        self.reason = reason


@dataclass(eq=False)
class WsPeer(WebStream):
    """A connection that a page or a program made."""

    local_host: str = field(kw_only=True)
    """Address of ours that it came to."""
    welcome: Callable[["WsPeer"], None] = field(kw_only=True)
    leave: Callable[["WsPeer"], None] = field(kw_only=True)
    complain: Callable[[str], None] = field(kw_only=True)
    """Called with why a connection was refused."""

    def protocol(self) -> WsProtocol:
        """Create the protocol of a new connection."""
        return WsServer(lambda origin: admits_page(origin, self.local_host, self.endpoint.origins))

    def secure(self) -> TlsLayer:
        """Create the TLS layer, or raise OSError."""
        return TlsLayer(server_context(self.context.settings))

    def opened(self) -> None:
        """Add the client: the handshake is done."""
        self.welcome(self)
        super().opened()

    def give_up(self, reason: str) -> None:
        """Close the connection for good."""
        if self.state != "open":
            self.complain(f"{self.remote}: {reason}")
        self.broke()

    def broke(self) -> None:
        """Remove the client; it may connect again."""
        self.leave(self)

    def fail(self, error: Exception) -> None:  # noqa: ARG002
        """Remove the client after an unexpected error."""
        self.leave(self)


class WsListener(StreamListener[WsPeer]):
    """A WebSocket port, its clients, and its pending handshakes."""

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        self._callers: dict[int, WsPeer] = {}
        self._refused = Digest(REFUSED_IN_FULL, "more callers were refused")
        super().__init__(context, endpoint)

    def tick(self, now_us: int) -> None:
        """Bind again if that failed, and drop handshakes that take too long."""
        super().tick(now_us)
        for caller in list(self._callers.values()):
            caller.tick(now_us)
        self._tell(self._refused.poll(now_us))

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options; connected pages stay, even if no longer allowed."""
        super().reconfigure(endpoint)
        for caller in self._callers.values():
            caller.endpoint = endpoint

    def close(self) -> None:
        """Drop all clients and close the port."""
        for caller in list(self._callers.values()):
            self.leave(caller)
        super().close()

    def leave(self, client: WsPeer) -> None:
        """Drop one client."""
        self._callers.pop(client.client_id, None)
        super().leave(client)

    def _bind(self) -> socket.socket:
        if self.endpoint.kind in TLS_KINDS:
            server_context(self._context.settings)
        return super()._bind()

    def _admit(self, connection: socket.socket, peer: str) -> None:
        """Admit a new handshake; if there is no room, the oldest one is dropped."""
        if len(self._clients) + len(self._callers) >= self._context.settings.max_clients:
            next(iter(self._callers.values())).give_up("no handshake yet, and others wait")
        client_id = self._context.new_client_id()
        caller = WsPeer(
            self._context,
            client_id,
            self.endpoint,
            peer,
            self.endpoint.name_of(peer),
            local_host=str(connection.getsockname()[0]),
            welcome=self._welcome,
            leave=self.leave,
            complain=self._note_refusal,
        )
        self._callers[client_id] = caller
        caller.adopt(connection)

    def _welcome(self, peer: WsPeer) -> None:
        self._callers.pop(peer.client_id, None)
        self._clients[peer.client_id] = peer
        self._context.appear(peer)

    def _note_refusal(self, text: str) -> None:
        self.turned_away += 1
        self._tell(self._refused.say(text, self._context.now_us()))

    def _tell(self, lines: list[str]) -> None:
        for line in lines:
            log.warning("%s: %s", self.endpoint.name, line)
