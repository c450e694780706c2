"""Base of all transports: a client with its counters, and a listening port with its clients."""

import asyncio
import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final, Generic, Protocol, TypeVar

from gateway.hub.endpoint import OPEN_TO_ALL, Endpoint, EndpointKind, is_loopback
from gateway.hub.fanout import Route
from gateway.hub.limits import TokenBucket
from gateway.hub.routing_table import Origin
from gateway.hub.settings import HubSettings
from gateway.hub.stats import ClientCounters, ClientStats, ListenerStats
from gateway.printable import reason_of
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import START_V2, Event, MavFrame, SplitFault

log = logging.getLogger(__name__)

READ_BYTES: Final = 4096
"""Most bytes read from one client at one wake-up; see `HubContext.read_bytes`."""
UNTRUSTED_READ_RATE: Final = 64_000
"""Bytes a second read from all untrusted clients together: at most 5000 frames, a tenth of a
processor. The rest waits with the sender, or is lost in the kernel."""
UNTRUSTED_READ_BURST: Final = 256_000
VERSION_PROBE_US: Final = 5 * US_PER_S
"""Several heartbeats of the client."""
RETRY_US: Final = US_PER_S
"""Between attempts to reopen a socket."""

Write = Callable[[bytes], object]


def not_open(data: bytes) -> int:
    """Write function of a client without an open socket; raises OSError."""
    raise ConnectionError(f"{len(data)} bytes for a socket that is not open")


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
        """Bytes to read from one client at one wake-up, before others get their turn."""

    @property
    def untrusted_reads(self) -> TokenBucket:
        """Bytes that may still be read from all untrusted clients together."""

    @property
    def signer(self) -> FrameSigner:
        """Numbers and signs our own frames."""

    def now_us(self) -> int:
        """Return the gateway time."""

    def new_client_id(self) -> int:
        """Return an id that no client had before."""

    def is_own(self, origin: Origin) -> bool:
        """Return whether a system and component is one of our vehicles."""

    def routes_from(self, client_id: int) -> dict[bytes, Route]:
        """Return the cached routes of frames from a client, by `MavFrame.key`."""

    def deliver(self, client: "Client", frame: MavFrame, now_us: int) -> None:
        """Route one received frame for which there is no cached route."""

    def appear(self, client: "Client") -> None:
        """Add a client."""

    def greet(self, client: "Client") -> None:
        """Send the vehicles' greetings to a new peer."""

    def reconfigure(self, client: "Client") -> None:
        """Apply a client's changed options."""

    def flush_soon(self, flush: Callable[[], None], wait_s: float) -> None:
        """Call back after the present events are handled, or after a wait."""

    def update_buffer(self, client: "Client", free_percent: int) -> None:
        """Adapt the rate to a client to the free part of its radio's buffer."""

    def vanish(self, client: "Client") -> None:
        """Remove a client and close it."""


@dataclass(eq=False)
class Client:
    """One peer that frames are sent to; the base of every transport."""

    context: HubContext
    client_id: int
    endpoint: Endpoint
    remote: str = ""
    """Address of the peer; by default the endpoint's."""
    name: str = ""
    leave: "Callable[[Client], None] | None" = None
    """Removes a client of a listening port when its connection ends."""
    state: str = "connecting"
    reason: str = ""
    trusted: bool = False
    since_us: int = 0
    heard_us: int | None = None
    round_trip_us: int | None = None
    counters: ClientCounters = field(default_factory=ClientCounters)
    version1_since_us: int | None = None
    """When it began to send MAVLink 1."""
    sends_version2: bool = False
    _only_version1: bool = False
    routes: dict[bytes, Route] = field(default_factory=dict)
    """Cached routes of frames from here."""
    write: Write = field(default=not_open)
    """Sends one datagram at once or raises OSError; only of a client that is direct."""
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)
    may_return: ClassVar[bool] = True
    """Whether each frame from here may be one that was sent elsewhere and has returned."""

    def __post_init__(self) -> None:
        """Fill in the remaining fields."""
        self.remote = self.remote or self.endpoint.address
        self.trusted = _is_trusted(self.endpoint, self.host)
        self.name = self.name or self.endpoint.name
        self.since_us = self.context.now_us()
        self.routes = self.context.routes_from(self.client_id)

    def become(self, state: str, error: Exception | None = None) -> None:
        """Set the state, and remember its reason."""
        self.state = state
        self.reason = "" if error is None else reason_of(error)

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame now or queue it; never block, never raise."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the transport."""

    def fail(self, error: Exception) -> None:
        """Close after an unexpected error; `tick` reopens it, or it leaves its listening port."""
        if self.leave is not None:
            self.leave(self)
            return
        self.become("unreachable", error)
        self.close()

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options of the same endpoint."""
        before = self.endpoint
        if self.name == before.name:
            self.name = endpoint.name
        elif self.name == before.name_of(self.remote):
            self.name = endpoint.name_of(self.remote)
        self.endpoint = endpoint
        self.trusted = _is_trusted(endpoint, self.host)
        self.context.reconfigure(self)

    def tick(self, now_us: int) -> None:
        """Reconnect and expire; called a few times a second."""

    @property
    def host(self) -> str:
        """The peer's host, without a port."""
        return self.remote.rpartition(":")[0].strip("[]")

    @property
    def is_direct(self) -> bool:
        """Whether a frame may be passed to `write` directly."""
        return False

    @property
    def is_mavlink1(self) -> bool:
        """Whether it is sent MAVLink 1: by its options, or because it sends nothing else."""
        if self.endpoint.mavlink:
            return self.endpoint.mavlink == 1
        return self._only_version1

    def update_version(self, frame: MavFrame, now_us: int) -> bool:
        """Note the version of a frame from it; return whether it is sent another one from now on.

        Programs that know both versions begin with 1, and change to 2 when they receive 2: so 2 is
        sent for `VERSION_PROBE_US` to a client that sends 1.
        """
        if self.sends_version2:
            return False
        before = self.is_mavlink1
        if frame.data[0] == START_V2:
            self.sends_version2, self._only_version1 = True, False
        elif self.version1_since_us is None:
            self.version1_since_us = now_us
        else:
            self._only_version1 = now_us - self.version1_since_us >= VERSION_PROBE_US
        return self.is_mavlink1 != before

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Handle a failed `write` whose frame will still be counted as sent."""
        raise NotImplementedError

    @property
    def queued(self) -> int:
        """Frames that wait for a slow client."""
        return 0

    def receive(self, events: list[Event], size: int, now_us: int) -> None:
        """Count received events of so many bytes, and route the frames."""
        self.counters.bytes_received += size
        for event in events:
            if isinstance(event, SplitFault):
                self.counters.bytes_garbage += event.size
            else:
                self.receive_frame(event, now_us)

    def receive_frame(self, frame: MavFrame, now_us: int) -> None:
        """Route one frame: by the cache if its route is known."""
        self.counters.received += 1
        self.heard_us = now_us
        route = self.routes.get(frame.key)
        if route is not None:
            route.forward(frame, now_us)
        elif not self.endpoint.monitor:
            self.context.deliver(self, frame, now_us)

    def count_received(self, frames: int, size: int, heard_us: int) -> None:
        """Count frames that were forwarded by cached routes."""
        self.counters.received += frames
        self.counters.bytes_received += size
        self.heard_us = max(self.heard_us or 0, heard_us)

    def limit_reads(self, sock: socket.socket, read: Callable[[], None], size: int) -> None:
        """Stop reading for a while from an untrusted client, if all such sent too much."""
        if self.trusted:
            return
        self.context.untrusted_reads.level -= size
        if self.read_pause_us():
            self.loop.remove_reader(sock)
            self._read_later(sock, read)

    def _read_later(self, sock: socket.socket, read: Callable[[], None]) -> None:
        if sock.fileno() < 0:
            # Closed meanwhile.
            return
        if pause_us := self.read_pause_us():
            self.loop.call_later(pause_us / US_PER_S, self._read_later, sock, read)
        else:
            self.loop.add_reader(sock, read)

    def read_pause_us(self) -> int:
        """Return how long not to read from this client."""
        bucket = self.context.untrusted_reads
        bucket.refill(self.context.now_us())
        return 0 if self.trusted else bucket.wait_us()

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


Peer = TypeVar("Peer", bound=Client)


class Listener(Generic[Peer]):
    """An endpoint that makes a client of every peer that connects.

    Parameters
    ----------
    context : HubContext
        The hub.
    endpoint : Endpoint
        Where to listen.
    """

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.reason = ""
        self.turned_away = 0
        self._context = context
        self._loop = asyncio.get_running_loop()
        self._clients: dict[int, Peer] = {}
        self._socket: socket.socket | None = None
        self._retry_us = 0
        self._logged = ""

    @property
    def port(self) -> int:
        """The port that is bound, or 0."""
        return self._socket.getsockname()[1] if self._socket else 0

    def tick(self, now_us: int) -> None:
        """Bind if that failed; called a few times a second."""
        if now_us < self._retry_us or self._socket is not None:
            return
        self._retry_us = now_us + RETRY_US
        try:
            self._socket = self._bind()
        except OSError as error:
            self._report(error)
            return
        self._report(None)
        self._watch(self._socket)

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options of the same endpoint, to its clients too."""
        self.endpoint = endpoint
        for client in self._clients.values():
            client.reconfigure(endpoint)

    def close(self) -> None:
        """Remove all clients and close the port."""
        for client in list(self._clients.values()):
            self.leave(client)
        self._shut()

    def fail(self, error: Exception) -> None:
        """Close the port after an unexpected error; `tick` reopens it."""
        self._report(error)
        self._shut()

    def leave(self, client: Client) -> None:
        """Remove one client."""
        self._clients.pop(client.client_id, None)
        self._context.vanish(client)

    def stats(self) -> ListenerStats:
        """Return the port's present figures."""
        return ListenerStats(
            name=self.endpoint.name,
            endpoint=self.endpoint.url,
            state="closed" if self.reason else "open",
            reason=self.reason,
            port=self.port,
            clients=len(self._clients),
            turned_away=self.turned_away,
        )

    def _shut(self) -> None:
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _bind(self) -> socket.socket:
        """Open the port or raise OSError."""
        raise NotImplementedError

    def _watch(self, sock: socket.socket) -> None:
        """Accept clients of the port from now on."""
        raise NotImplementedError

    def _report(self, error: Exception | None) -> None:
        """Note why no client can connect, or that one could; a change is logged."""
        self.reason = "" if error is None else reason_of(error)
        if self.reason == self._logged:
            return
        self._logged = self.reason
        if self.reason:
            log.warning("%s: %s; trying again until it works", self.endpoint.name, self.reason)
        else:
            log.info("%s is open", self.endpoint.name)


def _is_trusted(endpoint: Endpoint, host: str) -> bool:
    """Return whether a peer may change state: as in the URL, else if configured or local.

    A fleet is not trusted by default: everyone who reaches its router can publish there.
    """
    if endpoint.trusted is not None:
        return endpoint.trusted
    if endpoint.kind in OPEN_TO_ALL:
        return is_loopback(host)
    return endpoint.kind != EndpointKind.ZENOH
