"""What all transports to a client share: identity, counters, and how received bytes go on."""

import ipaddress
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gateway.routing.clients import ClientStats
from gateway.routing.endpoint import Endpoint
from gateway.wire.mavlink_splitter import SplitFault, origin_of

MAX_SYSTEMS: Final = 32
"""Origins remembered per client, for the display and for routing."""


@dataclass(slots=True)
class LinkCounters:
    """What one link has done since it appeared."""

    sent: int = 0
    dropped: int = 0
    bytes_sent: int = 0
    received: int = 0
    bytes_received: int = 0
    bytes_garbage: int = 0


@dataclass(slots=True, eq=False)
class Link:
    """One peer that frames are sent to; the base of every transport."""

    client_id: int
    endpoint: Endpoint
    remote: str
    trusted: bool
    since_us: int
    name: str
    state: str = "open"
    heard_us: int | None = None
    round_trip_us: int | None = None
    systems: dict[tuple[int, int], None] = field(default_factory=dict)
    counters: LinkCounters = field(default_factory=LinkCounters)

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame now or queue it; never block, never raise."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of the transport."""

    def tick(self, now_us: int) -> None:
        """Do what is due a few times a second: connect again, expire."""

    @property
    def queued(self) -> int:
        """Frames that wait for a slow link."""
        return 0

    def receive(
        self, events: list[bytes | SplitFault], size: int, now_us: int, deliver: "Deliver"
    ) -> None:
        """Count what came in and pass the frames on."""
        counters = self.counters
        counters.bytes_received += size
        for event in events:
            if isinstance(event, SplitFault):
                counters.bytes_garbage += event.size
                continue
            counters.received += 1
            self.heard_us = now_us
            if len(self.systems) < MAX_SYSTEMS:
                self.systems[origin_of(event)] = None
            deliver(self, event)

    def stats(self) -> ClientStats:
        """Describe the link at this moment."""
        counters = self.counters
        return ClientStats(
            client_id=self.client_id,
            name=self.name,
            endpoint=self.endpoint.url,
            remote=self.remote,
            state=self.state,
            trusted=self.trusted,
            systems=tuple(self.systems),
            sent=counters.sent,
            dropped=counters.dropped,
            bytes_sent=counters.bytes_sent,
            received=counters.received,
            bytes_received=counters.bytes_received,
            bytes_garbage=counters.bytes_garbage,
            queued=self.queued,
            since_us=self.since_us,
            heard_us=self.heard_us,
            round_trip_us=self.round_trip_us,
        )


Deliver = Callable[[Link, bytes], None]
"""Takes one frame that a link received."""


def is_loopback(host: str) -> bool:
    """Tell whether an address is on this machine; a name never is."""
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False
