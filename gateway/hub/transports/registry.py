"""The transport of each kind of endpoint."""

from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any, Final

from gateway.hub.endpoint import (
    ADDED_KINDS,
    JSON_KEYS,
    RAW_KEYS,
    SITE_KEYS,
    AddedKind,
    Endpoint,
    EndpointKind,
)
from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.listener import Listener
from gateway.hub.transports.serial_line import SerialClient
from gateway.hub.transports.tcp import TcpClient, TcpListener
from gateway.hub.transports.udp import UdpClient
from gateway.hub.transports.udp_group import GroupClient
from gateway.hub.transports.udp_listen import UdpListener
from gateway.hub.transports.zenoh.client import ZenohClient, ZenohJson, ZenohRaw, ZenohSite

ClientMaker = Callable[[HubContext, int, Endpoint], Client]
ZENOH: Final[dict[str, type[ZenohClient]]] = {
    SITE_KEYS: ZenohSite,
    RAW_KEYS: ZenohRaw,
    JSON_KEYS: ZenohJson,
}


def _websocket(name: str) -> Callable[..., Any]:
    """Return a maker; most gateways have no WebSocket, and its library is slow to import."""
    module = "gateway.hub.transports.websocket"
    return lambda *arguments: getattr(import_module(module), name)(*arguments)


CLIENTS: Final[dict[str, ClientMaker]] = {
    EndpointKind.UDP: UdpClient,
    EndpointKind.UDP_BROADCAST: GroupClient,
    EndpointKind.UDP_MULTICAST: GroupClient,
    EndpointKind.TCP: TcpClient,
    EndpointKind.WS: _websocket("WsClient"),
    EndpointKind.WSS: _websocket("WsClient"),
    EndpointKind.ZENOH: lambda hub, number, url: ZENOH[url.keys](hub, number, url),
    EndpointKind.SERIAL: SerialClient,
}
LISTENERS: Final[dict[str, Callable[[HubContext, Endpoint], Listener[Any]]]] = {
    EndpointKind.UDP_LISTEN: UdpListener,
    EndpointKind.TCP_LISTEN: TcpListener,
    EndpointKind.WS_LISTEN: _websocket("WsListener"),
    EndpointKind.WSS_LISTEN: _websocket("WsListener"),
}


def add_endpoint_kind(
    word: str,
    make: ClientMaker,
    options: Iterable[str] = (),
    check: Callable[[Endpoint], None] = lambda _endpoint: None,
) -> None:
    """Add a kind of endpoint URL.

    Parameters
    ----------
    word : str
        The part before the URL's first colon; the rest, up to the options, is `Endpoint.host`.
    make : callable
        Creates the client of one endpoint from the hub, the client's id and the endpoint; a
        subclass of `Client` has this signature.
    options : iterable of str, optional
        Options of its own, which are in `Endpoint.added` as they are written; one that is named
        like a common option replaces it.
    check : callable, optional
        Called when a URL is read; raises ValueError if it does not understand the endpoint.

    Raises
    ------
    ValueError
        If the word is taken.
    """
    if word in CLIENTS or word in LISTENERS:
        raise ValueError(f"endpoint kind {word!r} already exists")
    ADDED_KINDS[word] = AddedKind(frozenset(options), check)
    CLIENTS[word] = make
