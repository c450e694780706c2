"""Base of all transports: identity, counters, and passing on received frames."""

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from gateway.hub.client_table import ClientStats
from gateway.hub.endpoint import OPEN_TO_ALL, Endpoint, EndpointKind
from gateway.hub.express import ClientCounters, Express
from gateway.hub.hosts import is_loopback
from gateway.hub.routing_table import Origin
from gateway.hub.settings import HubSettings
from gateway.hub.token_bucket import Purse
from gateway.reasons import reason_of
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import SplitFault

READ_BYTES: Final = 4096
"""The most that is read from one client at one wake-up; see `HubContext.read_bytes`."""
STRANGERS_READ_RATE: Final = 64_000
"""Bytes a second read from all untrusted clients together: at most 5000 frames, a tenth of a
processor. What is beyond waits with the sender, or is lost in the kernel."""
STRANGERS_READ_BURST: Final = 256_000

Write = Callable[[bytes], object]


def not_open(data: bytes) -> int:
    """Write function of a client without an open socket; raises OSError."""
    raise ConnectionError(f"{len(data)} bytes for a socket that is not open")


@dataclass(eq=False)
class Client:
    """One peer that frames are sent to; the base of every transport."""

    context: "HubContext"
    client_id: int
    endpoint: Endpoint
    remote: str = ""
    """Address of the peer; by default the endpoint's."""
    name: str = ""
    state: str = "connecting"
    reason: str = ""
    trusted: bool = False
    since_us: int = 0
    heard_us: int | None = None
    round_trip_us: int | None = None
    counters: ClientCounters = field(default_factory=ClientCounters)
    express: dict[bytes, Express] = field(default_factory=dict)
    """The hub's fast paths for frames from here, by `key_of`."""
    write: Write = field(default=not_open)
    """Sends one datagram at once or raises OSError; only of a client that is direct."""
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)

    def __post_init__(self) -> None:
        """Fill in the remaining fields."""
        self.remote = self.remote or self.endpoint.address
        self.trusted = _is_trusted(self.endpoint, self.remote)
        self.name = self.name or self.endpoint.name
        self.since_us = self.context.now_us()

    def become(self, state: str, error: Exception | None = None) -> None:
        """Set the state, and remember its reason."""
        self.state = state
        self.reason = "" if error is None else reason_of(error)

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame now or queue it; never block, never raise."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the transport."""

    def fail(self, error: Exception) -> None:
        """Close after an unexpected error; `tick` reopens what can be reopened."""
        self.become("unreachable", error)
        self.close()

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options of the same endpoint."""
        if self.name == self.endpoint.name:
            self.name = endpoint.name
        elif self.name == self.endpoint.name_of(self.remote):
            self.name = endpoint.name_of(self.remote)
        self.endpoint = endpoint
        self.trusted = _is_trusted(endpoint, self.remote)
        self.context.reconfigure(self)

    def tick(self, now_us: int) -> None:
        """Reconnect and expire; called a few times a second."""

    @property
    def host(self) -> str:
        """The peer's machine, without a port."""
        return self.remote.rpartition(":")[0].strip("[]")

    @property
    def is_direct(self) -> bool:
        """Whether a frame may be passed to `write` directly."""
        return False

    @property
    def has_fast_path(self) -> bool:
        """Whether it looks into `express` for what it has received."""
        return self.is_direct

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Handle a failed `write` whose frame will still be counted as sent."""
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

    def pause_stranger(
        self, sock: socket.socket, read: Callable[[socket.socket], None], size: int
    ) -> None:
        """Stop reading for a while from a client that is not trusted, if all such sent too much.

        Parameters
        ----------
        sock : socket
            What `read` is called for when bytes are there.
        read : callable
            Reads from it.
        size : int
            Bytes that were just read.
        """
        if self.trusted:
            return
        self.context.strangers.level -= size
        if self._pause_us():
            self.loop.remove_reader(sock)
            self._read_later(sock, read)

    def _read_later(self, sock: socket.socket, read: Callable[[socket.socket], None]) -> None:
        if sock.fileno() < 0:
            # Closed meanwhile.
            return
        if pause_us := self._pause_us():
            self.loop.call_later(pause_us / US_PER_S, self._read_later, sock, read)
        else:
            self.loop.add_reader(sock, read, sock)

    def _pause_us(self) -> int:
        purse = self.context.strangers
        purse.fill(self.context.now_us())
        return 0 if self.trusted else purse.wait_us()

    def stats(self, systems: tuple[Origin, ...]) -> ClientStats:
        """Return the client's present figures; the hub passes the systems behind it."""
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
    """The part of the hub that a transport uses."""

    @property
    def recordings(self) -> Path | None:
        """Folder of the recordings that a fleet may fetch, if any."""

    @property
    def settings(self) -> HubSettings:
        """The present settings."""

    @property
    def read_bytes(self) -> int:
        """How much to read from one client at one wake-up, before others get their turn."""

    @property
    def strangers(self) -> Purse:
        """What may still be read from all untrusted clients together."""

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
        """Add a client."""

    def greet(self, client: Client) -> None:
        """Send the vehicles' greetings to a new peer."""

    def reconfigure(self, client: Client) -> None:
        """Apply a client's changed lists and rates."""

    def flush_soon(self, flush: Callable[[], None], wait_s: float) -> None:
        """Call back after the present events are handled, or after a wait."""

    def note_buffer(self, client: Client, free_percent: int) -> None:
        """Take in how much of the buffer of the radio behind a client is free."""

    def vanish(self, client: Client) -> None:
        """Remove a client and close it."""


def _is_trusted(endpoint: Endpoint, remote: str) -> bool:
    """Return whether a peer may change state: as in the URL, else if configured or local.

    A fleet is not trusted by default: everyone who reaches its router can publish there.
    """
    if endpoint.trusted is not None:
        return endpoint.trusted
    if endpoint.kind in OPEN_TO_ALL:
        return is_loopback(remote.rpartition(":")[0].strip("[]"))
    return endpoint.kind != EndpointKind.ZENOH
