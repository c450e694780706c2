"""Base of all transports: a client, the cached routes of its frames, and a listening port."""

import asyncio
import logging
import socket
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar, Final, Generic, Protocol, TypeVar

import numpy as np

from gateway.compiled import address_of
from gateway.hub import forwarding_step as kernel
from gateway.hub.endpoint import OPEN_TO_ALL, Endpoint, EndpointKind, is_loopback
from gateway.hub.forwarding import Forwarding, Words, new_client_words
from gateway.hub.limits import RateLimit
from gateway.hub.routing_table import Origin, SystemPath
from gateway.hub.send_queue import RADIO_STATUS
from gateway.hub.settings import HubSettings
from gateway.hub.stats import ClientCounters, ClientStats, ListenerStats
from gateway.hub.systems import SystemTranslation
from gateway.printable import reason_of
from gateway.token_bucket import TokenBucket
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import CRC_EXTRA, MESSAGE_IDS
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import (
    KEY_SIZE_V2,
    START_V2,
    Event,
    MavFrame,
    SplitFault,
    frame_of,
    read_datagram,
    to_mavlink1,
)

log = logging.getLogger(__name__)

READ_BYTES: Final = 4096
"""Most bytes read from one client at one wake-up; see `HubContext.read_bytes`."""
UNTRUSTED_READ_RATE: Final = 64_000
"""Bytes a second read from all untrusted clients together: at most 5000 frames, a tenth of a
processor. The rest waits with the sender, or is lost in the kernel."""
UNTRUSTED_READ_BURST: Final = 256_000
VERSION_PROBE_US: Final = 5 * US_PER_S
"""Time for which a client of version 1 is sent version 2: several heartbeats of the client."""
RETRY_US: Final = US_PER_S
"""Interval of attempts to reopen a socket."""

EXAMINED: Final = frozenset({RADIO_STATUS, MESSAGE_IDS["AVAILABLE_MODES"]})
"""Messages of which Python examines each, not only the newest."""
OnForeign = Callable[[Sequence[bytes]], None]
"""Called with frames of other systems that are forwarded, in their order."""
STALE_AFTER_US: Final = 3 * US_PER_S
"""Time without a frame after which a client may be replaced: three missed heartbeats."""
SHARE: Final = 4
"""Divisor: one host keeps a quarter of a full port's clients when others connect."""
FEW: Final = 4
"""Clients that one host keeps in any case, such as a ground station, a script and a display."""


@contextmanager
def new_socket(family: int, kind: int) -> Iterator[socket.socket]:
    """Yield a non-blocking socket; it is closed if the `with` block raises."""
    sock = socket.socket(family, kind)
    try:
        sock.setblocking(False)
        yield sock
    except BaseException:
        sock.close()
        raise


class HubContext(Protocol):
    """The part of the hub that a transport uses."""

    settings: HubSettings
    now_us: Callable[[], int]
    signer: FrameSigner
    """Numbers and signs our own frames."""
    forwarding: Forwarding
    """Memory of the compiled step."""
    untrusted_reads: TokenBucket
    """Bytes that may still be read from all untrusted clients together."""
    recordings: Path | None
    """Folder of the recordings that a fleet may fetch, if any."""

    read_bytes: int
    """Bytes to read from one client at one wake-up, before others get their turn."""

    def new_client_id(self) -> int:
        """Return an id that no client had before."""

    def is_own(self, origin: Origin) -> bool:
        """Return whether a system and component is one of our vehicles."""

    def deliver(self, client: "Client", frame: MavFrame, now_us: int) -> None:
        """Route one received frame for which there is no cached route."""

    def finish_run(self, now_us: int) -> None:
        """Complete the forwarding of a run: the part that the compiled step leaves to Python."""

    def appear(self, client: "Client") -> None:
        """Add a client."""

    def greet(self, client_id: int) -> None:
        """Send the vehicles' greetings to a new peer."""

    def reconfigure(self, client: "Client") -> None:
        """Apply a client's changed options."""

    def numbers(self, client_id: int, origin: Origin) -> bool:
        """Return whether frames of another system are numbered for a client."""

    def reroute(self, client: "Client") -> None:
        """Route the frames to a client again, since it sends them in another way."""

    def flush_soon(self, wait_s: float, flush: Callable[[], None]) -> None:
        """Call back after the present events are handled, or after a wait."""

    def update_buffer(self, client_id: int, free_percent: int) -> None:
        """Adapt the rate to a client to the free part of its radio's buffer."""

    def vanish(self, client: "Client") -> None:
        """Remove a client and close it."""


class Targets:
    """The clients of some routes: those that the compiled step sends to, and others with limits."""

    def __init__(self, targets: "Iterable[Target]") -> None:
        self.forwarded = 0
        """Frames sent by `send` since the last call of `settle`."""
        self.direct: list[Client] = []
        self.others: list[tuple[Callable[[MavFrame], None], RateLimit | None]] = []
        for client, limit, send in targets:
            if limit is None and send is None and client.is_direct:
                self.direct.append(client)
            else:
                self.others.append((send or client.send, limit))
        words = [address_of(client.words) for client in self.direct]
        self._memory = np.array([len(words), bool(self.others), 0, 0, *words])
        self.address = address_of(self._memory)

    def settle(self) -> int:
        """Count what the compiled step has sent; return the number of frames sent otherwise."""
        words = self._memory.data
        if frames := words[kernel.SENT]:
            for client in self.direct:
                client.counters.sent += frames
                client.counters.bytes_sent += words[kernel.SENT_SIZE]
            words[kernel.SENT] = words[kernel.SENT_SIZE] = 0
        forwarded, self.forwarded = self.forwarded, 0
        return forwarded

    def send(self, frame: MavFrame, now_us: int) -> None:
        """Send a frame to every client."""
        self.forwarded += 1
        for client in self.direct:
            client.transmit(frame)
        self._send_others(frame, now_us)

    def finish(self, run: list[bytes], failures: list[list[int]], now_us: int) -> None:
        """Complete the forwarding of a run: the part that the compiled step leaves to Python."""
        for index, sent, *failure in failures:
            self.direct[index].send_rest(run[sent:], *failure)
        if self.others:
            for data in run:
                self._send_others(frame_of(data), now_us)

    def _send_others(self, frame: MavFrame, now_us: int) -> None:
        for send, limit in self.others:
            if limit is None or limit.is_due(now_us):
                send(frame)


class Route:
    """The clients that get one kind of frame from one client.

    `source` brings the frames of a system by `path`. `rejects` returns whether a frame is dropped
    as a copy, `on_foreign` is called with each forwarded one.
    """

    def __init__(
        self,
        message_id: int,
        targets: Targets,
        source: "Client",
        path: SystemPath,
        rejects: Callable[[MavFrame, int], bool] | None,
        on_foreign: OnForeign | None,
    ) -> None:
        self.message_id = message_id
        self.frames = self.size = 0
        self.targets = targets
        self._source = source
        self._path = path
        self._rejects = rejects
        self._on_foreign = on_foreign
        self._row: int | None = None
        """Its row in the compiled step."""

    def enter(self, forwarding: Forwarding, key: bytes) -> None:
        """Let the compiled step forward such frames, unless it needs more than their headers."""
        seed = CRC_EXTRA.get(self.message_id)
        is_plain = self._rejects is None and self.message_id not in EXAMINED
        if (
            seed
            and is_plain
            and len(key) == KEY_SIZE_V2
            and len(self.targets.direct) < kernel.MAX_FAILED
        ):
            path = self._path
            self._row = forwarding.enter(
                self._source.client_id,
                key,
                seed[0],
                self.targets.address,
                address_of(path.stream.words),
                address_of(path.heard),
            )

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled step forwards such frames."""
        return self._row is not None

    def leave(self, forwarding: Forwarding, key: bytes) -> None:
        """Remove the route from the compiled step."""
        if self._row is not None:
            forwarding.leave(self._source.client_id, key, self._row)
            self._row = None

    def forward(self, frame: MavFrame, now_us: int, *, is_checked: bool = False) -> None:
        """Send a frame to every client; a rejected one to none."""
        self._path.heard_us = now_us
        if not is_checked:
            if self._rejects is None:
                self._path.stream.accept(frame.sequence, self._source.client_id, now_us)
            elif self._rejects(frame, now_us):
                return
        self.frames += 1
        self.size += len(frame.data)
        self.targets.send(frame, now_us)
        if self._on_foreign is not None:
            self._on_foreign((frame.data,))

    def settle(self, forwarding: Forwarding) -> tuple[int, int]:
        """Return the frames and bytes that were forwarded since the last call."""
        frames, size = (0, 0) if self._row is None else forwarding.settle(self._row)
        frames, size = self.frames + frames, self.size + size
        self.frames = self.size = 0
        return frames, size


@dataclass(eq=False)
class Client:
    """One peer that frames are sent to; the base of every transport."""

    context: HubContext
    client_id: int
    """Unique for the lifetime of the hub."""
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
    routes: dict[bytes, Route] = field(default_factory=dict)
    """Cached routes of frames from here, by `MavFrame.key`; the fan-out clears them."""
    words: Words = field(init=False)
    """Its state in the compiled step."""
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)
    sink: "Callable[[bytes, int], None] | None" = None
    """Takes all received bytes, and the time, of a link that does not carry MAVLink."""
    is_proven = True
    """Whether it is certain that it receives; False only of peers whose address may be forged."""
    may_return: ClassVar[bool] = True
    """Whether each frame from here may be one that was sent elsewhere and has returned."""
    is_measured: ClassVar[bool] = True
    """Whether the hub measures its round trip by messages."""
    renumbering: SystemTranslation | None = field(default=None, init=False)
    """Other system ids on its link, if its endpoint has the option `as`."""
    _version1_since_us: int | None = None
    """When it began to send MAVLink 1."""
    _sends_version2: bool = False
    _only_version1: bool = False
    _retry_us: int = 0

    def __post_init__(self) -> None:
        """Fill in the remaining fields."""
        self.remote = self.remote or self.endpoint.address
        self.trusted = _is_trusted(self.endpoint, self.host)
        self.name = self.name or self.endpoint.name
        self.since_us = self.context.now_us()
        self.words = new_client_words(self.client_id)
        self._renumber()

    def become(self, state: str, error: Exception | None = None) -> None:
        """Set the state and its reason."""
        self.state = state
        self.reason = "" if error is None else reason_of(error)

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame now or queue it; never block, never raise."""
        raise NotImplementedError

    @property
    def send(self) -> Callable[[MavFrame], None]:
        """The function that sends a frame in the version of MAVLink that the client needs."""
        if self.renumbering is not None:
            return self._transmit_renumbered
        return self._transmit_version1 if self.is_mavlink1 else self.transmit

    def _transmit_renumbered(self, frame: MavFrame) -> None:
        assert self.renumbering is not None
        changed = self.renumbering.to_link(frame)
        if changed is not None:
            (self._transmit_version1 if self.is_mavlink1 else self.transmit)(changed)

    def _renumber(self) -> None:
        """Begin to translate the system ids of its link, or end it."""
        self.renumbering = None
        if new_ids := self.endpoint.new_ids:
            on_change = partial(self.context.reconfigure, self)
            self.renumbering = SystemTranslation(new_ids, self.context.signer.renewal, on_change)

    def _transmit_version1(self, frame: MavFrame) -> None:
        data = to_mavlink1(frame.data)
        if data is not None:
            self.transmit(frame if data is frame.data else frame_of(data))

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
        if endpoint.new_ids != before.new_ids:
            self._renumber()
        self.context.reconfigure(self)

    def prove(self) -> None:
        """Note that it does receive, because a frame from it depends on one sent to it."""

    def tick(self, now_us: int) -> None:
        """Reconnect and expire; called a few times a second."""

    def _is_retry_due(self, now_us: int) -> bool:
        """Return True at most once in `RETRY_US`."""
        if now_us < self._retry_us:
            return False
        self._retry_us = now_us + RETRY_US
        return True

    @property
    def host(self) -> str:
        """The peer's host, without a port."""
        return self.remote.rpartition(":")[0].strip("[]")

    @property
    def last_us(self) -> int:
        """When a frame from it was received last, or else when it was added."""
        return self.since_us if self.heard_us is None else self.heard_us

    @property
    def is_direct(self) -> bool:
        """Whether the compiled step may send to it."""
        return False

    @property
    def is_unchanged(self) -> bool:
        """Whether it gets frames byte for byte as others do."""
        return self.renumbering is None and not self.is_mavlink1

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
        if self._sends_version2:
            return False
        before = self.is_mavlink1
        if frame.data[0] == START_V2:
            self._sends_version2, self._only_version1 = True, False
        elif self._version1_since_us is None:
            self._version1_since_us = now_us
        else:
            self._only_version1 = now_us - self._version1_since_us >= VERSION_PROBE_US
        return self.is_mavlink1 != before

    def send_rest(self, frames: Iterable[bytes], number: int, part: int) -> None:
        """Send the frames that the compiled step counted as sent but did not send.

        `number` is that of the first frame's error, and `part` the bytes of it that were sent.
        """
        raise NotImplementedError

    @property
    def queued(self) -> int:
        """Frames that wait for a slow client."""
        return 0

    def receive(self, events: list[Event], size: int, now_us: int) -> None:
        """Count received events of `size` bytes, and route the frames."""
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
        if self.renumbering is not None:
            changed = self.renumbering.from_link(frame, now_us)
            if changed is None:
                return
            frame = changed
        route = self.routes.get(frame.key)
        if route is not None:
            route.forward(frame, now_us)
        elif not self.endpoint.monitor:
            self.context.deliver(self, frame, now_us)

    def go_on(self, step: Callable[[], None], now_us: int) -> None:
        """Call the step again, and process the frames it leaves to Python, until none is left."""
        work = self.context.forwarding.work
        while (status := work[kernel.STATUS]) & (kernel.RUN_SENT | kernel.HAND_OVER):
            if status & kernel.RUN_SENT:
                self.context.finish_run(now_us)
            if status & kernel.HAND_OVER:
                self._take_over(now_us)
            if self.words[kernel.INPUT] < 0:
                # Closed by one of the frames.
                return
            step()

    def _take_over(self, now_us: int) -> None:
        """Process a frame without a compiled route, or all that is left of a datagram."""
        forwarding = self.context.forwarding
        data, size = forwarding.rest(), forwarding.work[kernel.FRAME]
        frame = read_datagram(data[:size]) if size and self.words[kernel.IS_PLAIN] else None
        if frame is None:
            forwarding.skip()
            self.accept_rest(data, now_us)
            return
        forwarding.work[kernel.OFFSET] += size
        self.counters.bytes_received += size
        self.receive_frame(frame, now_us)

    def accept_rest(self, data: bytes, now_us: int) -> None:
        """Process received bytes, without the compiled step."""
        raise NotImplementedError

    def settle(self) -> int:
        """Count what the compiled step has forwarded; return the number of frames."""
        words = self.words
        self.counters.cut += words[kernel.CUT]
        words[kernel.CUT] = 0
        frames = words[kernel.RECEIVED]
        if frames:
            self.counters.received += frames
            self.counters.bytes_received += words[kernel.RECEIVED_SIZE]
            words[kernel.RECEIVED] = words[kernel.RECEIVED_SIZE] = 0
            self.heard_us = max(self.heard_us or 0, words[kernel.HEARD_US])
        return frames

    def sink_bytes(self, data: bytes, now_us: int) -> bool:
        """Pass received bytes to the sink; return whether there is one."""
        if self.sink is None:
            return False
        self.counters.bytes_received += len(data)
        self.heard_us = now_us
        self.sink(data, now_us)
        return True

    def count_garbage(self, size: int) -> None:
        """Count received bytes that are not MAVLink."""
        self.counters.bytes_received += size
        self.counters.bytes_garbage += size

    def limit_reads(self, sock: socket.socket, read: Callable[[], None], size: int) -> None:
        """Stop reading for a while from an untrusted client, if they all together sent too much."""
        if self.trusted:
            return
        self.context.untrusted_reads.level -= size
        if self.read_pause_us():
            self.loop.remove_reader(sock)
            self._read_later(sock, read)

    def _read_later(self, sock: socket.socket, read: Callable[[], None]) -> None:
        if sock.fileno() < 0:
            # Closed during the pause.
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

    def stats(
        self,
        systems: tuple[Origin, ...],
        note: str = "",
        hint: str = "",
        cached: tuple[str, ...] = (),
    ) -> ClientStats:
        """Return the present figures; the hub passes systems, texts and kept answers."""
        renumbering = self.renumbering
        counters = {name: getattr(self.counters, name) for name in ClientCounters.__slots__}
        return ClientStats(
            client_id=self.client_id,
            name=self.name,
            endpoint=self.endpoint.url,
            remote=self.remote,
            state=self.state,
            reason=self.reason,
            trusted=self.trusted,
            systems=systems,
            queued=self.queued,
            since_us=self.since_us,
            heard_us=self.heard_us,
            round_trip_us=self.round_trip_us,
            refused=renumbering.refused if renumbering else 0,
            cached=cached,
            note=note or (renumbering.reason if renumbering else ""),
            hint=hint,
            **counters,
        )


Target = tuple[Client, RateLimit | None, Callable[[MavFrame], None] | None]
"""A client of a route, its limit, and the function that sends to it; None for its own."""
Peer = TypeVar("Peer", bound=Client)


def client_to_remove(
    present: Collection[Peer], host: str, max_clients: int, now_us: int
) -> Peer | None:
    """Choose the client to remove from a full port for a new one from `host`.

    It is the one that has sent nothing for longest, else the newest of the host that holds more
    than its share; None if all are alive and no host, or only the new client's, holds more.
    """
    stalest = min(present, key=lambda client: client.last_us)
    if now_us - stalest.last_us >= STALE_AFTER_US:
        return stalest
    crowded = crowded_host(present, max_clients)
    if crowded in (None, host):
        return None
    return [client for client in present if client.host == crowded][-1]


def crowded_host(present: Collection[Client], max_clients: int) -> str | None:
    """Return the host with the most clients if those are more than its share."""
    host, count = Counter(client.host for client in present).most_common(1)[0]
    return host if count > max(FEW, max_clients // SHARE) else None


class Listener(Generic[Peer]):
    """An endpoint that makes a client of every peer that connects, up to a bounded number."""

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

    def _has_room(self, host: str, now_us: int) -> bool:
        """Return whether there is room for a new client, after removing another if needed."""
        most = self._context.settings.max_clients
        if len(self._clients) < most:
            return True
        removed = client_to_remove(self._clients.values(), host, most, now_us)
        if removed is not None:
            self.leave(removed)
        return removed is not None

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
