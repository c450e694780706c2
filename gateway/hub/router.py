"""Routing of clients' frames: to our vehicles, to other systems, or nowhere.

Only frames of trusted clients enter the routing tables and are forwarded. Frames of the others
reach our vehicles, as requests that may be answered, and change nothing that other clients see.
"""

import asyncio
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from gateway.hub.express import Express, GuardedExpress
from gateway.hub.fanout import Fanout
from gateway.hub.own_vehicles import HEARTBEAT_ID, OwnVehicles
from gateway.hub.redundancy import RedundantLinks
from gateway.hub.request_queue import RequestQueue
from gateway.hub.round_trip import RoundTrip, is_of_probe
from gateway.hub.routing_table import ROUTE_FRESH_US, LoopGuard, Origin, RoutingTable
from gateway.hub.transports.base import Client
from gateway.records import Incoming
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import TARGET_OFFSETS
from gateway.wire.mavlink_splitter import (
    is_station_heartbeat,
    key_of,
    message_id_of,
    origin_of,
    target_of,
)

MAX_EXPRESS: Final = 1024
"""Kinds of frame per client; beyond a few hundred they are forged."""
MAX_CLAIMS: Final = 8
"""Systems that are shown for an untrusted client."""


class Router:
    """Route each received frame.

    Parameters
    ----------
    clients : mapping of int to Client
        All clients by id, as they are at any time.
    fanout : Fanout
        Sends frames to them.
    vehicles : OwnVehicles
        Ours.
    probe : RoundTrip
        Reads answers to our round-trip requests.
    on_frame : callable
        Takes requests to our vehicles.
    on_foreign : callable, optional
        Called with each frame that is forwarded.
    now_us : callable
        The gateway clock.
    """

    def __init__(
        self,
        clients: Mapping[int, Client],
        fanout: Fanout,
        vehicles: OwnVehicles,
        probe: RoundTrip,
        on_frame: Callable[[Incoming], None],
        on_foreign: Callable[[bytes], None] | None,
        now_us: Callable[[], int],
    ) -> None:
        self.duplicates = self.looped = self.unroutable = self.unserved = 0
        self._forwarded = 0
        self._clients = clients
        self._fanout = fanout
        self._vehicles = vehicles
        self._probe = probe
        self._on_frame = on_frame
        self._on_foreign = on_foreign
        self._now_us = now_us
        self._table = RoutingTable()
        self._claims = RoutingTable(MAX_CLAIMS)
        self._guard = LoopGuard()
        self._links = RedundantLinks()
        self._requests = RequestQueue()
        self._serving: int | None = None
        self._turn: asyncio.Handle | None = None
        self._pause: asyncio.TimerHandle | None = None
        self._express_sources: set[Client] = set()
        self._judged_us = 0

    @property
    def forwarded(self) -> int:
        """Frames of other systems that were forwarded."""
        self.settle_express()
        return self._forwarded

    def origins(self, client_id: int) -> tuple[Origin, ...]:
        """Return the systems and components heard from a client."""
        return self._table.origins(client_id) or self._claims.origins(client_id)

    def group(self, client_id: int) -> tuple[int, ...]:
        """Return all links to a client's peer."""
        return self._links.group(client_id)

    def charge(self, client_id: int | None, size: int) -> None:
        """Charge a client for a frame to it, or for one to all that it has just requested."""
        payer = self._serving if client_id is None else client_id
        if payer is not None:
            copies = len(self._clients) if client_id is None else 1
            self._requests.charge(payer, size * copies)

    def tick(self, now_us: int) -> None:
        """Separate links without copies, and thin the frames to narrow links."""
        self._links.expire(now_us)
        self.settle_express()
        if self._fanout.thin(now_us):
            self.forget_express()
        if now_us - self._judged_us >= ROUTE_FRESH_US:
            self._judged_us = now_us
            self.forget_express()

    def reconfigure(self, client: Client) -> None:
        """Apply a client's changed options; one no longer trusted leaves the routing tables."""
        self.forget_express()
        if client.trusted:
            self._claims.forget(client.client_id)
        else:
            self._table.forget(client.client_id)
            self._links.forget(client.client_id)

    def forget(self, client_id: int) -> None:
        """Forget everything about a client that has gone."""
        self.forget_express()
        self._table.forget(client_id)
        self._claims.forget(client_id)
        self._links.forget(client_id)
        self._requests.forget(client_id)

    def close(self) -> None:
        """Stop answering."""
        for handle in (self._turn, self._pause):
            if handle is not None:
                handle.cancel()

    def deliver(self, client: Client, frame: bytes, now_us: int) -> None:
        """Route one frame received from a client."""
        origin = origin_of(frame)
        if self._vehicles.is_own(origin, now_us) or origin == self._probe.origin:
            self.looped += 1
            return
        table = self._table if client.trusted else self._claims
        if table.hear(client.client_id, origin, now_us) and client.trusted:
            self.forget_express(origin)
        message_id = message_id_of(frame)
        if message_id == HEARTBEAT_ID:
            table.note_kind(client.client_id, origin, is_station=is_station_heartbeat(frame))
        round_trip_us = self._probe.read(frame, now_us)
        if round_trip_us is not None:
            client.round_trip_us = round_trip_us
            return
        is_copy = (
            client.trusted
            and table.is_shared(origin, now_us)
            and self._is_copy(client, origin, frame)
        )
        if is_of_probe(frame):
            # For each link separately, copies or not, and never forwarded.
            self._ask(client, frame, forwarded=False)
        elif is_copy:
            return
        elif target_of(frame)[0]:
            self._route_addressed(client, frame, now_us)
        else:
            self._route_broadcast(client, frame, table.is_station(origin), now_us)

    def forget_express(self, origin: Origin | None = None) -> None:
        """Discard the fast paths, or those of one system, because something has changed."""
        self.settle_express()
        if origin is None:
            for client in self._express_sources:
                client.express.clear()
            self._express_sources.clear()
            return
        head = bytes(origin)
        for client in self._express_sources:
            for key in [key for key in client.express if key.startswith(head)]:
                del client.express[key]

    def settle_express(self) -> None:
        """Bring all counters up to date."""
        for client in self._express_sources:
            for key, express in client.express.items():
                frames, size = express.settle()
                self._forwarded += frames
                if frames:
                    self._fanout.meter(key, int.from_bytes(key[2:5], "little"), frames, size)

    def _is_copy(self, client: Client, origin: Origin, frame: bytes) -> bool:
        """Note a frame of a system that is heard by several paths; return whether it is a copy."""
        client_id, now_us = client.client_id, self._now_us()
        since_us = self._table.since_us(client_id, origin)
        first = self._guard.first_way(frame, origin, client_id, since_us, now_us)
        if first is None:
            return False
        self.duplicates += 1
        if first != client_id:
            self._note_link(first, client, frame, now_us)
        return True

    def _note_link(self, first: int, client: Client, frame: bytes, now_us: int) -> None:
        """Join two links that bring the same frame, if neither can have it from us."""
        for_us = target_of(frame)[0] in self._vehicles.systems(now_us)
        if not (for_us or is_of_probe(frame)):
            return
        if self._links.note(first, client.client_id, now_us):
            self._fanout.align(self._links.group(client.client_id))
            if for_us:
                # The first request has been answered on one link only.
                self._ask(client, frame, forwarded=False)

    def _route_addressed(self, client: Client, frame: bytes, now_us: int) -> None:
        target = target_of(frame)
        ours = target[0] in self._vehicles.systems(now_us)
        ways = self._table.ways_to(target, client.client_id, now_us) if client.trusted else []
        if ours:
            self._ask(client, frame, forwarded=bool(ways))
        if ways:
            self._tap(frame)
            self._fanout.deliver(frame, ways)
        elif not ours:
            self.unroutable += 1

    def _route_broadcast(
        self, client: Client, frame: bytes, from_station: bool, now_us: int
    ) -> None:
        message_id = message_id_of(frame)
        telemetry = message_id != HEARTBEAT_ID and message_id not in TARGET_OFFSETS
        if from_station or not telemetry:
            self._ask(client, frame, forwarded=client.trusted)
        if not client.trusted:
            return
        self._tap(frame)
        if from_station:
            self._fanout.deliver(frame, self._table.ways_to_vehicles(client.client_id))
            return
        self._fanout.forward(frame, client.client_id, now_us)
        if telemetry and client.has_fast_path:
            self._open_express(client, frame, now_us)

    def _open_express(self, client: Client, frame: bytes, now_us: int) -> None:
        """Set up the fast path for frames of this kind, if all of them go to the same clients."""
        key, origin = key_of(frame), origin_of(frame)
        takers = self._fanout.takers(frame, client.client_id)
        if takers is None or key in client.express or len(client.express) >= MAX_EXPRESS:
            return
        clients = [self._clients[taker] for taker in takers]
        self._express_sources.add(client)
        way = (client, message_id_of(frame), clients, self._on_foreign)
        client.express[key] = (
            GuardedExpress(*way, partial(self._is_copy, client, origin))
            if self._table.is_shared(origin, now_us)
            else Express(*way)
        )

    def _tap(self, frame: bytes) -> None:
        self._forwarded += 1
        if self._on_foreign is not None:
            self._on_foreign(frame)

    def _ask(self, client: Client, frame: bytes, *, forwarded: bool) -> None:
        """Queue a request to our vehicles."""
        incoming = Incoming(client.client_id, frame, client.trusted, forwarded)
        if not self._requests.offer(incoming, self._now_us()):
            self.unserved += 1
        elif self._turn is None:
            self._serve()

    def _serve(self) -> None:
        """Answer one request; the next one only after other events."""
        self._turn = None
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
        now_us, loop = self._now_us(), asyncio.get_running_loop()
        incoming = self._requests.take(now_us)
        if incoming is None:
            wait_us = self._requests.wait_us(now_us)
            if wait_us is not None:
                self._pause = loop.call_later(wait_us / US_PER_S, self._serve)
            return
        # Before it is answered, so that one that raises does not hold up the others.
        self._turn = loop.call_soon(self._serve)
        self._serving = incoming.client_id
        try:
            if not self._answer_probe(incoming, now_us):
                self._on_frame(incoming)
        finally:
            self._serving = None

    def _answer_probe(self, incoming: Incoming, now_us: int) -> bool:
        """Answer another gateway's round-trip request; return whether it was one."""
        client = self._clients.get(incoming.client_id)
        systems = self._vehicles.systems(now_us)
        if not is_of_probe(incoming.frame):
            return False
        if client is not None and systems:
            answer = self._probe.answer(incoming.frame, systems[0], now_us)
            if answer is not None:
                self.charge(incoming.client_id, len(answer[0]))
                client.transmit(*answer)
        return True
