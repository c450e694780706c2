"""The transport of each kind of endpoint."""

from collections.abc import Callable, Iterable
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
from gateway.hub.transports.zenoh.client import ZenohClient
from gateway.hub.transports.zenoh.mavlink_server import ZenohJson, ZenohRaw
from gateway.hub.transports.zenoh.site import ZenohSite

ClientMaker = Callable[[HubContext, int, Endpoint], Client]
ZENOH: Final[dict[str, type[ZenohClient]]] = {
    SITE_KEYS: ZenohSite,
    RAW_KEYS: ZenohRaw,
    JSON_KEYS: ZenohJson,
}


def _ws_client(context: HubContext, client_id: int, endpoint: Endpoint) -> Client:
    # Imported here: most gateways have no WebSocket, and its library is slow to import.
    from gateway.hub.transports.websocket import WsClient

    return WsClient(context, client_id, endpoint)


def _zenoh_client(context: HubContext, client_id: int, endpoint: Endpoint) -> Client:
    return ZENOH[endpoint.keys](context, client_id, endpoint)


def _ws_listener(context: HubContext, endpoint: Endpoint) -> Listener[Any]:
    from gateway.hub.transports.websocket_listen import WsListener

    return WsListener(context, endpoint)


CLIENTS: Final[dict[str, ClientMaker]] = {
    EndpointKind.UDP: UdpClient,
    EndpointKind.UDP_BROADCAST: GroupClient,
    EndpointKind.UDP_MULTICAST: GroupClient,
    EndpointKind.TCP: TcpClient,
    EndpointKind.WS: _ws_client,
    EndpointKind.WSS: _ws_client,
    EndpointKind.ZENOH: _zenoh_client,
    EndpointKind.SERIAL: SerialClient,
}
LISTENERS: Final[dict[str, Callable[[HubContext, Endpoint], Listener[Any]]]] = {
    EndpointKind.UDP_LISTEN: UdpListener,
    EndpointKind.TCP_LISTEN: TcpListener,
    EndpointKind.WS_LISTEN: _ws_listener,
    EndpointKind.WSS_LISTEN: _ws_listener,
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
