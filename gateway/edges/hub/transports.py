"""Which transport serves which kind of endpoint."""

from collections.abc import Callable
from typing import Any, Final

from gateway.edges.hub.client import Client, HubContext
from gateway.edges.hub.group import GroupClient
from gateway.edges.hub.listener import Listener
from gateway.edges.hub.radio import RadioClient
from gateway.edges.hub.tcp import TcpClient, TcpListener
from gateway.edges.hub.udp import UdpClient
from gateway.edges.hub.udp_listen import UdpListener
from gateway.edges.hub.web.websocket import WsClient, WsListener
from gateway.routing.endpoint import Endpoint, EndpointKind

CLIENTS: Final[dict[EndpointKind, Callable[[HubContext, int, Endpoint], Client]]] = {
    EndpointKind.UDP: UdpClient,
    EndpointKind.UDP_BROADCAST: GroupClient,
    EndpointKind.UDP_MULTICAST: GroupClient,
    EndpointKind.TCP: TcpClient,
    EndpointKind.WS: WsClient,
    EndpointKind.WSS: WsClient,
    EndpointKind.SERIAL: RadioClient,
}
LISTENERS: Final[dict[EndpointKind, Callable[[HubContext, Endpoint], Listener[Any]]]] = {
    EndpointKind.UDP_LISTEN: UdpListener,
    EndpointKind.TCP_LISTEN: TcpListener,
    EndpointKind.WS_LISTEN: WsListener,
    EndpointKind.WSS_LISTEN: WsListener,
}
