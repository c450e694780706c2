"""Base of all transports: a client of the hub, and the part of the hub that it uses."""

import asyncio
import logging
import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar, Final

from gateway.hub import forwarding_step as kernel
from gateway.hub.endpoint import OPEN_TO_ALL, Endpoint, EndpointKind, is_loopback
from gateway.hub.forwarding import Forwarding, new_client_state
from gateway.hub.route import Route
from gateway.hub.routing_table import Origin
from gateway.hub.settings import HubSettings
from gateway.hub.stats import ClientCounters, ClientStats
from gateway.hub.systems import SystemTranslation
from gateway.printable import reason_of
from gateway.token_bucket import TokenBucket
from gateway.units import US_PER_S
from gateway.wire.framing import Fault
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import (
    START_V2,
    Event,
    MavFrame,
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
STALE_AFTER_US: Final = 3 * US_PER_S
"""Time without a frame after which a client may be replaced: three missed heartbeats."""
RETRY_US: Final = US_PER_S
"""Interval of attempts to reopen a socket."""


class HubContext:
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
    new_client_id: Callable[[], int]
    is_own: Callable[[Origin], bool]
    """Returns whether a system and component is one of our vehicles."""
    deliver: Callable[["Client", MavFrame, int], None]
    """Routes one received frame for which there is no cached route."""
    finish_run: Callable[[int], None]
    """Completes the forwarding of a run: the part that the compiled step leaves to Python."""
    appear: Callable[["Client"], None]
    """Adds a client."""
    greet: Callable[[int], None]
    """Sends the vehicles' greetings to a new peer."""
    reconfigure: Callable[["Client"], None]
    """Applies a client's changed options."""
    numbers: Callable[[int, Origin], bool]
    """Returns whether frames of another system are numbered for a client."""
    reroute: Callable[["Client"], None]
    """Routes the frames to a client again, since it sends them in another way."""
    flush_soon: Callable[[float, Callable[[], None]], None]
    """Calls back after the present events are handled, or after a wait."""
    update_buffer: Callable[[int, int], None]
    """Adapts the rate to a client to the free percentage of its radio's buffer."""
    vanish: Callable[["Client"], None]
    """Removes a client and closes it."""


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
    """Routes of frames from here, by `MavFrame.key`; the fan-out clears them."""
    memory: kernel.ClientState = field(init=False)
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
        self.memory = new_client_state(self.client_id)
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
        """The function that sends a frame with the ids, and in the version, of the client."""
        return self.transmit if self.is_unchanged else self._transmit_changed

    def _renumber(self) -> None:
        """Begin to translate the system ids of its link, or end it."""
        self.renumbering = None
        if new_ids := self.endpoint.new_ids:
            on_change = partial(self.context.reconfigure, self)
            self.renumbering = SystemTranslation(new_ids, self.context.signer.renewal, on_change)

    def _transmit_changed(self, frame: MavFrame) -> None:
        if self.renumbering is not None:
            changed = self.renumbering.to_link(frame)
            if changed is None:
                return
            frame = changed
        data = to_mavlink1(frame.data) if self.is_mavlink1 else frame.data
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
            if isinstance(event, Fault):
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
        if route is not None and not route.is_examined:
            route.forward(frame, now_us)
        elif not self.endpoint.monitor:
            self.context.deliver(self, frame, now_us)

    def go_on(self, step: Callable[[], None], now_us: int) -> None:
        """Call the step again, and process the frames it leaves to Python, until none is left."""
        work = self.context.forwarding.work
        while (status := work.status) & (kernel.RUN_SENT | kernel.HAND_OVER):
            if status & kernel.RUN_SENT:
                self.context.finish_run(now_us)
            if status & kernel.HAND_OVER:
                self._take_over(now_us)
            if self.memory.input < 0:
                # Closed by one of the frames.
                return
            step()

    def _take_over(self, now_us: int) -> None:
        """Process a frame without a compiled route, or all that is left of a datagram."""
        forwarding = self.context.forwarding
        data, size = forwarding.rest(), forwarding.work.frame
        frame = read_datagram(data[:size]) if size and self.memory.is_forwardable else None
        if frame is None:
            forwarding.skip()
            self.accept_rest(data, now_us)
            return
        forwarding.work.offset += size
        self.counters.bytes_received += size
        self.receive_frame(frame, now_us)

    def accept_rest(self, data: bytes, now_us: int) -> None:
        """Process received bytes, without the compiled step."""
        raise NotImplementedError

    def settle(self) -> int:
        """Count what the compiled step has forwarded; return the number of frames."""
        memory = self.memory
        self.counters.cut += memory.cut
        memory.cut = 0
        if frames := memory.received:
            self.counters.received += frames
            self.counters.bytes_received += memory.received_size
            memory.received = memory.received_size = 0
            self.heard_us = max(self.heard_us or 0, memory.heard_us)
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


def _is_trusted(endpoint: Endpoint, host: str) -> bool:
    """Return whether a peer may change state: as in the URL, else if configured or local.

    A fleet is not trusted by default: everyone who reaches its router can publish there.
    """
    if endpoint.trusted is not None:
        return endpoint.trusted
    if endpoint.kind in OPEN_TO_ALL:
        return is_loopback(host)
    return endpoint.kind != EndpointKind.ZENOH
