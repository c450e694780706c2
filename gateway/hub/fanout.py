"""Distribution of frames to clients: cached routes, rates and sequence numbers.

Theory of operation. The first frame of each kind (system, component, message) from each source is
routed by the endpoints' filters, rates and the requested intervals; the resulting `Route` is kept,
so that the usual frame costs one dictionary look-up and one call per client. There is one cache and
one rule: whatever changes a fact on which a route depends calls `Fanout.clear`, and the next
frame of each kind is routed again. State that must survive a change, such as when a limited message
is due next, is not in the routes.

A frame that a client does not get (filtered, limited, or an answer to another client) would leave a
gap in its sequence numbers, which ground stations show as radio loss. So our own frames are
renumbered: each client has a count of the frames that it was not sent, and all clients with the
same count share one copy, which is signed too if its vehicle signs. Frames of other vehicles are
not changed, and a filter on those does show as loss; with one exception: frames of vehicles whose
answers are kept are numbered for each client, because the gateway sends some in their name.

The frames to a client of known bandwidth are counted, and thinned once a second so that they fit:
see `bandwidth.py`. That changes limits and no routes. A client whose endpoint has `monitor=yes`
gets every frame. A client of MAVLink 1 gets the messages that this version can carry, without
extensions and signatures.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Final
from weakref import WeakValueDictionary

from gateway.hub.bandwidth import (
    HIGH_LATENCY2,
    HIGH_LATENCY2_BYTES,
    SATELLITE_BUDGET,
    Bandwidth,
    Offered,
)
from gateway.hub.endpoint import NO_MESSAGES, Endpoint
from gateway.hub.forwarding import Forwarding
from gateway.hub.limits import RateLimit
from gateway.hub.numbering import SEQUENCE_MASK
from gateway.hub.route import OnForeign, Route, Target, Targets
from gateway.hub.routing_table import Origin, SystemPath
from gateway.hub.transports.base import Client
from gateway.records import ClientInterval
from gateway.units import US_PER_S
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import base_size
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame

MAX_KINDS: Final = 16_384
"""Maximum kinds of frame per client, as many as routes."""
LEAST_BYTES: Final = 10_000
"""Bytes to a client after which it is decided whether most of them are telemetry."""
MAX_ROUTES: Final = 16_384
"""Maximum cached routes per source, of some 600 bytes each: 800 vehicles of 20 kinds each. Beyond,
the oldest one is discarded."""

OnRun = Callable[[Forwarding], None]
"""Called with the run of the compiled step, which `run` or `records` return."""
_TargetsKey = tuple[tuple[int, int, Origin | None], ...]


@dataclass(slots=True, eq=False)
class _Subscription:
    """One client with its limits; survives every change of routes."""

    client: Client
    bandwidth: Bandwidth | None
    is_recording: bool
    """Whether our frames come from the playback of a recording."""
    answered: int = 0
    """Bytes of answers since the last plan of the bandwidth."""
    requested: dict[tuple[int, int], int] = field(default_factory=dict)
    """Requested intervals by system and message."""
    skipped: Counter[Origin] = field(default_factory=Counter)
    """Frames of each of our components that were not sent to the client."""
    limits: dict[bytes, RateLimit] = field(default_factory=dict)
    inserted: dict[Origin, int] = field(default_factory=dict)
    """Kept answers that the gateway has sent in the name of other systems, by these. Frames of a
    system with an entry are numbered for this client."""

    def carries(self, frame: MavFrame) -> bool:
        """Return whether the client gets this system, and its MAVLink version has the message."""
        endpoint, renumbering = self.client.endpoint, self.client.renumbering
        if endpoint.systems and not endpoint.systems.carries(frame):
            return False
        if renumbering is not None and not renumbering.has_room_for(frame.origin[0]):
            return False
        return not self.client.is_mavlink1 or base_size(frame.message_id) is not None

    def lets_out(self, frame: MavFrame) -> bool:
        """Return whether the client's filter passes a frame that is addressed, or a station's."""
        systems = self.client.endpoint.systems
        return not systems or systems.lets_out(frame)

    def begin_numbers(self, origin: Origin) -> None:
        """Begin to number the frames of another system for this client."""
        if len(self.inserted) < MAX_KINDS:
            self.inserted.setdefault(origin, 0)

    def limit_of(self, key: bytes, interval_us: int) -> RateLimit | None:
        """Return the limit of a kind of frame; None if there is none, and never will be."""
        planned_us = self.bandwidth.interval_us(key) if self.bandwidth else 0
        if not interval_us and self.bandwidth is None:
            return None
        limit = self.limits.get(key)
        if limit is None:
            if len(self.limits) >= MAX_KINDS:
                del self.limits[next(iter(self.limits))]
            limit = self.limits[key] = RateLimit(interval_us)
        limit.least_us = interval_us
        limit.change(max(interval_us, planned_us))
        return limit

    def plan(self, offered: dict[bytes, Offered], elapsed_s: float) -> None:
        """Adapt the limits to the bandwidth, if it is known; no route depends on intervals."""
        if self.bandwidth is None:
            return
        self.bandwidth.plan(offered, self.answered, elapsed_s)
        self.answered = 0
        for key, limit in self.limits.items():
            limit.change(max(limit.least_us, self.bandwidth.interval_us(key)))

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
        is_ours = is_ours and not self.is_recording
        if message_id == HIGH_LATENCY2 and is_ours and message_id not in endpoint.allow:
            # Other messages send its content in full.
            return NO_MESSAGES
        limit = endpoint.interval_us.get(message_id, 0)
        requested = self.requested.get((frame.origin[0], message_id), 0)
        if NO_MESSAGES in (limit, requested):
            return NO_MESSAGES
        return max(limit, requested)


class OwnRoute:
    """The clients that get one kind of our own frames."""

    __slots__ = ("closed", "frames", "message_id", "size", "targets")

    def __init__(self, message_id: int) -> None:
        self.message_id = message_id
        self.frames = self.size = 0
        self.targets: list[
            tuple[Callable[[MavFrame], None], Counter[Origin], RateLimit | None]
        ] = []
        """How each client is sent a frame, its skipped frames, and its limit."""
        self.closed: list[Counter[Origin]] = []
        """The skipped frames of the clients that get no frame of this kind."""

    def settle(self) -> tuple[int, int]:
        """Return the frames and bytes since the last call."""
        frames, size = self.frames, self.size
        self.frames = self.size = 0
        return frames, size


class Fanout:
    """Give frames to clients by their filters, rates and addresses; keep the routes."""

    def __init__(
        self,
        signer: FrameSigner,
        forwarding: Forwarding | None = None,
        on_foreign: OnForeign | None = None,
        on_run: OnRun | None = None,
        *,
        is_recording: bool = False,
    ) -> None:
        self._is_recording = is_recording
        self.forwarding = forwarding or Forwarding()
        self.forwarding.work.is_observed = on_foreign is not None
        self._on_foreign, self._on_run = on_foreign, on_run
        self._targets: WeakValueDictionary[_TargetsKey, Targets] = WeakValueDictionary()
        """Targets by client, limit and renumbered system of each: routes share them."""
        self._targets_at: WeakValueDictionary[int, Targets] = WeakValueDictionary()
        """The same targets by the address of their memory."""
        self.forwarded = 0
        """Frames of other systems that were forwarded by cached routes."""
        self._own: dict[bytes, OwnRoute] = {}
        self._offered: dict[bytes, Offered] = {}
        """The frames of each kind since the last plan of the bandwidths."""
        self._is_metered = False
        """Whether `_offered` is needed."""
        self._signer = signer
        self.hears_only_others: Callable[[int, int], bool] = lambda _client_id, _system: False
        """Returns whether a client brings only vehicles, and all are others than a system."""
        self._subscriptions: dict[int, _Subscription] = {}
        self._monitors: list[Client] = []
        self._planned_us = 0

    def clear(self) -> None:
        """Discard all routes, because a fact on which some depend has changed."""
        self.settle()
        self._meter_all()
        self._own.clear()
        self.forwarding.clear()
        for subscription in self._subscriptions.values():
            subscription.client.routes.clear()

    def settle(self) -> None:
        """Bring all counters up to date."""
        for subscription in self._subscriptions.values():
            self.forwarded += subscription.client.settle()
        for targets in self._targets.values():
            self.forwarded += targets.settle()

    def _meter_all(self) -> None:
        """Count the frames of each kind for the plans of bandwidths, if there are any."""
        if not self._is_metered:
            return
        for subscription in self._subscriptions.values():
            for key, route in subscription.client.routes.items():
                self._meter(key, route.message_id, *route.settle(self.forwarding))
        for key, own in self._own.items():
            self._meter(key, own.message_id, *own.settle())

    def _meter(self, key: bytes, message_id: int, frames: int, size: int) -> None:
        if frames and len(self._offered) < MAX_KINDS:
            known = self._offered.get(key, Offered(message_id, 0, 0))
            self._offered[key] = Offered(message_id, known.frames + frames, known.size + size)

    def add(self, client: Client) -> None:
        """Include a client from the next frame on."""
        bandwidth = _bandwidth(client.endpoint)
        self._subscriptions[client.client_id] = _Subscription(client, bandwidth, self._is_recording)
        self._changed()

    def remove(self, client_id: int) -> None:
        """Remove a client; unknown ids are ignored."""
        self.clear()
        self._subscriptions.pop(client_id, None)
        self._changed()

    def reconfigure(self, client: Client) -> None:
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
            self.clear()

    def publish(self, frame: MavFrame, sequence: int, now_us: int) -> None:
        """Send one of our own frames, with a sequence number, to every client that takes it."""
        route = self._own.get(frame.key) or self._make_own_route(frame)
        route.frames += 1
        route.size += len(frame.data)
        copies: dict[int, MavFrame] = {}
        origin = frame.origin
        for send, skipped, limit in route.targets:
            if limit is not None and not limit.is_due(now_us):
                skipped[origin] += 1
                continue
            number = sequence - skipped[origin] & SEQUENCE_MASK
            copy = copies.get(number)
            if copy is None:
                copy = copies[number] = self._signer.sequence_and_sign(frame, number, now_us)
            send(copy)
        for skipped in route.closed:
            skipped[origin] += 1

    def answer(
        self,
        frame: MavFrame,
        sequence: int,
        client_ids: Collection[int],
        now_us: int,
        *,
        measures: bool = False,
    ) -> None:
        """Send one of our own frames to some clients only, and leave no gap at the others.

        It passes their filters; one that `measures` a round trip is not of the selected systems,
        and is sent to no monitor, and only if its message passes.
        """
        # A copy: a client that breaks at this frame removes itself.
        for subscription in tuple(self._subscriptions.values()):
            client, skipped = subscription.client, subscription.skipped
            gets = client.client_id in client_ids
            if measures:
                gets = gets and client.endpoint.passes(frame.message_id)
            else:
                gets = (gets or client.endpoint.monitor) and subscription.carries(frame)
            if gets:
                subscription.answered += len(frame.data)
                number = sequence - skipped[frame.origin] & SEQUENCE_MASK
                client.send(self._signer.sequence_and_sign(frame, number, now_us))
            else:
                skipped[frame.origin] += 1

    def insert(self, frame: MavFrame, client_ids: Collection[int], newest: int) -> None:
        """Send a kept answer of another system to some clients, past their filters.

        Its number follows that of the system's newest frame; all following frames of the system to
        these clients are renumbered, so that no number is missing or occurs twice.
        """
        for client_id, subscription in tuple(self._subscriptions.items()):
            client = subscription.client
            is_addressed = client_id in client_ids or client.endpoint.monitor
            if is_addressed and subscription.lets_out(frame):
                if frame.origin not in subscription.inserted:
                    self.clear()
                before = subscription.inserted.get(frame.origin, 0)
                subscription.inserted[frame.origin] = before + 1
                subscription.answered += len(frame.data)
                client.send(self._renumbered(frame, newest + before + 1))

    def has_mostly_telemetry(self, client_id: int) -> bool:
        """Return whether less than half of what a client was sent were answers and requests."""
        subscription = self._subscriptions[client_id]
        sent = subscription.client.counters.bytes_sent
        return sent >= LEAST_BYTES and 2 * subscription.answered < sent

    def numbers(self, client_id: int, origin: Origin) -> bool:
        """Return whether frames of another system are numbered for a client."""
        subscription = self._subscriptions.get(client_id)
        return subscription is not None and origin in subscription.inserted

    def _renumbered(self, frame: MavFrame, number: int) -> MavFrame:
        """Return another system's frame with a number; unchanged if it cannot be signed again."""
        sign = self._signer.renewal(frame) if frame.signed else None
        return edit_frame(frame, sequence=number & SEQUENCE_MASK, sign=sign) or frame

    def _sender(self, subscription: _Subscription, origin: Origin) -> Callable[[MavFrame], None]:
        """Return the function that sends frames of another system to a client."""
        send, inserted = subscription.client.send, subscription.inserted
        if origin not in inserted:
            return send
        return lambda frame: send(self._renumbered(frame, frame.sequence + inserted[origin]))

    def deliver(self, frame: MavFrame, client_ids: Collection[int], source_id: int) -> None:
        """Forward a frame to some clients, past their filters, unchanged."""
        source = self._subscriptions.get(source_id)
        for client_id in client_ids:
            subscription = self._subscriptions.get(client_id)
            if subscription and subscription.lets_out(frame):
                if source is not None and source.client.endpoint.cache:
                    subscription.begin_numbers(frame.origin)
                subscription.answered += len(frame.data)
                self._sender(subscription, frame.origin)(frame)
        for monitor in self._monitors:
            subscription = self._subscriptions[monitor.client_id]
            is_other = monitor.client_id not in client_ids and monitor.client_id != source_id
            if is_other and subscription.lets_out(frame):
                self._sender(subscription, frame.origin)(frame)

    def make_route(
        self,
        frame: MavFrame,
        source: Client,
        path: SystemPath,
        rejects: Callable[[MavFrame, int], bool] | None,
        reaches: Callable[[int], bool] = lambda _: True,
    ) -> Route:
        """Make the route of broadcasts like this one from a client; see `Route`.

        `reaches` returns whether they may be sent to a client.
        """
        targets: list[Target] = []
        key: list[tuple[int, int, Origin | None]] = []
        for subscription in self._subscriptions.values():
            interval_us = self._interval_us(subscription, frame, is_ours=False)
            if subscription.client is source or not reaches(subscription.client.client_id):
                continue
            if interval_us != NO_MESSAGES:
                limit, client = subscription.limit_of(frame.key, interval_us), subscription.client
                if source.endpoint.cache:
                    subscription.begin_numbers(frame.origin)
                is_edited = frame.origin in subscription.inserted
                send = self._sender(subscription, frame.origin) if is_edited else None
                targets.append((client, limit, send))
                key.append((client.client_id, id(limit), frame.origin if is_edited else None))
        shared = self._targets.get(tuple(key))
        if shared is None:
            shared = self._targets[tuple(key)] = Targets(targets)
            self._targets_at[shared.address] = shared
        return Route(frame.message_id, shared, source.client_id, path, rejects, self._on_foreign)

    def keep_route(
        self, route: Route, source: Client, key: bytes, *, is_examined: bool = False
    ) -> None:
        """Forward all frames of this kind from a client by a route."""
        if len(source.routes) >= MAX_ROUTES:
            oldest = next(iter(source.routes))
            gone = source.routes.pop(oldest)
            self.forwarded += gone.targets.settle()
            if self._is_metered:
                self._meter(oldest, gone.message_id, *gone.settle(self.forwarding))
            gone.leave(self.forwarding, oldest)
        source.routes[key] = route
        route.is_examined = is_examined
        if source.renumbering is None and not is_examined:
            route.enter(self.forwarding, key)

    def observe(self, *, runs: bool) -> None:
        """Pass the runs of the compiled step to `on_run`, or not."""
        self.forwarding.work.is_observed = runs

    def finish_run(self, now_us: int) -> None:
        """Complete the forwarding of a run: the part that the compiled step leaves to Python."""
        forwarding = self.forwarding
        targets, failures = self._targets_at[forwarding.work.targets], forwarding.failures()
        if failures or targets.others:
            targets.finish(forwarding.run(), failures, now_us)
        if forwarding.work.is_observed:
            if self._on_run is not None:
                self._on_run(forwarding)
            elif self._on_foreign is not None:
                self._on_foreign(forwarding.run())

    def align(self, client_ids: Sequence[int]) -> None:
        """Send the same frames with the same numbers to all links of one peer from now on.

        A message interval that one of them requested applies to all; where they differ, the first
        decides.
        """
        links = [self._subscriptions[key] for key in client_ids if key in self._subscriptions]
        requested = {k: v for link in reversed(links) for k, v in link.requested.items()}
        self.clear()
        for link in links:
            link.requested, link.inserted = dict(requested), dict(links[0].inserted)
            link.skipped = links[0].skipped.copy()

    def thin(self, now_us: int) -> None:
        """Plan the message intervals to clients of known bandwidth; call it once a second."""
        if not self._is_metered or now_us - self._planned_us < US_PER_S:
            return
        elapsed_s = (now_us - self._planned_us) / US_PER_S
        self._planned_us = now_us
        self._meter_all()
        for subscription in self._subscriptions.values():
            subscription.plan(self._offered, elapsed_s)
        self._offered = {}

    def update_buffer(self, client_id: int, free_percent: int) -> None:
        """Adapt the rate to a client to the free part of its radio's buffer."""
        subscription = self._subscriptions.get(client_id)
        if subscription is not None and subscription.bandwidth is not None:
            subscription.bandwidth.update_buffer(free_percent)

    def _changed(self) -> None:
        self.clear()
        subscriptions = self._subscriptions.values()
        self._is_metered = any(each.bandwidth for each in subscriptions)
        self._monitors = [each.client for each in subscriptions if each.client.endpoint.monitor]

    def _interval_us(self, each: _Subscription, frame: MavFrame, *, is_ours: bool) -> int:
        """Return the least time between two frames to a client, of those like this one."""
        endpoint = each.client.endpoint
        # A link of known capacity carries no telemetry of vehicles that are not received on it,
        # unless its options select some systems.
        is_bound = endpoint.budget > 0 and not (endpoint.systems or endpoint.monitor)
        is_bound = is_bound and frame.message_id not in endpoint.systems.also
        if is_bound and self.hears_only_others(each.client.client_id, frame.origin[0]):
            return NO_MESSAGES
        return each.interval_us(frame, is_ours=is_ours)

    def _make_own_route(self, frame: MavFrame) -> OwnRoute:
        if len(self._own) >= MAX_KINDS:
            del self._own[next(iter(self._own))]
        route = OwnRoute(frame.message_id)
        for subscription in self._subscriptions.values():
            interval_us = self._interval_us(subscription, frame, is_ours=True)
            if interval_us == NO_MESSAGES:
                route.closed.append(subscription.skipped)
                continue
            limit = subscription.limit_of(frame.key, interval_us)
            route.targets.append((subscription.client.send, subscription.skipped, limit))
        self._own[frame.key] = route
        return route


def _bandwidth(endpoint: Endpoint) -> Bandwidth | None:
    is_planned = endpoint.budget >= SATELLITE_BUDGET and not endpoint.monitor
    return Bandwidth(endpoint.budget) if is_planned else None
