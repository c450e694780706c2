"""Which client gets which frame, with which sequence number; the cache of these decisions.

Theory of operation. The first frame of each kind (system, component, message) from each source is
routed by the endpoints' filters, rates and the requested intervals; the resulting `Route` is kept,
so that the usual frame costs one dictionary look-up and one call per client. There is one cache and
one rule: whatever changes a fact on which a route depends calls `RouteCache.clear`, and the next
frame of each kind is routed again. State that must survive a change, such as when a limited message
is due next, is not in the routes.

A frame that a client does not get (filtered, limited, or an answer to another client) would leave a
gap in its sequence numbers, which ground stations show as radio loss. So our own frames are
renumbered: each client has a count of the frames that it was not sent, and all clients with the
same count share one copy, which is signed too if its vehicle signs. Frames of other vehicles are
never changed; a filter on those does show as loss.

The frames to a client of known bandwidth are counted, and thinned once a second so that they fit:
see `send_queue.py`. A client whose endpoint has `monitor=yes` gets every frame. One that knows only
MAVLink 1 gets the messages that this version can carry, without extensions and signatures.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from gateway.hub.endpoint import NO_MESSAGES, Endpoint
from gateway.hub.routing_table import Origin, Path
from gateway.hub.send_queue import (
    HIGH_LATENCY2,
    HIGH_LATENCY2_BYTES,
    SATELLITE_BUDGET,
    Bandwidth,
)
from gateway.hub.stats import ClientCounters
from gateway.records import ClientInterval
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import SEQUENCE_V2, MavFrame, frame_of, is_whole_frame
from gateway.wire.mavlink_version1 import base_size, to_mavlink1

SEQUENCE_MASK: Final = 0xFF
SLACK_SHIFT: Final = 2
"""A limited frame may be a quarter of its interval early, or jitter would halve the rate."""
MAX_KINDS: Final = 4096
"""Kinds of frame per client: a vehicle sends some fifty; forged headers must not fill memory."""
MAX_ROUTES: Final = 1024
"""Cached routes per source; beyond a few hundred they are forged."""


class Recipient(Protocol):
    """The properties of a client on which routes depend, and the ways to send to it."""

    @property
    def client_id(self) -> int:
        """Unique for the lifetime of the hub."""

    @property
    def endpoint(self) -> Endpoint:
        """The present options."""

    @property
    def counters(self) -> ClientCounters:
        """Its counters."""

    @property
    def write(self) -> Callable[[bytes], object]:
        """Sends one frame at once or raises OSError; only of a client that is direct."""

    @property
    def is_direct(self) -> bool:
        """Whether a frame may be passed to `write` directly."""

    @property
    def is_mavlink1(self) -> bool:
        """Whether it knows only MAVLink 1."""

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Handle a failed `write` whose frame will still be counted as sent."""

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame now or queue it; never block, never raise."""


class FrameSource(Protocol):
    """A client whose frames are forwarded."""

    @property
    def client_id(self) -> int:
        """Unique for the lifetime of the hub."""

    def count_received(self, frames: int, size: int, heard_us: int) -> None:
        """Count frames that were forwarded by cached routes."""


class Mavlink1Client:
    """A client that is sent MAVLink 1 frames.

    Parameters
    ----------
    client : Recipient
        Its transport.
    """

    is_direct = False
    is_mavlink1 = True

    def __init__(self, client: Recipient) -> None:
        self.client_id = client.client_id
        self.counters = client.counters
        self.write = client.write
        self._client = client

    @property
    def endpoint(self) -> Endpoint:
        """The present options."""
        return self._client.endpoint

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Pass a failed `write` on; never called, since it is not direct."""
        self._client.recover_uncounted(data, error)

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame, unless MAVLink 1 cannot carry it."""
        data = to_mavlink1(frame.data)
        if data is not None:
            self._client.transmit(frame if data is frame.data else frame_of(data))


def recipient_of(client: Recipient) -> Recipient:
    """Return a client with the conversion that it needs."""
    return Mavlink1Client(client) if client.is_mavlink1 else client


@dataclass(slots=True)
class _Gap:
    """Frames of one component that a client was not sent, modulo 256."""

    skipped: int = 0

    def skip(self) -> None:
        self.skipped = (self.skipped + 1) & SEQUENCE_MASK


@dataclass(slots=True)
class _RateLimit:
    """Least time between two frames of one kind to one client."""

    interval_us: int
    due_us: int = 0

    def is_due(self, now_us: int) -> bool:
        slack_us = self.interval_us >> SLACK_SHIFT
        if now_us < self.due_us - slack_us:
            return False
        self.due_us = max(self.due_us, now_us - slack_us) + self.interval_us
        return True

    def change(self, interval_us: int) -> None:
        """Apply another interval to the next frame already."""
        if self.due_us:
            self.due_us += interval_us - self.interval_us
        self.interval_us = interval_us


@dataclass(slots=True, eq=False)
class _Subscription:
    """One client with its limits; survives every change of routes."""

    client: Recipient
    bandwidth: Bandwidth | None
    answered: int = 0
    """Bytes of answers since the bandwidth was planned last."""
    recipient: Recipient = field(init=False)
    """The client with the conversion that it needs."""
    requested: dict[tuple[int, int], int] = field(default_factory=dict)
    """Requested intervals by system and message."""
    gaps: dict[Origin, _Gap] = field(default_factory=dict)
    limits: dict[bytes, _RateLimit] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.recipient = recipient_of(self.client)

    def carries(self, frame: MavFrame) -> bool:
        """Return whether the client's version of MAVLink has the message."""
        return not self.recipient.is_mavlink1 or base_size(frame.message_id) is not None

    def gap_of(self, origin: Origin) -> _Gap:
        gap = self.gaps.get(origin)
        if gap is None:
            if len(self.gaps) >= MAX_KINDS:
                self.gaps.clear()
            gap = self.gaps[origin] = _Gap()
        return gap

    def limit_of(self, key: bytes, interval_us: int) -> _RateLimit:
        limit = self.limits.get(key)
        if limit is None:
            if len(self.limits) >= MAX_KINDS:
                self.limits.clear()
            limit = self.limits[key] = _RateLimit(interval_us)
        elif limit.interval_us != interval_us:
            limit.change(interval_us)
        return limit

    def interval_us(self, frame: MavFrame, *, is_ours: bool) -> int:
        """Return the least time between two frames; the settings bound a client's request."""
        endpoint, message_id = self.client.endpoint, frame.message_id
        if not self.carries(frame):
            return NO_MESSAGES
        if endpoint.monitor:
            return 0
        if not endpoint.passes(message_id):
            return NO_MESSAGES
        if 0 < endpoint.budget < SATELLITE_BUDGET:
            if message_id != HIGH_LATENCY2:
                return NO_MESSAGES
            return round(HIGH_LATENCY2_BYTES * US_PER_S / endpoint.budget)
        if message_id == HIGH_LATENCY2 and is_ours and message_id not in endpoint.allow:
            # Its content is sent there in full by other messages.
            return NO_MESSAGES
        limit = endpoint.interval_us.get(message_id, 0)
        requested = self.requested.get((frame.origin[0], message_id), 0)
        if NO_MESSAGES in (limit, requested):
            return NO_MESSAGES
        planned = self.bandwidth.interval_us(frame.key) if self.bandwidth else 0
        return max(limit, requested, planned)


class Route:
    """The clients that get one kind of frame from one client.

    Parameters
    ----------
    message_id : int
        Of the frames.
    targets : sequence of (Recipient, _RateLimit or None)
        The clients that get them, and how often.
    source : FrameSource
        The client that brings them.
    path : Path
        Of the frames' system.
    rejects : callable, optional
        Whether a frame is dropped: a copy.
    on_foreign : callable, optional
        Called with each forwarded frame.
    """

    __slots__ = (
        "_datagram_bytes", "_datagrams", "_direct", "_extra", "_heard_us", "_limited",
        "_on_foreign", "_others", "_path", "_rejects", "_sent_us", "_source",
        "frames", "message_id", "size",
    )  # fmt: skip

    def __init__(
        self,
        message_id: int,
        targets: Sequence[tuple[Recipient, _RateLimit | None]],
        source: FrameSource,
        path: Path,
        rejects: Callable[[MavFrame, int], bool] | None,
        on_foreign: Callable[[bytes], None] | None,
    ) -> None:
        self.message_id = message_id
        self._source = source
        self.frames = self.size = 0
        """Not yet in the counters of the direct clients."""
        self._datagrams = self._datagram_bytes = self._heard_us = 0
        """Not yet in the figures of the source and of the path either."""
        self._sent_us = path.stream.sent_us
        self._path = path
        self._rejects = rejects
        self._on_foreign = on_foreign
        free = [client for client, limit in targets if limit is None]
        self._direct = [client for client in free if client.is_direct]
        self._others = [client for client in free if not client.is_direct]
        self._limited = [(client, limit) for client, limit in targets if limit is not None]
        needs_frame = bool(self._others or self._limited or rejects is not None)
        self._extra = None if needs_frame else CRC_EXTRA.get(message_id)

    def forward(self, frame: MavFrame, now_us: int, *, is_checked: bool = False) -> None:
        """Send a frame to every client; a rejected one to none."""
        self._path.heard_us = now_us
        if not is_checked:
            if self._rejects is None:
                self._path.stream.accept(frame.sequence, self._source.client_id, now_us)
            elif self._rejects(frame, now_us):
                return
        for client in self._others:
            client.transmit(frame)
        for client, limit in self._limited:
            if limit.is_due(now_us):
                client.transmit(frame)
        self._write(frame.data)

    def forward_datagram(self, data: bytes, now_us: int) -> bool:
        """Send a datagram of this kind to every client, and count it in bulk; see `settle`.

        Return False if it is not one valid frame, or the route needs more of the frame than its
        bytes and its sequence number: then `forward` does it.
        """
        extra = self._extra
        if extra is None or not is_whole_frame(data, extra):
            return False
        self._datagrams += 1
        self._datagram_bytes += len(data)
        self._heard_us = now_us
        self._sent_us[data[SEQUENCE_V2]] = now_us
        for client in self._direct:
            write = client.write
            try:
                write(data)
            except OSError as error:
                client.recover_uncounted(data, error)
        if self._on_foreign is not None:
            self._on_foreign(data)
        return True

    def _write(self, data: bytes) -> None:
        """Send a frame to the clients that take any number of bytes at once."""
        self.frames += 1
        self.size += len(data)
        for client in self._direct:
            write = client.write
            try:
                write(data)
            except OSError as error:
                client.recover_uncounted(data, error)
        if self._on_foreign is not None:
            self._on_foreign(data)

    def settle(self) -> tuple[int, int]:
        """Add the common counts to the clients' counters; return the frames and bytes."""
        frames, size = self.frames, self.size
        if datagrams := self._datagrams:
            self._source.count_received(datagrams, self._datagram_bytes, self._heard_us)
            self._path.count(datagrams, self._source.client_id, self._heard_us)
            frames, size = frames + datagrams, size + self._datagram_bytes
        self.frames = self.size = self._datagrams = self._datagram_bytes = 0
        if frames:
            for client in self._direct:
                client.counters.sent += frames
                client.counters.bytes_sent += size
        return frames, size


class OwnRoute:
    """The clients that get one kind of our own frames."""

    __slots__ = ("closed", "frames", "message_id", "size", "targets")

    def __init__(self, message_id: int) -> None:
        self.message_id = message_id
        self.frames = self.size = 0
        self.targets: list[tuple[Recipient, _Gap, _RateLimit | None]] = []
        self.closed: list[_Gap] = []
        """Of clients that get none of these frames."""

    def settle(self) -> tuple[int, int]:
        """Return the frames and bytes since the last call."""
        frames, size = self.frames, self.size
        self.frames = self.size = 0
        return frames, size


class RouteCache:
    """Cached routes by source and kind of frame; any change discards all of them."""

    def __init__(self) -> None:
        self.own: dict[bytes, OwnRoute] = {}
        self.forwarded = 0
        """Frames of other systems that were forwarded by cached routes."""
        self.offered: dict[bytes, tuple[int, int, int]] = {}
        """Message id, frames and bytes of each kind since the bandwidths were planned last."""
        self.is_metered = False
        """Whether `offered` is needed."""
        self.others: dict[tuple[int, bytes], Route] = {}
        """Routes by client and key of frames that are not only forwarded, such as heartbeats."""
        self._by_source: dict[int, dict[bytes, Route]] = {}

    def of(self, client_id: int) -> dict[bytes, Route]:
        """Return the routes from a client by `MavFrame.key`; the same dictionary at any time."""
        return self._by_source.setdefault(client_id, {})

    def clear(self) -> None:
        """Discard all routes, because a fact has changed on which some depend."""
        self.settle()
        self.own.clear()
        self.others.clear()
        for routes in self._by_source.values():
            routes.clear()

    def remove(self, client_id: int) -> None:
        """Discard all routes, and those of a client that has gone."""
        self.clear()
        self._by_source.pop(client_id, None)

    def settle(self) -> None:
        """Bring all counters up to date."""
        for routes in self._by_source.values():
            for key, route in routes.items():
                self.forwarded += self._meter(key, route)
        for (_, key), route in self.others.items():
            self.forwarded += self._meter(key, route)
        for key, own in self.own.items():
            self._meter(key, own)

    def _meter(self, key: bytes, route: Route | OwnRoute) -> int:
        """Count the frames that a route has sent since the last time; return their number."""
        message_id, (frames, size) = route.message_id, route.settle()
        if frames and self.is_metered and len(self.offered) < MAX_KINDS:
            _, known_frames, known_size = self.offered.get(key, (0, 0, 0))
            self.offered[key] = message_id, known_frames + frames, known_size + size
        return frames


class Fanout:
    """Give frames to clients by their filters, rates and addresses.

    Parameters
    ----------
    signer : FrameSigner
        Numbers and signs our own frames.
    """

    def __init__(self, signer: FrameSigner) -> None:
        self.cache = RouteCache()
        self._signer = signer
        self._subscriptions: dict[int, _Subscription] = {}
        self._monitors: list[Recipient] = []
        self._planned_us = 0

    def add(self, client: Recipient) -> None:
        """Include a client from the next frame on."""
        bandwidth = _bandwidth(client.endpoint)
        self._subscriptions[client.client_id] = _Subscription(client, bandwidth)
        self._changed()

    def remove(self, client_id: int) -> None:
        """Remove a client; unknown ids are ignored."""
        self._subscriptions.pop(client_id, None)
        self.cache.remove(client_id)
        self._changed()

    def reconfigure(self, client: Recipient) -> None:
        """Apply changed options, or a changed MAVLink version, from the next frame on."""
        if subscription := self._subscriptions.get(client.client_id):
            present, wanted = subscription.bandwidth, _bandwidth(client.endpoint)
            if present is None or wanted is None or present.bytes_per_s != wanted.bytes_per_s:
                subscription.bandwidth = wanted
            self._changed()

    def set_interval(self, request: ClientInterval) -> None:
        """Apply a requested message interval; that of a client that has gone is ignored."""
        if subscription := self._subscriptions.get(request.client_id):
            key = (request.system_id, request.message_id)
            subscription.requested[key] = request.interval_us
            self.cache.clear()

    def publish(self, frame: MavFrame, sequence: int, now_us: int) -> None:
        """Send one of our own frames, with a sequence number, to every client that takes it."""
        route = self.cache.own.get(frame.key) or self._make_own_route(frame)
        route.frames += 1
        route.size += len(frame.data)
        copies: dict[int, MavFrame] = {}
        for client, gap, limit in route.targets:
            if limit is not None and not limit.is_due(now_us):
                gap.skip()
                continue
            skipped = gap.skipped
            copy = copies.get(skipped)
            if copy is None:
                number = sequence - skipped & SEQUENCE_MASK
                copy = copies[skipped] = self._signer.sequence_and_sign(frame, number, now_us)
            client.transmit(copy)
        for gap in route.closed:
            gap.skip()

    def answer(
        self, frame: MavFrame, sequence: int, client_ids: Collection[int], now_us: int
    ) -> None:
        """Send one of our own frames to some clients only, past their filters."""
        # A copy: a client that breaks at this frame removes itself.
        for client_id, subscription in tuple(self._subscriptions.items()):
            gap = subscription.gap_of(frame.origin)
            wanted = client_id in client_ids or subscription.client.endpoint.monitor
            if wanted and subscription.carries(frame):
                subscription.answered += len(frame.data)
                number = sequence - gap.skipped & SEQUENCE_MASK
                copy = self._signer.sequence_and_sign(frame, number, now_us)
                subscription.recipient.transmit(copy)
            else:
                gap.skip()

    def deliver(self, frame: MavFrame, client_ids: Collection[int], source_id: int) -> None:
        """Forward a frame to some clients, past their filters, unchanged."""
        for client_id in client_ids:
            if subscription := self._subscriptions.get(client_id):
                subscription.answered += len(frame.data)
                subscription.recipient.transmit(frame)
        for monitor in self._monitors:
            if monitor.client_id not in client_ids and monitor.client_id != source_id:
                monitor.transmit(frame)

    def make_route(
        self,
        frame: MavFrame,
        source: FrameSource,
        path: Path,
        rejects: Callable[[MavFrame, int], bool] | None,
        on_foreign: Callable[[bytes], None] | None,
    ) -> Route:
        """Make the route of broadcasts like this one from a client; see `Route`."""
        if max(len(self.cache.of(source.client_id)), len(self.cache.others)) >= MAX_ROUTES:
            self.cache.clear()
        source_id = source.client_id
        targets: list[tuple[Recipient, _RateLimit | None]] = []
        for subscription in self._subscriptions.values():
            interval_us = subscription.interval_us(frame, is_ours=False)
            if subscription.client.client_id != source_id and interval_us != NO_MESSAGES:
                limit = subscription.limit_of(frame.key, interval_us) if interval_us else None
                targets.append((subscription.recipient, limit))
        return Route(frame.message_id, targets, source, path, rejects, on_foreign)

    def align(self, client_ids: Sequence[int]) -> None:
        """Send links to one peer the same frames, number for number, from now on.

        A message interval that one of them requested applies to all; where they differ, the first
        decides.
        """
        links = [self._subscriptions[key] for key in client_ids if key in self._subscriptions]
        origins = {origin for link in links for origin in link.gaps}
        requested = {k: v for link in reversed(links) for k, v in link.requested.items()}
        for link in links:
            link.requested = dict(requested)
            for origin in origins:
                link.gap_of(origin).skipped = links[0].gap_of(origin).skipped
        self.cache.clear()

    def thin(self, now_us: int) -> None:
        """Plan the message intervals to clients of known bandwidth; call it once a second."""
        if not self.cache.is_metered or now_us - self._planned_us < US_PER_S:
            return
        elapsed_s = (now_us - self._planned_us) / US_PER_S
        self._planned_us = now_us
        self.cache.clear()
        for subscription in self._subscriptions.values():
            if subscription.bandwidth is not None:
                subscription.bandwidth.plan(self.cache.offered, subscription.answered, elapsed_s)
                subscription.answered = 0
        self.cache.offered = {}

    def update_buffer(self, client_id: int, free_percent: int) -> None:
        """Adapt the rate to a client to the free part of its radio's buffer."""
        subscription = self._subscriptions.get(client_id)
        if subscription is not None and subscription.bandwidth is not None:
            subscription.bandwidth.update_buffer(free_percent)

    def _changed(self) -> None:
        self.cache.clear()
        subscriptions = self._subscriptions.values()
        self.cache.is_metered = any(each.bandwidth for each in subscriptions)
        for each in subscriptions:
            each.recipient = recipient_of(each.client)
        self._monitors = [each.recipient for each in subscriptions if each.client.endpoint.monitor]

    def _make_own_route(self, frame: MavFrame) -> OwnRoute:
        if len(self.cache.own) >= MAX_KINDS:
            self.cache.clear()
        route = OwnRoute(frame.message_id)
        for subscription in self._subscriptions.values():
            interval_us = subscription.interval_us(frame, is_ours=True)
            gap = subscription.gap_of(frame.origin)
            if interval_us == NO_MESSAGES:
                route.closed.append(gap)
                continue
            limit = subscription.limit_of(frame.key, interval_us) if interval_us else None
            route.targets.append((subscription.recipient, gap, limit))
        self.cache.own[frame.key] = route
        return route


def _bandwidth(endpoint: Endpoint) -> Bandwidth | None:
    return Bandwidth(endpoint.budget) if endpoint.budget >= SATELLITE_BUDGET else None
