"""Carriers of an output's bytes: the transports of the hub, and TLS."""

from collections.abc import Collection
from typing import Final, cast

from gateway.hub.endpoint import Endpoint, parse_endpoint
from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.byte_link import ByteLink
from gateway.hub.transports.registry import CLIENTS, LISTENERS
from gateway.hub.transports.tls import MakeContext, TlsClient
from gateway.records import EVERYBODY
from gateway.wire.mavlink_splitter import MavFrame

TLS: Final = "tls"
NO_MESSAGE: Final = -1


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


class Carrier(ByteLink):
    """Sends the bytes of an output to all present peers of its target; `tls` makes the context."""

    def __init__(self, output: Client, kinds: Collection[str], tls: MakeContext) -> None:
        super().__init__(output.context)
        self._counters = output.counters
        kind, inner = target_of(output.endpoint.host, kinds)
        context = cast("HubContext", self)
        if kind in LISTENERS:
            self.link = LISTENERS[kind](context, inner)
            return
        make = TlsClient if kind == TLS else CLIENTS[kind]
        self.link = link = make(context, output.context.new_client_id(), inner)
        if isinstance(link, TlsClient):
            link.make_context = tls
        self.appear(link)

    def send(self, data: bytes) -> None:
        """Send to every peer; a peer that reads too slowly loses whole messages."""
        frame = MavFrame(data, b"", NO_MESSAGE, EVERYBODY, EVERYBODY, 0, False)
        for peer in tuple(self.peers.values()):
            peer.transmit(frame)

    def appear(self, client: Client) -> None:
        """Add a peer, and count it for the output."""
        client.counters = self._counters
        super().appear(client)
