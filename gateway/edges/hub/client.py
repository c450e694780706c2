"""What all transports to a client share: identity, counters, and how received bytes go on."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from gateway.edges.hub.express import ClientCounters, Express
from gateway.edges.reasons import reason_of
from gateway.routing.client_table import ClientStats
from gateway.routing.endpoint import OPEN_TO_ALL, Endpoint
from gateway.routing.hub_settings import HubSettings
from gateway.routing.page_origin import is_loopback
from gateway.routing.routing_table import Origin
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import SplitFault

Write = Callable[[bytes], object]


def not_open(data: bytes) -> int:
    """Stand in for the write function of a socket that is not open."""
    raise ConnectionError(f"{len(data)} bytes for a socket that is not open")


@dataclass(eq=False)
class Client:
    """One peer that frames are sent to; the base of every transport."""

    context: "HubContext"
    client_id: int
    endpoint: Endpoint
    remote: str = ""
    """Where the peer is; by default where the endpoint says."""
    name: str = ""
    state: str = "connecting"
    reason: str = ""
    trusted: bool = False
    since_us: int = 0
    heard_us: int | None = None
    round_trip_us: int | None = None
    counters: ClientCounters = field(default_factory=ClientCounters)
    express: dict[bytes, Express] = field(default_factory=dict)
    """The hub's short ways for frames from here, by `key_of`."""
    write: Write = field(default=not_open)
    """Sends one datagram at once or raises OSError; only of a client that is direct."""
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)

    def __post_init__(self) -> None:
        """Take the rest from the surroundings."""
        self.remote = self.remote or self.endpoint.address
        self.trusted = _is_trusted(self.endpoint, self.remote)
        self.name = self.name or self.endpoint.name
        self.since_us = self.context.now_us()

    def become(self, state: str, error: Exception | None = None) -> None:
        """Take on a state, and remember what led to it."""
        self.state = state
        self.reason = "" if error is None else reason_of(error)

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame now or queue it; never block, never raise."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of the transport."""

    def fail(self, error: Exception) -> None:
        """Close after an error that nobody foresaw; the tick opens again what may be opened."""
        self.become("unreachable", error)
        self.close()

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Take over changed options of the same place."""
        if self.name == self.endpoint.name:
            self.name = endpoint.name
        elif self.name == self.endpoint.name_of(self.remote):
            self.name = endpoint.name_of(self.remote)
        self.endpoint = endpoint
        self.trusted = _is_trusted(endpoint, self.remote)
        self.context.reconfigure(self)

    def tick(self, now_us: int) -> None:
        """Do what is due a few times a second: connect again, expire."""

    @property
    def host(self) -> str:
        """The peer's machine, without a port."""
        return self.remote.rpartition(":")[0].strip("[]")

    @property
    def is_direct(self) -> bool:
        """Whether a frame may go to `write` without further ado."""
        return False

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Judge a failed `write` that will be counted as sent all the same."""
        raise NotImplementedError

    @property
    def queued(self) -> int:
        """Frames that wait for a slow client."""
        return 0

    def receive(self, events: list[bytes | SplitFault], size: int, now_us: int) -> None:
        """Count what came in and pass the frames on."""
        counters = self.counters
        counters.bytes_received += size
        for event in events:
            if isinstance(event, SplitFault):
                counters.bytes_garbage += event.size
            else:
                counters.received += 1
                self.heard_us = now_us
                self.context.deliver(self, event, now_us)

    def stats(self, systems: tuple[Origin, ...]) -> ClientStats:
        """Describe the client at this moment; the hub knows which systems are behind it."""
        counters = self.counters
        return ClientStats(
            client_id=self.client_id,
            name=self.name,
            endpoint=self.endpoint.url,
            remote=self.remote,
            state=self.state,
            trusted=self.trusted,
            systems=systems,
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
            reason=self.reason,
            unheard=counters.unheard,
        )


class HubContext(Protocol):
    """What a transport asks of the hub."""

    @property
    def recordings(self) -> Path | None:
        """Where the recordings are that a fleet may fetch, if there are any."""

    @property
    def settings(self) -> HubSettings:
        """The settings of this moment."""

    @property
    def seal(self) -> Seal:
        """Numbers, and signs, a frame of ours that leaves."""

    def now_us(self) -> int:
        """Return the gateway time."""

    def new_client_id(self) -> int:
        """Return an id that no client had before."""

    def is_own(self, origin: Origin) -> bool:
        """Return whether a system and component is one of our vehicles."""

    def deliver(self, client: Client, frame: bytes, now_us: int) -> None:
        """Take one received frame."""

    def appear(self, client: Client) -> None:
        """Let a client take part."""

    def greet(self, client: Client) -> None:
        """Tell a peer that has just come which vehicles there are."""

    def reconfigure(self, client: Client) -> None:
        """Let a client's changed lists and rates hold."""

    def flush_soon(self, flush: Callable[[], None], wait_s: float) -> None:
        """Call back when all that has come at once is dealt with, or after a wait."""

    def note_buffer(self, client: Client, free_percent: int) -> None:
        """Take in how much of the buffer of the radio behind a client is free."""

    def vanish(self, client: Client) -> None:
        """Forget a client and close it."""


def _is_trusted(endpoint: Endpoint, remote: str) -> bool:
    """Return whether a peer may change state: as the URL says, else if named or on this machine."""
    if endpoint.trusted is not None:
        return endpoint.trusted
    if endpoint.kind in OPEN_TO_ALL:
        return is_loopback(remote.rpartition(":")[0].strip("[]"))
    return True
