"""Carriers of an output's bytes: the transports of the hub, and TLS."""

import ssl
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final, cast

from gateway.hub.endpoint import Endpoint, parse_endpoint
from gateway.hub.transports.base import Client, HubContext, Listener
from gateway.hub.transports.registry import CLIENTS, LISTENERS
from gateway.hub.transports.tcp import TcpClient
from gateway.hub.transports.ws_protocol import TlsLayer
from gateway.records import EVERYBODY
from gateway.wire.mavlink_splitter import MavFrame

TLS: Final = "tls"
NO_MESSAGE: Final = -1

MakeContext = Callable[[], ssl.SSLContext]
"""Makes a TLS context; raises OSError if that fails."""


def target_of(location: str, kinds: Collection[str]) -> tuple[str, Endpoint]:
    """Parse the carrier and its address in an output's URL, such as `udp:HOST:PORT`.

    Raises ValueError if the carrier is not one of `kinds`.
    """
    word, _, rest = location.partition(":")
    inner = parse_endpoint(f"tcp:{rest}" if word == TLS else location)
    kind = TLS if word == TLS else inner.kind
    if kind not in kinds:
        raise ValueError(f"{location!r} has no carrier among {', '.join(sorted(kinds))}")
    return kind, inner


class Carrier:
    """Sends the bytes of an output to all present peers of its target.

    It acts as the hub for a transport: the transport's peers are not clients of the hub, and data
    received from them is dropped. `tls` makes the TLS context.
    """

    def __init__(self, output: Client, kinds: Collection[str], tls: MakeContext) -> None:
        self._output = output
        self._peers: dict[int, Client] = {}
        kind, inner = target_of(output.endpoint.host, kinds)
        context = cast("HubContext", self)
        self.link: Client | Listener[Any]
        if kind in LISTENERS:
            self.link = LISTENERS[kind](context, inner)
            return
        make = TlsClient if kind == TLS else CLIENTS[kind]
        self.link = link = make(context, output.context.new_client_id(), inner)
        if isinstance(link, TlsClient):
            link.make_context = tls
        self.appear(link)

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the hub that a transport uses."""
        return getattr(self._output.context, name)

    @property
    def state(self) -> str:
        """State of the transport; see `ClientStats.state`."""
        return self.link.state if isinstance(self.link, Client) else self.link.stats().state

    @property
    def reason(self) -> str:
        """Reason why nothing is sent."""
        return self.link.reason

    def send(self, data: bytes) -> None:
        """Send to every peer; a peer that reads too slowly loses whole messages."""
        frame = MavFrame(data, b"", NO_MESSAGE, EVERYBODY, EVERYBODY, 0, False)
        for peer in tuple(self._peers.values()):
            peer.transmit(frame)

    def tick(self, now_us: int) -> None:
        """Open the transport if it is closed."""
        self.link.tick(now_us)

    def close(self) -> None:
        """Close the transport."""
        self.link.close()

    def appear(self, client: Client) -> None:
        """Add a peer, and count it for the output."""
        client.counters = self._output.counters
        self._peers[client.client_id] = client

    def vanish(self, client: Client) -> None:
        """Remove a peer and close it."""
        self._peers.pop(client.client_id, None)
        client.close()

    def greet(self, client: Client) -> None:
        """Send nothing to a new peer: the output is periodic."""

    def deliver(self, client: Client, frame: MavFrame, now_us: int) -> None:
        """Drop a received frame."""


class TlsClient(TcpClient):
    """A TCP connection with TLS."""

    make_context: MakeContext
    _tls: TlsLayer

    async def _connect(self) -> None:
        try:
            self._tls = TlsLayer(self.make_context(), self.endpoint.host)
        except OSError as error:
            self.become("unreachable", error)
            self._task = None
        else:
            await super()._connect()

    def _begin(self) -> None:
        self.accept(b"", self.context.now_us())

    def transmit(self, frame: MavFrame) -> None:
        """Send one message after the handshake."""
        if self.state == "open":
            super().transmit(frame)
        else:
            self.counters.dropped += 1

    def _wrap(self, frames: bytes) -> bytes:
        return self._tls.wrap(frames)

    def accept(self, data: bytes, _now_us: int) -> None:
        """Process received bytes: handshake data is used, all other data dropped."""
        assert self._socket is not None
        try:
            _, reply = self._tls.feed(data)
        except ssl.SSLError as error:
            self._broke()
            self.become("unreachable", error)
            return
        if reply:
            self._write(self._socket, reply)
        if self._tls.is_ended:
            self._broke()
        elif self._tls.is_open:
            self.become("open")


def client_context(authority: str, certificate: str, key: str) -> ssl.SSLContext:
    """Return a TLS client context, with our own certificate if one is given.

    Raises OSError if a file cannot be read or is invalid.
    """
    cafile = str(Path(authority).expanduser()) if authority else None
    context = ssl.create_default_context(cafile=cafile)
    if certificate:
        own_key = Path(key).expanduser() if key else None
        context.load_cert_chain(Path(certificate).expanduser(), own_key)
    return context
