"""Routing of clients' frames: to our vehicles, to other systems, or nowhere.

Only frames of trusted clients enter the routing table and are forwarded. Frames of untrusted ones
reach our vehicles, as requests that may be answered, and change nothing that other clients see.
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from pymavlink.dialects.v20 import all as dialect

from gateway.answers.answer_cache import AnswerCache
from gateway.hub.duplicates import LATE, NEW, DuplicateFilter, FrameMemory, RedundantLinks
from gateway.hub.fanout import Fanout
from gateway.hub.limits import RequestQueue
from gateway.hub.own_vehicles import OwnVehicles
from gateway.hub.round_trip import MAX_ASKED, NOBODY, RoundTrip, is_of_gateway
from gateway.hub.route import OnForeign
from gateway.hub.routing_table import MEMORY_US, Origin, RoutingTable, SystemPath
from gateway.hub.stats import HubCounters
from gateway.hub.systems import Reach
from gateway.hub.transports.base import Client, HubContext
from gateway.records import Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import HEARTBEAT_ID, TARGET_OFFSETS
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from gateway.wire.system_ids import LAST_ID

UNADDRESSED_REQUESTS: Final = frozenset({HEARTBEAT_ID, dialect.MAVLINK_MSG_ID_TIMESYNC})
"""Messages without a target that our vehicles handle, from any sender."""
FILE_ID: Final = dialect.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
MAX_UNTRUSTED_SYSTEMS: Final = 8
"""Maximum systems that are shown for an untrusted client."""


class Router:
    """Route each received frame that has no cached route.

    `on_frame` handles requests to our vehicles, `on_foreign` is called with each frame that is
    forwarded, and `rejects` with each received one: if it returns True the frame is dropped.
    """

    def __init__(
        self,
        context: HubContext,
        clients: Mapping[int, Client],
        fanout: Fanout,
        vehicles: OwnVehicles,
        on_frame: Callable[[Incoming], None],
        on_foreign: OnForeign | None,
        rejects: Callable[[bytes, int], bool] | None,
    ) -> None:
        self.counters = HubCounters()
        self.links = RedundantLinks()
        self._context = context
        self._clients = clients
        self._fanout = fanout
        self._vehicles = vehicles
        self.round_trip = RoundTrip()
        self._on_frame = on_frame
        self._on_foreign = on_foreign
        self._rejects = rejects
        self._table = table = RoutingTable(fanout.clear)
        self.streams = table.streams
        fanout.hears_only_others = lambda key, system: self._table.systems(key).are_only_others(
            system
        )
        self._untrusted = RoutingTable(max_origins=MAX_UNTRUSTED_SYSTEMS)
        self._duplicates = DuplicateFilter()
        self._round_trips: FrameMemory[int] = FrameMemory(MEMORY_US, MAX_ASKED)
        """The first client that brought each round-trip request of another gateway."""
        self._requests = RequestQueue()
        self._cache = AnswerCache(context.signer)
        self._cache_timer: asyncio.TimerHandle | None = None
        self._serving: int | None = None
        self._turn: asyncio.Handle | None = None
        self._pause: asyncio.TimerHandle | None = None

    def origins(self, client_id: int) -> tuple[Origin, ...]:
        """Return the systems and components received from a client."""
        return self._table.origins(client_id) or self._untrusted.origins(client_id)

    def cached(self, client: Client) -> tuple[str, ...]:
        """List the kept answers of the systems of a client whose link has the option."""
        if not (client.trusted and client.endpoint.cache):
            return ()
        systems = sorted({system for system, _ in self.origins(client.client_id)})
        now_us = self._context.now_us()
        texts = (self._cache.describe(client.client_id, each, now_us) for each in systems)
        return tuple(filter(None, texts))

    def routed_vehicles(self) -> set[int]:
        """Return the systems of trusted clients that are not ground stations."""
        return {
            origin[0]
            for client_id in self._clients
            for origin in self._table.origins(client_id)
            if origin[0] and not self._table.is_station(client_id, origin)
        }

    def charge(self, client_id: int | None, size: int) -> None:
        """Charge a client for a frame to it, or for one to all that it has just requested."""
        payer = self._serving if client_id is None else client_id
        if payer is not None:
            copies = len(self._clients) if client_id is None else 1
            self._requests.charge(payer, size * copies)

    def reconfigure(self, client: Client) -> None:
        """Apply a client's changed options; one no longer trusted leaves the routing table."""
        self._cache.drop(client.client_id)
        if client.trusted:
            self._untrusted.remove(client.client_id)
        else:
            self._table.remove(client.client_id)
            self.links.remove(client.client_id)

    def remove(self, client_id: int) -> None:
        """Remove all state of a client that has gone."""
        self._cache.remove_client(client_id)
        for part in (self._table, self._untrusted, self.links, self._requests):
            part.remove(client_id)

    def close(self) -> None:
        """Stop answering."""
        for handle in (self._turn, self._pause, self._cache_timer):
            if handle is not None:
                handle.cancel()

    def deliver(self, client: Client, frame: MavFrame, now_us: int) -> None:
        """Route one frame received from a client for which there is no cached route."""
        if client.update_version(frame, now_us):
            self._fanout.reconfigure(client)
        origin = frame.origin
        if self._rejects is not None and self._rejects(frame.data, now_us):
            return
        if self._vehicles.is_own(origin, now_us) or self.round_trip.is_returned(frame):
            self.counters.looped += 1
            return
        round_trip_us = self.round_trip.read(frame, now_us)
        measures = round_trip_us is not None or is_of_gateway(frame)
        reach = Reach.EVERYWHERE if measures else self._reach(client, frame, now_us)
        if reach is Reach.NOWHERE:
            self.counters.unroutable += 1
            return
        if round_trip_us is not None:
            client.round_trip_us = round_trip_us
            client.prove()
        if not is_of_gateway(frame):
            self._route(client, frame, now_us, reach, is_answer=round_trip_us is not None)
        elif round_trip_us is None:
            # Its system has no path here: links are measured in the name of any system.
            self._note_request(client, frame, now_us)
            self._ask(client, frame, forwarded=False)

    def _route(
        self, client: Client, frame: MavFrame, now_us: int, reach: Reach, *, is_answer: bool
    ) -> None:
        """Route a frame of a system that is not ours, unless it answers the hub itself."""
        table, origin = self._table if client.trusted else self._untrusted, frame.origin
        path = table.register(client.client_id, origin, now_us)
        if path is not None and frame.message_id == HEARTBEAT_ID:
            table.read_heartbeat(client.client_id, path, frame, now_us)
        is_rejected = path is not None and self._is_rejected(client, path, frame, now_us)
        if is_rejected or is_answer:
            return
        if frame.target[0]:
            if path is not None:
                path.note_address(frame.target)
            self._route_addressed(client, frame, reach, now_us)
        else:
            self._route_broadcast(client, path, frame, reach, now_us)

    def _note_request(self, client: Client, frame: MavFrame, now_us: int) -> None:
        """Pair two links that bring the same round-trip request of another gateway."""
        if not client.trusted or frame.message_id != dialect.MAVLINK_MSG_ID_PING:
            return
        self._round_trips.turn(now_us)
        content = (frame.key, frame.payload)
        first = self._round_trips.get(content)
        if first is None:
            self._round_trips.put(content, client.client_id)
        elif first != client.client_id:
            self._pair(first, client, now_us)

    def _reach(self, client: Client, frame: MavFrame, now_us: int) -> Reach:
        """Return where the filter of a client's endpoint lets a frame received from it pass."""
        systems = client.endpoint.systems
        if not systems:
            return Reach.EVERYWHERE
        sender, client_id = frame.origin[0], client.client_id
        others = (key for key in self._clients if key != client_id)
        if not systems.has_system(sender) and (
            sender in self._vehicles.systems(now_us)
            or any(sender in self._table.systems(key).vehicles for key in others)
        ):
            # A station that uses the id of an excluded vehicle.
            return Reach.NOWHERE
        table = self._table if client.trusted else self._untrusted
        from_station = table.is_station(client_id, frame.origin)
        if frame.message_id == HEARTBEAT_ID:
            from_station = frame.is_station_heartbeat
        return systems.reach(frame, from_station=from_station)

    def _may_reach(self, client: Client, frame: MavFrame, reach: Reach, other_id: int) -> bool:
        """Return whether a frame without a target may be sent to another client."""
        there = self._table.systems(other_id)
        match reach:
            case Reach.STATIONS:
                only = self._clients[other_id].endpoint.systems.only
                is_for_same = bool(only) and only <= client.endpoint.systems.only
                return is_for_same or (there.has_station and there.has_only_stations)
            case Reach.DISPLAYS:
                return not there.are_only_others(frame.origin[0])
            case Reach.SELECTED:
                return all(map(client.endpoint.systems.has_system, there.vehicles))
        return True

    def _reaches_ours(self, client: Client, reach: Reach, now_us: int) -> bool:
        """Return whether a frame without a target may be processed by our vehicles."""
        own = self._vehicles.systems(now_us)
        is_selected = all(map(client.endpoint.systems.has_system, own))
        return reach is Reach.EVERYWHERE or (reach is Reach.SELECTED and is_selected)

    def clash_notes(self, now_us: int) -> dict[int, str]:
        """Return, by client, a text on how to separate its vehicle from another of the same id."""
        notes: dict[int, str] = {}
        origins = (each for key in self._clients for each in self._table.origins(key))
        taken = {system for system, _ in origins} | {*self._vehicles.systems(now_us)}
        for client_id, (system, first_id) in self._table.clashes(now_us).items():
            client, first = self._clients[client_id], self._clients[first_id]
            free = min({*range(1, LAST_ID)} - taken, default=LAST_ID)
            taken.add(free)
            text = f"system {system} is another vehicle than that of {first.name}"
            if client.endpoint is first.endpoint:
                notes[client_id] = f"{text}; let one connect to a port of its own with ?as={free}"
            else:
                joined = "&" if "?" in client.endpoint.url else "?"
                notes[client_id] = f"{text}; write {client.endpoint.url}{joined}as={free}"
        return notes

    def foreign_hints(self, now_us: int) -> dict[int, str]:
        """Return, by client, the option that ends mostly foreign telemetry on a vehicle's link."""
        hints: dict[int, str] = {}
        vehicles = self.routed_vehicles() | {*self._vehicles.systems(now_us)}
        shared = Counter(client.endpoint.location for client in self._clients.values())
        for client_id, client in self._clients.items():
            there, endpoint = self._table.systems(client_id), client.endpoint
            is_limited = endpoint.systems or endpoint.budget or endpoint.monitor
            if is_limited or not there.are_only_others(0) or vehicles <= there.all:
                continue
            if not self._fanout.has_mostly_telemetry(client_id):
                continue
            joined = "&" if "?" in endpoint.url else "?"
            option = f"systems={','.join(map(str, sorted(there.vehicles)))}"
            if shared[endpoint.location] > 1:
                option = "budget=BYTES, the bytes/s that each link carries"
            hints[client_id] = (
                "most frames to it are telemetry of other vehicles; "
                f"write {endpoint.url}{joined}{option}"
            )
        return hints

    def _is_rejected(self, client: Client, path: SystemPath, frame: MavFrame, now_us: int) -> bool:
        """Return whether a frame is a copy, or late; its system then has several paths."""
        client_id = client.client_id
        if not client.trusted:
            return False
        if not self._table.is_shared(frame.origin, now_us):
            path.stream.accept(frame.sequence, client_id, now_us)
            return False
        late_us = round(self._context.settings.late_after_s * US_PER_S)
        first = self._duplicates.check(frame, client_id, path, now_us, late_us)
        path.note_boot(frame, now_us)
        if first == NEW:
            return False
        if first == LATE:
            self.counters.late += 1
            return True
        self.counters.duplicates += 1
        # Neither link can have received from us what is for our vehicles.
        is_for_us = first != client_id and frame.target[0] in self._vehicles.systems(now_us)
        if is_for_us and self._pair(first, client, now_us):
            # The first request has been answered on one link only.
            self._ask(client, frame, forwarded=False)
        return True

    def _pair(self, first: int, client: Client, now_us: int) -> bool:
        """Note that two links lead to one peer; return whether that is new."""
        is_new = self.links.register(first, client.client_id, now_us)
        if is_new:
            self._fanout.align(self.links.group(client.client_id))
        return is_new

    def _keep(self, client: Client, frame: MavFrame, now_us: int) -> None:
        """Keep the answers of a client's vehicles, if its endpoint has the option `cache`."""
        if client.endpoint.cache and client.trusted:
            client_id, location = client.client_id, client.endpoint.location
            request = self._cache.add(client_id, location, frame, now_us)
            if request is not None:
                self._fanout.deliver(request, (client.client_id,), NOBODY)

    def _ask_cache(
        self, client: Client, frame: MavFrame, clients: list[int], now_us: int
    ) -> MavFrame | None:
        """Answer a request by kept answers; return the frame for the vehicle, if still needed."""
        kept = all(self._clients[key].endpoint.cache for key in clients)
        answers, passed = self._cache.handle(
            client.client_id,
            frame,
            now_us,
            clients,
            may_answer=kept and client.endpoint.cache is not False,
        )
        self._send_cached(answers)
        return passed

    def _send_cached(self, answers: list[Outgoing]) -> None:
        for each in answers:
            if each.client_id is not None:
                frame, links = each.header or frame_of(each.frame), self.links.group(each.client_id)
                self._fanout.insert(frame, links, self._table.newest_sequence(frame.origin))
        due_us = self._cache.next_due_us()
        if due_us is not None and self._cache_timer is None:
            wait_s = max(due_us - self._context.now_us(), 0) / US_PER_S
            loop = asyncio.get_running_loop()
            self._cache_timer = loop.call_later(wait_s, self._poll_cache)

    def _poll_cache(self) -> None:
        self._cache_timer = None
        self._send_cached(self._cache.poll(self._context.now_us()))

    def _route_addressed(self, client: Client, frame: MavFrame, reach: Reach, now_us: int) -> None:
        self._keep(client, frame, now_us)
        to_stations, table = reach is Reach.STATIONS, self._table
        ours = not to_stations and frame.target[0] in self._vehicles.systems(now_us)
        clients = table.clients_to(frame.target, client.client_id, now_us)
        if to_stations:
            asked = client.endpoint.systems.has
            clients = [key for key in clients if table.awaits_answer(key, frame.target, asked)]
        if client.endpoint.cache and frame.message_id == FILE_ID and len(clients) > 1:
            asker = self._cache.asker(client.client_id, frame)
            links = self.links.group(asker) if asker in clients else clients
            clients = [key for key in clients if key in links]
        if ours or clients:
            client.prove()
        if not client.trusted:
            clients = []
        if ours:
            self._ask(client, frame, forwarded=bool(clients))
        if clients:
            passed = self._ask_cache(client, frame, clients, now_us)
            if passed is None:
                return
            frame = passed
            self._count(frame)
        elif not ours:
            self.counters.unroutable += 1
        if client.trusted or ours:
            self._fanout.deliver(frame, clients, client.client_id)

    def _route_broadcast(
        self,
        client: Client,
        path: SystemPath | None,
        frame: MavFrame,
        reach: Reach,
        now_us: int,
    ) -> None:
        message_id = frame.message_id
        self._keep(client, frame, now_us)
        telemetry = message_id not in TARGET_OFFSETS and message_id not in UNADDRESSED_REQUESTS
        from_station = path is not None and path.is_station
        if (from_station or not telemetry) and self._reaches_ours(client, reach, now_us):
            self._ask(client, frame, forwarded=client.trusted)
        if not client.trusted:
            return
        reaches = partial(self._may_reach, client, frame, reach)
        if from_station:
            self._count(frame)
            clients = self._table.clients_with_vehicles(client.client_id)
            self._fanout.deliver(frame, [*filter(reaches, clients)], client.client_id)
            return
        route = client.routes.get(frame.key)
        if route is None:
            path = path or SystemPath(now_us)
            is_shared = self._table.is_shared(frame.origin, now_us)
            rejects = partial(self._is_rejected, client, path) if is_shared else None
            route = self._fanout.make_route(frame, client, path, rejects, reaches)
            is_kept = client.endpoint.cache and self._cache.reads(message_id)
            is_accepted = self._rejects is None or not client.may_return
            is_examined = not (telemetry and is_accepted) or is_kept
            self._fanout.keep_route(route, client, frame.key, is_examined=bool(is_examined))
        route.forward(frame, now_us, is_checked=True)

    def _count(self, frame: MavFrame) -> None:
        self.counters.forwarded += 1
        if self._on_foreign is not None:
            self._on_foreign((frame.data,))

    def _ask(self, client: Client, frame: MavFrame, *, forwarded: bool) -> None:
        """Queue a request to our vehicles."""
        incoming = Incoming(client.client_id, frame.data, client.trusted, forwarded)
        if not self._requests.offer(incoming, self._context.now_us()):
            self.counters.unserved += 1
        elif self._turn is None:
            self._serve()

    def _serve(self) -> None:
        """Answer one request; the next one only after other events."""
        self._turn = None
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
        now_us, loop = self._context.now_us(), asyncio.get_running_loop()
        incoming = self._requests.take(now_us)
        if incoming is None:
            wait_us = self._requests.wait_us(now_us)
            if wait_us is not None:
                self._pause = loop.call_later(wait_us / US_PER_S, self._serve)
            return
        # Scheduled before the answer, so that a request that raises does not delay the others.
        self._turn = loop.call_soon(self._serve)
        self._serving = incoming.client_id
        try:
            self._answer(incoming, now_us)
        finally:
            self._serving = None

    def _answer(self, incoming: Incoming, now_us: int) -> None:
        frame = frame_of(incoming.frame)
        if not is_of_gateway(frame):
            self._on_frame(incoming)
            return
        client = self._clients.get(incoming.client_id)
        systems = self._vehicles.systems(now_us)
        if client is not None:
            # A panel has no vehicle, and must answer to get the telemetry of a UDP port.
            answer = self.round_trip.answer(frame, systems[0] if systems else NOBODY, now_us)
            if answer is not None:
                self.charge(incoming.client_id, len(answer.data))
                self._fanout.answer(
                    answer, answer.sequence, {client.client_id}, now_us, measures=True
                )
