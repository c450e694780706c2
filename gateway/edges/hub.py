"""The hub: every frame of ours goes to every client, and what clients say comes in."""

import asyncio
from collections.abc import Callable
from typing import Final

from gateway.edges.hub_link import Link
from gateway.edges.hub_udp import UdpLink, UdpListener
from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.routing.clients import ClientStats
from gateway.routing.endpoint import Endpoint, EndpointKind, parse_endpoint
from gateway.routing.fanout import Fanout
from gateway.routing.settings import HubSettings
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import origin_of

TICK_S: Final = 0.25
"""Often enough for expiry and reconnection, too seldom to cost anything."""

HEARTBEAT_ID: Final = 0
HOME_POSITION_ID: Final = 242
GREETING: Final = (HEARTBEAT_ID, HOME_POSITION_ID)
"""What a new client is told at once, in this order: that there is a vehicle, and its home."""
MAX_SYSTEMS: Final = 255


class Hub:
    """Send MAVLink to many clients and take theirs.

    Parameters
    ----------
    settings : HubSettings
        Endpoints and limits.
    on_frame : callable
        Called with every frame that a client sends to us.
    now_us : callable
        The gateway clock.
    """

    def __init__(
        self,
        settings: HubSettings,
        on_frame: Callable[[Incoming], None],
        now_us: Callable[[], int],
    ) -> None:
        self._settings = settings
        self._on_frame = on_frame
        self._clock = now_us
        self._fanout = Fanout()
        self._links: dict[int, Link] = {}
        self._fixed: dict[int, Link] = {}
        self._listeners: list[UdpListener] = []
        self._next_id = 1
        self._greetings: dict[tuple[int, int], dict[int, bytes]] = {}
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Open the endpoints; needs a running event loop. What fails is tried again."""
        for url in self._settings.endpoints:
            self._open(parse_endpoint(url))
        self._tick()

    def close(self) -> None:
        """Close every socket."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        for listener in self._listeners:
            listener.close()
        self._listeners.clear()
        for link in list(self._links.values()):
            self.vanish(link)

    def send(self, outgoing: Outgoing) -> None:
        """Send one of our own frames to every client that takes it, or to the one it answers."""
        frame = outgoing.frame
        if outgoing.client_id is not None:
            self._fanout.answer(frame, outgoing.client_id)
            return
        if outgoing.message_id in GREETING and len(self._greetings) < MAX_SYSTEMS:
            self._greetings.setdefault(origin_of(frame), {})[outgoing.message_id] = frame
        self._fanout.publish(frame, self._clock())

    def set_interval(self, wish: ClientInterval) -> None:
        """Send a client one message of one system at the rate that it wishes."""
        self._fanout.set_interval(wish)

    def clients(self) -> tuple[ClientStats, ...]:
        """Describe every client at this moment, in the order of their ids."""
        return tuple(self._links[key].stats() for key in sorted(self._links))

    def listening_ports(self) -> tuple[int, ...]:
        """Return the ports that listening endpoints have bound, in the order of the settings."""
        return tuple(listener.port for listener in self._listeners)

    def now_us(self) -> int:
        """Return the gateway time."""
        return self._clock()

    def new_client_id(self) -> int:
        """Return an id that no client had before."""
        self._next_id += 1
        return self._next_id - 1

    def deliver(self, link: Link, frame: bytes) -> None:
        """Take one frame that a link received."""
        self._on_frame(Incoming(link.client_id, frame, link.trusted))

    def appear(self, link: Link) -> None:
        """Let a link take part, and tell it at once which vehicles there are and their homes."""
        self._links[link.client_id] = link
        self._fanout.add(link.client_id, link.transmit, link.endpoint)
        for frames in self._greetings.values():
            for message_id in GREETING:
                if message_id in frames:
                    link.transmit(frames[message_id], message_id)

    def vanish(self, link: Link) -> None:
        """Close a link and forget it."""
        self._fanout.remove(link.client_id)
        self._links.pop(link.client_id, None)
        link.close()

    def _open(self, endpoint: Endpoint) -> None:
        settings = self._settings
        if endpoint.kind is EndpointKind.UDP:
            self.appear(UdpLink(self, self.new_client_id(), endpoint))
        elif endpoint.kind is EndpointKind.UDP_LISTEN:
            idle_us = round(settings.idle_timeout_s * US_PER_S)
            self._listeners.append(UdpListener(self, endpoint, settings.max_clients, idle_us))
        else:
            raise ValueError(f"endpoint {endpoint.url!r}: {endpoint.kind} is not offered yet")

    def _tick(self) -> None:
        now_us = self._clock()
        for link in list(self._links.values()):
            link.tick(now_us)
        for listener in self._listeners:
            listener.tick(now_us)
        self._timer = asyncio.get_running_loop().call_later(TICK_S, self._tick)
