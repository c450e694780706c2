"""The hub: every frame of ours goes to every client, and clients' frames are routed."""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import msgspec

from gateway.hub.client_alerts import TroubleWatch
from gateway.hub.client_table import ClientStats, HubCounters, ListenerStats
from gateway.hub.endpoint import parse_endpoint
from gateway.hub.fanout import Fanout
from gateway.hub.log_rate_limiter import Digest
from gateway.hub.own_vehicles import OwnVehicles
from gateway.hub.round_trip import RoundTrip
from gateway.hub.router import Router
from gateway.hub.routing_table import Origin
from gateway.hub.settings import HubSettings
from gateway.hub.token_bucket import Purse
from gateway.hub.transports.base import (
    READ_BYTES,
    STRANGERS_READ_BURST,
    STRANGERS_READ_RATE,
    Client,
)
from gateway.hub.transports.listener import Listener
from gateway.hub.transports.registry import CLIENTS, LISTENERS
from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import restamp

log = logging.getLogger(__name__)

TICK_S: Final = 0.25
"""Often enough for expiry and reconnection, too seldom to cost anything."""
VISITS_IN_FULL: Final = 30
"""Connects and disconnects at listening ports that are logged one by one in a minute."""
SENDS_AT_ONCE: Final = 8
"""Of a burst of our own frames, before the loop does other work: each takes some tens of µs."""
LEAST_READ_BYTES: Final = 192
"""Some frames: of fewer each wake-up would cost more than they do."""
PASSED_ON_BYTES: Final = 12_288
"""Read from one client at one wake-up, times the clients that may take it: some 250 sends, about a
millisecond, so that a flooding client delays the others by no more."""
MAX_WAITING: Final = 256
"""Frames of a burst that wait. More are sent at once, so a loop that is too slow reads less."""


class Hub:
    """Send MAVLink to many clients, receive theirs, and route between them.

    Parameters
    ----------
    settings : HubSettings
        Endpoints and limits.
    on_frame : callable
        Called with every frame for our vehicles, every request to all, and every heartbeat, within
        the client's quota of answers.
    now_us : callable
        The gateway clock.
    on_foreign : callable, optional
        Called with every frame of another system, once, byte for byte, as for a recorder.
    on_gone : callable, optional
        Called with the id of a client that has gone for good.
    on_trouble : callable, optional
        Called when a problem of a client begins (True) or ends, with a short text.
    seal : callable, optional
        Numbers, and signs, each frame of ours that leaves; without it none is signed.
    recordings : Path, optional
        Folder of the recordings that a fleet may fetch.
    """

    def __init__(
        self,
        settings: HubSettings,
        on_frame: Callable[[Incoming], None],
        now_us: Callable[[], int],
        on_foreign: Callable[[bytes], None] | None = None,
        on_gone: Callable[[int], None] | None = None,
        on_trouble: Callable[[bool, str], None] | None = None,
        seal: Seal = restamp,
        recordings: Path | None = None,
    ) -> None:
        self.settings = settings
        self.recordings = recordings
        self.seal = seal
        self.now_us = now_us
        self.strangers = Purse(STRANGERS_READ_RATE, STRANGERS_READ_BURST, STRANGERS_READ_BURST)
        self._on_gone = on_gone
        self._on_trouble = on_trouble
        self._trouble = TroubleWatch()
        self._visits = Digest(VISITS_IN_FULL, "more comings and goings at listening ports")
        self._fanout = Fanout(seal)
        self._probe = RoundTrip(seal)
        self._clients: dict[int, Client] = {}
        self._endpoints: dict[str, Client | Listener[Any]] = {}
        self._next_id = 1
        self._vehicles = OwnVehicles(seal)
        self._router = Router(
            self._clients,
            self._fanout,
            self._vehicles,
            self._probe,
            on_frame,
            on_foreign,
            now_us,
        )
        self.deliver = self._router.deliver
        self._ping_us = self._trouble_us = 0
        self._timer: asyncio.TimerHandle | None = None
        self._published = 0
        self._gathering: dict[float, list[Callable[[], None]]] = {}
        """Callbacks to flush, by their wait."""
        self._burst: deque[Outgoing] = deque()
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
        for outgoing in self._burst:
            self._send(outgoing)
        for place in list(self._endpoints):
            self.remove(place)

    def send(self, outgoing: Outgoing) -> None:
        """Send one of our own frames to every client that takes it, or to the one it answers."""
        self._router.charge(outgoing.client_id, len(outgoing.frame))
        self._send(outgoing)

    def send_all(self, frames: Iterable[Outgoing]) -> None:
        """Send frames of ours in their order; those of a burst over several turns of the loop."""
        for outgoing in frames:
            # Now, while it is known who has asked.
            self._router.charge(outgoing.client_id, len(outgoing.frame))
            self._burst.append(outgoing)
        if self._burst_turn is None:
            self._send_some()

    def _send_some(self) -> None:
        self._burst_turn = None
        room = SENDS_AT_ONCE
        try:
            while self._burst and (room > 0 or len(self._burst) > MAX_WAITING):
                outgoing = self._burst.popleft()
                room -= len(self._clients) if outgoing.client_id is None else 1
                self._send(outgoing)
        finally:
            if self._burst:
                self._burst_turn = asyncio.get_running_loop().call_soon(self._send_some)

    def _send(self, outgoing: Outgoing) -> None:
        frame = outgoing.frame
        self._published += 1
        if self._vehicles.has_newcomers:
            self._welcome(frame)
        if outgoing.client_id is not None:
            self._fanout.answer(frame, self._router.group(outgoing.client_id))
            return
        now_us = self.now_us()
        if self._vehicles.note(frame, outgoing.message_id, now_us):
            self._router.forget_express()
        self._fanout.publish(frame, now_us)

    def set_interval(self, wish: ClientInterval) -> None:
        """Send a client one message of one system at the rate that it requested."""
        for client_id in self._router.group(wish.client_id):
            self._fanout.set_interval(msgspec.structs.replace(wish, client_id=client_id))
        self._router.forget_express()

    def add(self, url: str) -> None:
        """Open one more endpoint.

        Raises
        ------
        ValueError
            If the URL is not understood, or the same endpoint exists already.
        """
        endpoint = parse_endpoint(url)
        if endpoint.place in self._endpoints:
            raise ValueError(f"endpoint {endpoint.place!r} is there already")
        now_us = self.now_us()
        if listen := LISTENERS.get(endpoint.kind):
            listener = self._endpoints[endpoint.place] = listen(self, endpoint)
            self._tick_one(listener, now_us)
            return
        client = CLIENTS[endpoint.kind](self, self.new_client_id(), endpoint)
        self._endpoints[endpoint.place] = client
        self._tick_one(client, now_us)
        self.appear(client)

    def remove(self, name: str) -> None:
        """Close an endpoint.

        Parameters
        ----------
        name : str
            Its URL, with or without options, or its name.

        Raises
        ------
        ValueError
            If there is no such endpoint.
        """
        for place, opened in self._endpoints.items():
            if name in (place, opened.endpoint.name, opened.endpoint.url):
                break
        else:
            raise ValueError(f"no endpoint is called {name!r}")
        gone = self._endpoints.pop(place)
        if isinstance(gone, Client):
            self.vanish(gone)
        else:
            gone.close()

    def apply(self, settings: HubSettings) -> None:
        """Apply changed settings; unchanged endpoints keep their clients.

        Those whose options changed are changed in place, those added at run time stay.
        """
        before = {parse_endpoint(url).place for url in self.settings.endpoints}
        after = {parse_endpoint(url).place: url for url in settings.endpoints}
        self.settings = settings
        for place in before - after.keys():
            if place in self._endpoints:
                self.remove(place)
        for place, url in after.items():
            if place not in self._endpoints:
                self.add(url)
            elif (opened := self._endpoints[place]).endpoint.url != url:
                opened.reconfigure(parse_endpoint(url))

    def clients(self) -> tuple[ClientStats, ...]:
        """Return the present figures of every client, in the order of their ids."""
        self._router.settle_express()
        return tuple(
            self._clients[key].stats(self._router.origins(key)) for key in sorted(self._clients)
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
        router = self._router
        return HubCounters(
            published=self._published,
            forwarded=router.forwarded,
            duplicates=router.duplicates,
            looped=router.looped,
            unroutable=router.unroutable,
            unserved=router.unserved,
        )

    def listening_ports(self) -> tuple[int, ...]:
        """Return the ports that listening endpoints have bound, in the order of the settings."""
        return tuple(listener.port for listener in self.listeners())

    @property
    def read_bytes(self) -> int:
        """How much to read from one client at one wake-up: less where it may go to many."""
        fair = PASSED_ON_BYTES // max(len(self._clients), 1)
        return min(max(fair, LEAST_READ_BYTES), READ_BYTES)

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
        self._fanout.add(client.client_id, client.transmit, client.endpoint)
        self._router.forget_express()
        self._log_visit(client, f"client {client.client_id}: {client.remote}")

    def greet(self, client: Client) -> None:
        """Send the vehicles' greetings, heartbeat and home, to a new peer."""
        self._vehicles.await_greeting(client.client_id)

    def reconfigure(self, client: Client) -> None:
        """Apply a client's changed lists and rates from the next frame on."""
        self._fanout.reconfigure(client.client_id, client.endpoint)
        self._router.reconfigure(client)

    def flush_soon(self, flush: Callable[[], None], wait_s: float) -> None:
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
            # Not before the sockets were looked at once more: a wake-up may read one datagram only.
            loop.call_soon(loop.call_soon, self._flush, wait_s)

    def _flush(self, wait_s: float) -> None:
        for flush in self._gathering.pop(wait_s, ()):
            flush()

    def note_buffer(self, client: Client, free_percent: int) -> None:
        """Adapt the rate to a radio to the room in its buffer."""
        self._fanout.note_buffer(client.client_id, free_percent)

    def vanish(self, client: Client) -> None:
        """Close a client and remove it."""
        self._fanout.remove(client.client_id)
        self._router.forget(client.client_id)
        self._vehicles.forget(client.client_id)
        if self._clients.pop(client.client_id, None):
            self._log_visit(client, f"client {client.client_id} has gone: {client.remote}")
            if self._on_gone is not None:
                self._on_gone(client.client_id)
        client.close()

    def _welcome(self, frame: bytes) -> None:
        newcomers, greeting = self._vehicles.greet(frame)
        for client_id in newcomers:
            if client := self._clients.get(client_id):
                for greeting_frame, message_id in greeting:
                    client.transmit(greeting_frame, message_id)

    def _tick(self) -> None:
        # First, so that the next tick comes whatever happens below.
        self._timer = asyncio.get_running_loop().call_later(TICK_S, self._tick)
        now_us = self.now_us()
        for endpoint in list(self._endpoints.values()):
            if not isinstance(endpoint, Client):
                self._tick_one(endpoint, now_us)
        for client in list(self._clients.values()):
            self._tick_one(client, now_us)
        self._router.tick(now_us)
        interval_us = round(self.settings.ping_interval_s * US_PER_S)
        # One at a tick: either takes as long as several frames.
        if now_us - self._trouble_us >= US_PER_S:
            self._trouble_us = now_us
            self._report_trouble(now_us)
        elif interval_us and now_us - self._ping_us >= interval_us:
            self._ping_us = now_us
            self._ask_round_trips(now_us)

    def _tick_one(self, link: Client | Listener[Any], now_us: int) -> None:
        """Tick one link; one that raises is closed, logged, and retried."""
        try:
            link.tick(now_us)
        except Exception as error:
            log.exception("%s is closed and tried again", link.endpoint.name)
            with contextlib.suppress(Exception):
                link.fail(error)

    def _report_trouble(self, now_us: int) -> None:
        for line in self._visits.poll(now_us):
            log.info("%s", line)
        for is_trouble, text in self._trouble.update(self.clients(), self.listeners(), now_us):
            log.log(logging.WARNING if is_trouble else logging.INFO, "%s", text)
            if self._on_trouble is not None:
                self._on_trouble(is_trouble, text)

    def _log_visit(self, client: Client, text: str) -> None:
        is_caller = client.endpoint.kind in LISTENERS
        for line in self._visits.say(text, self.now_us()) if is_caller else [text]:
            log.info("%s", line)

    def _ask_round_trips(self, now_us: int) -> None:
        """Send round-trip requests to every client that sends; the others only receive."""
        asked = [client for client in self._clients.values() if client.heard_us is not None]
        systems = self._vehicles.systems(now_us)
        if not asked or not systems:
            return
        questions = self._probe.ask(systems[0], now_us)
        for client in asked:
            for frame, message_id in questions:
                client.transmit(frame, message_id)
