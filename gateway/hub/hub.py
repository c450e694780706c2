"""The hub: every frame of ours is sent to every client, and clients' frames are routed."""

import asyncio
import contextlib
import logging
from collections import defaultdict, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import msgspec

from gateway.hub.endpoint import parse_endpoint
from gateway.hub.fanout import Fanout, OnRun
from gateway.hub.forwarding import Forwarding
from gateway.hub.numbering import Numbering, Waiting
from gateway.hub.own_vehicles import OwnVehicles
from gateway.hub.route import OnForeign
from gateway.hub.router import Router
from gateway.hub.routing_table import Origin
from gateway.hub.send_queue import NOT_TELEMETRY_IDS
from gateway.hub.settings import HubSettings
from gateway.hub.stats import (
    ClientAlerts,
    ClientStats,
    HubCounters,
    ListenerStats,
    LogRateLimiter,
    name_with_remote,
)
from gateway.hub.transports.base import (
    READ_BYTES,
    UNTRUSTED_READ_BURST,
    UNTRUSTED_READ_RATE,
    Client,
    HubContext,
)
from gateway.hub.transports.listener import Listener
from gateway.hub.transports.registry import CLIENTS, LISTENERS
from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.token_bucket import TokenBucket
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame, frame_of

log = logging.getLogger(__name__)

TICK_S: Final = 0.25
"""Interval of the ticks, s: short enough for expiry and reconnection, at negligible cost."""
CONNECTIONS_IN_FULL: Final = 30
"""Maximum connects and disconnects at listening ports that are logged one by one in a minute."""
CONNECTIONS_NOT_LOGGED: Final = "more connects and disconnects at listening ports"
SENDS_AT_ONCE: Final = 8
"""Maximum sends of our own frames per event-loop turn: each takes some tens of µs."""
LEAST_READ_BYTES: Final = 192
"""Minimum read at one wake-up: with fewer frames, the wake-up would cost more than they do."""
PASSED_ON_BYTES: Final = 12_288
"""Maximum bytes read from one client at one wake-up, times the clients that may get them: some 250
sends, about a millisecond, so that a flooding client delays the others by no more."""
MAX_WAITING: Final = 256
"""Maximum waiting frames of a burst. More are sent at once, which slows a fast playback down."""
SHED_AFTER_US: Final = 150_000
"""Telemetry that has waited longer is dropped: the processor is short of time, and newer telemetry
is waiting already."""


class Hub(HubContext):
    """Send MAVLink to many clients, receive theirs, and route between them.

    Parameters
    ----------
    settings : HubSettings
        Endpoints and limits.
    on_frame : callable
        Called with every frame to our vehicles, every request to all systems, and every heartbeat,
        within the client's quota of answers.
    now_us : callable
        The gateway clock.
    on_foreign : callable, optional
        Called with the frames of other systems, each once, byte for byte, as for a recorder.
    on_run : callable, optional
        Called in place of `on_foreign` with the runs of the compiled step, while they are observed.
    on_gone : callable, optional
        Called with the id of a client that has gone for good.
    on_alert : callable, optional
        Called when a problem of a client begins (True) or ends, with a short text.
    signer : FrameSigner, optional
        Numbers and signs each frame of ours where it is sent; by default none is signed.
    rejects : callable, optional
        Called with each received frame and the time; True drops it.
    recordings : Path, optional
        Folder of the recordings that a fleet may fetch.
    keeps_order : bool, optional
        Send frames in their order, without answers first, and drop none: for a recording, whose
        HIGH_LATENCY2 is sent like all other messages.
    """

    def __init__(
        self,
        settings: HubSettings,
        on_frame: Callable[[Incoming], None],
        now_us: Callable[[], int],
        on_foreign: OnForeign | None = None,
        on_run: OnRun | None = None,
        on_gone: Callable[[int], None] | None = None,
        on_alert: Callable[[bool, str], None] | None = None,
        signer: FrameSigner | None = None,
        rejects: Callable[[bytes, int], bool] | None = None,
        recordings: Path | None = None,
        keeps_order: bool = False,
    ) -> None:
        self.settings = settings
        self._keeps_order = keeps_order
        self.recordings = recordings
        self.signer = signer = signer or FrameSigner()
        self.now_us = now_us
        self.untrusted_reads = TokenBucket(UNTRUSTED_READ_RATE, UNTRUSTED_READ_BURST)
        self._on_gone, self._on_foreign, self._on_alert = on_gone, on_foreign, on_alert
        self._alerts = ClientAlerts()
        self._connections = LogRateLimiter(CONNECTIONS_IN_FULL, CONNECTIONS_NOT_LOGGED)
        self._clients: dict[int, Client] = {}
        self._endpoints: dict[str, Client | Listener[Any]] = {}
        self._next_id = 1
        self.forwarding = Forwarding()
        if problem := self.forwarding.problem:
            log.warning("%s; Python forwards, at less than half the speed", problem)
        self._share_reads()
        self._fanout = Fanout(signer, self.forwarding, on_foreign, on_run, is_recording=keeps_order)
        self.finish_run, self.update_buffer = self._fanout.finish_run, self._fanout.update_buffer
        self.observe = self._fanout.observe
        self.reroute, self.numbers = self._fanout.reconfigure, self._fanout.numbers
        self._vehicles = OwnVehicles()
        self.greet = self._vehicles.await_greeting
        routing = (self._clients, self._fanout, self._vehicles, on_frame, on_foreign, rejects)
        self._router = Router(self, *routing)
        self.deliver, self.routed_vehicles = self._router.deliver, self._router.routed_vehicles
        self.newest_frames, self.streams = self.forwarding.newest, self._router.streams
        self._ping_us = self._proof_us = self._alerts_us = 0
        self._timer: asyncio.TimerHandle | None = None
        self._gathering: dict[float, list[Callable[[], None]]] = {}
        """Callbacks to flush, by their wait."""
        self._numbering = Numbering()
        """Answers overtake telemetry, so frames are numbered when they leave the queues."""
        self._answers: deque[Waiting] = deque()
        self._telemetry: deque[Waiting] = deque()
        self._burst_turn: asyncio.Handle | None = None

    def start(self) -> None:
        """Open the endpoints; needs a running event loop. A failed one is retried."""
        for url in self.settings.endpoints:
            self.add(url)
        self._tick()

    def close(self) -> None:
        """Close every socket."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._router.close()
        if self._burst_turn is not None:
            self._burst_turn.cancel()
        for queued in (*self._answers, *self._telemetry):
            self._send(queued, self.now_us())
        for location in list(self._endpoints):
            self.remove(location)

    def send(self, outgoing: Outgoing) -> None:
        """Send one of our own frames now: to all clients that take it, or to the one it answers."""
        now_us = self.now_us()
        self._send(self._queued(outgoing, now_us), now_us)

    def send_all(self, frames: Iterable[Outgoing]) -> None:
        """Send frames of ours over several turns of the loop, answers first.

        Each kind leaves in its order. When the processor is short of time, telemetry that has
        waited for `SHED_AFTER_US` is dropped.
        """
        batch = [*frames]
        if len(batch) == 1 and self._burst_turn is None:
            # The usual case: a sample gives one message, and nothing waits.
            self.send(batch[0])
            return
        now_us = self.now_us()
        for outgoing in batch:
            queued = self._queued(outgoing, now_us)
            is_answer = (
                self._keeps_order
                or outgoing.client_id is not None
                or outgoing.message_id in NOT_TELEMETRY_IDS
            )
            (self._answers if is_answer else self._telemetry).append(queued)
        if self._burst_turn is None:
            self._send_some()

    def _queued(self, outgoing: Outgoing, now_us: int) -> Waiting:
        frame, client_id = outgoing.header or frame_of(outgoing.frame), outgoing.client_id
        # Charged now, while the client that made the request is known.
        self._router.charge(client_id, len(frame.data))
        return Waiting(frame, self._numbering.enter(frame), now_us, client_id)

    def _send_some(self) -> None:
        self._burst_turn = None
        now_us, room = self.now_us(), SENDS_AT_ONCE
        answers, telemetry = self._answers, self._telemetry
        try:
            while telemetry and telemetry[0].since_us < now_us - SHED_AFTER_US:
                telemetry.popleft()
                self._router.counters.shed += 1
            while (answers or telemetry) and (
                room > 0 or len(answers) + len(telemetry) > MAX_WAITING
            ):
                queued = (answers or telemetry).popleft()
                room -= len(self._clients) if queued.client_id is None else 1
                self._send(queued, now_us)
        finally:
            if answers or telemetry:
                self._burst_turn = asyncio.get_running_loop().call_soon(self._send_some)

    def _send(self, queued: Waiting, now_us: int) -> None:
        frame, step, _, client_id = queued
        sequence = frame.sequence if step is None else self._numbering.leave(frame, step)
        self._router.counters.published += 1
        if self._vehicles.waiting:
            self._greet(frame, sequence, now_us)
        if client_id is not None:
            self._fanout.answer(frame, sequence, self._router.links.group(client_id), now_us)
            return
        if self._vehicles.register(frame, now_us):
            self._fanout.clear()
        self._fanout.publish(frame, sequence, now_us)

    def announce(self, messages: Iterable[Any]) -> bool:
        """Send messages of this gateway as a component of each vehicle that it only routes.

        Returns whether there is one.
        """
        now_us, systems = self.now_us(), self.routed_vehicles()
        for message in messages:
            for system in systems:
                frame = self._router.round_trip.encode(message, system)
                self._fanout.publish(frame, frame.sequence, now_us)
                if self._on_foreign is not None:
                    self._on_foreign((frame.data,))
        return bool(systems)

    def set_interval(self, request: ClientInterval) -> None:
        """Send a client one message of one system at the interval that it requested."""
        for client_id in self._router.links.group(request.client_id):
            self._fanout.set_interval(msgspec.structs.replace(request, client_id=client_id))

    def add(self, url: str) -> None:
        """Open one more endpoint.

        Raises ValueError if the URL is not understood, or the same endpoint exists already.
        """
        endpoint = parse_endpoint(url)
        if endpoint.location in self._endpoints:
            raise ValueError(f"endpoint {endpoint.location!r} already exists")
        now_us = self.now_us()
        if listen := LISTENERS.get(endpoint.kind):
            listener = self._endpoints[endpoint.location] = listen(self, endpoint)
            self._tick_one(listener, now_us)
            return
        client = CLIENTS[endpoint.kind](self, self.new_client_id(), endpoint)
        self._endpoints[endpoint.location] = client
        self._tick_one(client, now_us)
        self.appear(client)

    def remove(self, name: str) -> None:
        """Close an endpoint.

        Raises ValueError if there is no such endpoint.
        """
        for location, opened in self._endpoints.items():
            if name in (location, opened.endpoint.name, opened.endpoint.url):
                break
        else:
            raise ValueError(f"no endpoint is called {name!r}")
        gone = self._endpoints.pop(location)
        if isinstance(gone, Client):
            self.vanish(gone)
        else:
            gone.close()

    def apply(self, settings: HubSettings) -> None:
        """Apply changed settings; unchanged endpoints keep their clients.

        Those whose options changed are changed in place, those added at run time stay.
        """
        before = {parse_endpoint(url).location for url in self.settings.endpoints}
        after = {parse_endpoint(url).location: url for url in settings.endpoints}
        self.settings = settings
        for location in before - after.keys():
            if location in self._endpoints:
                self.remove(location)
        for location, url in after.items():
            if location not in self._endpoints:
                self.add(url)
            elif (opened := self._endpoints[location]).endpoint.url != url:
                opened.reconfigure(parse_endpoint(url))

    def clients(self) -> tuple[ClientStats, ...]:
        """Return the present figures of every client, in the order of their ids."""
        self._fanout.settle()
        router, now_us = self._router, self.now_us()
        notes, hints = router.clash_notes(now_us), router.foreign_hints(now_us)
        return tuple(
            client.stats(
                router.origins(key), notes.get(key, ""), hints.get(key, ""), router.cached(client)
            )
            for key, client in sorted(self._clients.items())
        )

    def listeners(self) -> tuple[ListenerStats, ...]:
        """Return the present figures of every listening port, in the order of the settings."""
        return tuple(
            opened.stats() for opened in self._endpoints.values() if not isinstance(opened, Client)
        )

    def endpoints(self) -> tuple[str, ...]:
        """Return the URLs of all endpoints."""
        return tuple(opened.endpoint.url for opened in self._endpoints.values())

    def counters(self) -> HubCounters:
        """Return the totals since the start."""
        self._fanout.settle()
        counters = self._router.counters
        return replace(counters, forwarded=counters.forwarded + self._fanout.forwarded)

    def listening_ports(self) -> tuple[int, ...]:
        """Return the ports that listening endpoints have bound, in the order of the settings."""
        return tuple(listener.port for listener in self.listeners())

    def _share_reads(self) -> None:
        """Read the fewer bytes at one wake-up the more clients may get them."""
        fair = PASSED_ON_BYTES // max(len(self._clients), 1)
        self.read_bytes = min(max(fair, LEAST_READ_BYTES), READ_BYTES)
        self.forwarding.work.most = self.read_bytes

    def new_client_id(self) -> int:
        """Return an id that no client had before."""
        self._next_id += 1
        return self._next_id - 1

    def is_own(self, origin: Origin) -> bool:
        """Return whether a system and component is one of our vehicles."""
        return self._vehicles.is_own(origin, self.now_us())

    def appear(self, client: Client) -> None:
        """Add a client."""
        self._clients[client.client_id] = client
        self._share_reads()
        self._fanout.add(client)
        name = name_with_remote(client.name, client.remote)
        self._log_connection(client, f"client {client.client_id}: {name}")

    def reconfigure(self, client: Client) -> None:
        """Apply a client's changed options from the next frame on."""
        self._fanout.reconfigure(client)
        self._router.reconfigure(client)

    def flush_soon(self, wait_s: float, flush: Callable[[], None]) -> None:
        """Call back after the present events are handled, or after a wait.

        One handle of the loop serves all clients: a timer for each would cost more than it saves.
        """
        if gathering := self._gathering.get(wait_s):
            gathering.append(flush)
            return
        self._gathering[wait_s] = [flush]
        loop = asyncio.get_running_loop()
        if wait_s:
            loop.call_later(wait_s, self._flush, wait_s)
        else:
            # After one more poll of the sockets: a wake-up may read only one datagram.
            loop.call_soon(loop.call_soon, self._flush, wait_s)

    def _flush(self, wait_s: float) -> None:
        for flush in self._gathering.pop(wait_s, ()):
            flush()

    def vanish(self, client: Client) -> None:
        """Close a client and remove it."""
        self._fanout.remove(client.client_id)
        self._router.remove(client.client_id)
        self._vehicles.remove(client.client_id)
        if self._clients.pop(client.client_id, None):
            self._share_reads()
            name = name_with_remote(client.name, client.remote)
            self._log_connection(client, f"client {client.client_id} has gone: {name}")
            if self._on_gone is not None:
                self._on_gone(client.client_id)
        client.close()

    def _greet(self, frame: MavFrame, sequence: int, now_us: int) -> None:
        waiting, greeting = self._vehicles.greet(frame.origin)
        for client_id in waiting:
            if client := self._clients.get(client_id):
                passing = [each for each in greeting if client.endpoint.passes(each.message_id)]
                for before, each in zip(range(len(passing), 0, -1), passing, strict=True):
                    number = sequence - before & 0xFF
                    client.send(self.signer.sequence_and_sign(each, number, now_us))

    def _tick(self) -> None:
        # Scheduled first, so that the next tick follows even if an error is raised below.
        self._timer = asyncio.get_running_loop().call_later(TICK_S, self._tick)
        now_us = self.now_us()
        self._fanout.settle()
        for endpoint in list(self._endpoints.values()):
            if not isinstance(endpoint, Client):
                self._tick_one(endpoint, now_us)
        for client in list(self._clients.values()):
            self._tick_one(client, now_us)
        self._router.links.expire(now_us)
        self._fanout.thin(now_us)
        # One of the two per tick: each takes as long as several frames.
        if now_us - self._alerts_us >= US_PER_S:
            self._alerts_us = now_us
            self._report_alerts(now_us)
        else:
            self._measure_round_trips(now_us)

    def _tick_one(self, link: Client | Listener[Any], now_us: int) -> None:
        """Tick one link; one that raises is closed, logged, and retried."""
        try:
            link.tick(now_us)
        except Exception as error:
            log.exception("%s is closed and opened again", link.endpoint.name)
            with contextlib.suppress(Exception):
                link.fail(error)

    def _report_alerts(self, now_us: int) -> None:
        for line in self._connections.poll(now_us):
            log.info("%s", line)
        for is_problem, text in self._alerts.update(self.clients(), self.listeners(), now_us):
            log.log(logging.WARNING if is_problem else logging.INFO, "%s", text)
            if self._on_alert is not None:
                self._on_alert(is_problem, text)

    def _log_connection(self, client: Client, text: str) -> None:
        is_of_listener = client.endpoint.kind in LISTENERS
        for line in self._connections.add(text, self.now_us()) if is_of_listener else [text]:
            log.info("%s", line)

    def _measure_round_trips(self, now_us: int) -> None:
        """Send requests to every client that sends; each second to one that has to prove itself."""
        interval_us = round(self.settings.ping_interval_s * US_PER_S)
        is_due = 0 < interval_us <= now_us - self._ping_us
        if is_due:
            self._ping_us = now_us
        is_proof_due = now_us - self._proof_us >= US_PER_S
        if is_proof_due:
            self._proof_us = now_us
        own = self._vehicles.systems(now_us)
        systems = [*own, *sorted(self.routed_vehicles() - {*own})]
        asked: defaultdict[int, set[int]] = defaultdict(set)
        for client in self._clients.values():
            endpoint = client.endpoint
            if client.heard_us is None or endpoint.monitor or not client.is_measured:
                continue
            system = next(filter(endpoint.systems.has_system, systems), None)
            if system is not None and (is_due or (is_proof_due and not client.is_proven)):
                asked[system].add(client.client_id)
        for system, client_ids in asked.items():
            for frame in self._router.round_trip.ask(system, now_us):
                self._fanout.answer(frame, frame.sequence, client_ids, now_us, measures=True)
