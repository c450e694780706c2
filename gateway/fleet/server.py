"""`mavgate fleet`: the vehicles of many sites, shown to ground stations by one hub.

A site is one client of that hub; its vehicles have ids of the fleet.
"""

import asyncio
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.fleet.frame_translation import FrameTranslation
from gateway.fleet.id_map import LEFT_OUT, IdsFile, SiteVehicle
from gateway.fleet.loop_detection import LoopDetection
from gateway.fleet.remote_recordings import RemoteRecordings
from gateway.fleet.session import FleetSession, SessionEvents
from gateway.fleet.settings import FleetSettings
from gateway.hub.endpoint import SITE_NAME, Endpoint
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.transports.base import Client
from gateway.hub.transports.zenoh.session import RELIABLE_IDS, Payload, site_key
from gateway.live.control_socket import ControlError, ControlServer, Verbs, socket_path
from gateway.live.metrics_server import MetricsServer
from gateway.live.other_gateways import identity_verb
from gateway.units import US_PER_S
from gateway.vehicle.telemetry.announcements import TEXT_BYTES, utf8
from gateway.wire.framing import Fault
from gateway.wire.mavlink_signing import WindowVerifier, key_from_passphrase
from gateway.wire.mavlink_splitter import MavFrame, frame_of, split_datagram

log = logging.getLogger(__name__)

NO_BROADCASTS: Final = frozenset({1 << 24})
"""A number that no message has, as the only allowed one: no site receives the telemetry of another,
but only frames addressed to its vehicles, and broadcasts of ground stations."""
NO_CLIENT: Final = ""
"""Client of all sites without their own session."""
MAX_SESSIONS: Final = 16
"""Maximum stored sessions under the name of one site; more are forged."""


CAUSES: Final = ("unknown", "signed", "unsigned", "forged", "replayed", "looped")
"""Reasons for which frames of a site are dropped; see `FrameTranslation.counters`."""
POLL_S: Final = 1.0
"""Interval of writing changed ids, updating rates, and retrying the router."""
ONBOARD: Final = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER: its sequence numbers are independent of the autopilot's."""
MAX_SITES: Final = 2000
"""Maximum stored site names; more are forged."""
ABANDONED_US: Final = 3600 * US_PER_S
"""Time without a frame after which a vehicle may lose its id, and a site is removed."""


@dataclass(eq=False, kw_only=True)
class SiteClient(Client):
    """One site of the fleet."""

    session: FleetSession
    translation: FrameTranslation
    tokens: set[str] = field(default_factory=set)
    """Its sessions by Zenoh's liveliness; more than one means several sites of the same name."""
    may_return = is_measured = False

    @property
    def is_here(self) -> bool:
        """Whether one of its sessions is present."""
        return bool(self.tokens)

    def handle_presence(self, token: str, is_here: bool) -> bool:
        """Update its sessions; return whether the site has appeared or disappeared."""
        was_here = self.is_here
        if not is_here:
            self.tokens.discard(token)
        elif len(self.tokens) < MAX_SESSIONS and SITE_NAME.fullmatch(token):
            self.tokens.add(token)
        return self.is_here != was_here

    def handle(self, payload: Payload, *, is_own: bool) -> None:
        """Handle a published message, of the gateway's own vehicles or of its clients."""
        data, size = payload
        now_us = self.context.now_us()
        if not data:
            self.count_garbage(size)
            return
        if self.state != "open":
            self.become("open")
        for event in split_datagram(data):
            if isinstance(event, Fault):
                self.receive([event], event.size, now_us)
                continue
            frame = self.translation.from_site(event, now_us, is_own=is_own)
            if frame is not None:
                self.receive([frame], len(frame.data), now_us)

    def transmit(self, frame: MavFrame) -> None:
        """Publish a frame for a vehicle of the site."""
        publishers = self.session.publishers
        found = self.translation.to_site(frame, self.context.now_us())
        if publishers is None or found is None:
            self.counters.dropped += 1
            return
        system_id, changed = found
        key = site_key(self.endpoint.site, system_id, "in")
        if publishers.publish(key, changed.data, reliable=frame.message_id in RELIABLE_IDS):
            self.counters.sent += 1
            self.counters.bytes_sent += len(changed.data)
        else:
            self.counters.dropped += 1

    def describe(self, now_us: int) -> dict[str, Any]:
        """Return the present state of the site and its vehicles."""
        round_trip_us, dropped = self.round_trip_us, self.translation.counters
        return {
            "name": self.endpoint.site,
            "is_here": self.is_here,
            "sessions": len(self.tokens),
            "round_trip_s": None if round_trip_us is None else round_trip_us / US_PER_S,
            "vehicles": [
                {
                    "system_id": system_id,
                    "id": self.translation.id_of(system_id),
                    "rate_hz": traffic.rate_hz(now_us),
                    "age_s": (now_us - traffic.received_us) / US_PER_S,
                    "frames": traffic.frames,
                    "lost": traffic.lost,
                }
                for system_id, traffic in sorted(self.translation.traffic.items())
            ],
            "sent": self.counters.sent,
            "dropped": self.counters.dropped,
            "bytes_garbage": self.counters.bytes_garbage,
            **{cause: dropped[cause] for cause in CAUSES},
        }

    @property
    def queued(self) -> int:
        """Number of frames of all sites that wait for a congested link."""
        publishers = self.session.publishers
        return 0 if publishers is None else publishers.queued


def site_endpoint(site: str) -> Endpoint:
    """Return the endpoint that represents a site in tables."""
    url = f"site:{site}"
    return Endpoint(
        url=url, kind="site", host=site, port=0, location=url, name=site, allow=NO_BROADCASTS,
        trusted=True, site=site,
    )  # fmt: skip


class FleetServer:
    """Sites, their vehicles, and the ground stations here.

    Raises ValueError if a pattern, Zenoh's file or the file of ids is malformed, or it would listen
    beyond loopback without authentication; ModuleNotFoundError if Zenoh is not installed.
    """

    def __init__(self, settings: FleetSettings, hub_settings: HubSettings) -> None:
        self._now_us = GatewayClock()
        events = SessionEvents(self._handle, self._handle_presence, self._handle_round_trip)
        self._session = FleetSession(settings, events, self._now_us)
        self._ids_file = IdsFile(Path(settings.ids_file).expanduser(), settings.vehicles_per_site)
        self._ids = self._ids_file.ids
        at_zero_us = time.time_ns() // 1000 - self._now_us()
        self._signatures = {
            each.name: WindowVerifier(key_from_passphrase(each.passphrase), at_zero_us)
            for each in settings.site
            if each.passphrase
        }
        self._ping_interval_us = round(hub_settings.ping_interval_s * US_PER_S)
        self._ping_us = 0
        self._loops = LoopDetection()
        self._hub = Hub(
            hub_settings, lambda _: None, self._now_us, rejects=self._loops.is_returned_by_client
        )
        self._metrics = MetricsServer(self._metrics_text)
        self._metrics_port = hub_settings.metrics_port
        self._sites: dict[str, SiteClient] = {}
        self._site_of_session: dict[str, str] = {}
        """The first site that each linked session has announced."""
        self._bad_names = 0
        self._task: asyncio.Task[None] | None = None
        own: Verbs = {"fleet.status": self.status, "fleet.id": self._set_id}
        recordings = RemoteRecordings(self._session)
        identity = identity_verb(
            lambda: {own_id for _, own_id in self._ids.items() if own_id}, self._hub.endpoints
        )
        self._control = ControlServer(socket_path("fleet"), identity, own, recordings.verbs())

    @property
    def control_socket(self) -> Path:
        """Path of the control socket."""
        return self._control.path

    @property
    def locator(self) -> str:
        """Locator of the router, or at which this fleet listens as the router."""
        return self._session.locator

    async def start(self) -> None:
        """Open everything, and retry the router; raises ControlError without a control socket."""
        if self._session.warning:
            log.warning("%s", self._session.warning)
        await self._control.start()
        self._hub.start()
        self._metrics.listen(self._metrics_port)
        self._task = asyncio.get_running_loop().create_task(self._poll())

    def close(self) -> None:
        """Close everything."""
        if self._task is not None:
            self._task.cancel()
        self._session.close()
        self._ids_file.close()
        self._metrics.close()
        self._hub.close()
        self._control.close()

    def status(self) -> dict[str, Any]:
        """Return the present state of sites and vehicles."""
        now_us = self._now_us()
        return {
            "router": self._session.locator,
            "is_router": self._session.is_router,
            "is_linked": self._session.is_linked,
            "sites": [self._sites[name].describe(now_us) for name in sorted(self._sites)],
            "unmapped": sorted(f"{site}/{system}" for site, system in self._ids.unmapped),
            "without_session": sorted(
                site for site, client in self._ids.clients.items() if client == NO_CLIENT
            ),
            "left_out": sorted(f"{site}/{system}" for site, system in self._ids.left_out),
            "bad_names": self._bad_names,
            "looped": self._loops.looped,
            "overflowed": self._session.overflowed,
            "clients": [client for client in self._hub.clients() if client.name not in self._sites],
        }

    def _metrics_text(self) -> Iterator[str]:
        # Imported late: most fleets serve no metrics.
        from gateway.fleet.metrics import fleet_families
        from gateway.live.metrics import hub_families, text_of

        status, hub = self.status(), self._hub
        clients = tuple(status["clients"])
        about_hub = hub_families(hub.counters(), hub.listeners(), clients, self._now_us())
        return text_of(chain(fleet_families(status), about_hub))

    async def _set_id(self, site: str, system_id: int, own_id: int) -> list[str]:
        if not SITE_NAME.fullmatch(site):
            raise ControlError(f"site {site!r}: only letters, digits, . _ and - are allowed")
        known = {*self._sites, *(named for (named, _), _ in self._ids.items())}
        if site not in known:
            raise ControlError(f"unknown site {site!r}; known: {', '.join(sorted(known))}")
        if own_id == LEFT_OUT:
            self._ids.leave_out(site, system_id)
        else:
            self._ids.set_by_hand(site, system_id, own_id)
        if reason := await self._ids_file.keep():
            raise ControlError(
                f"the id is used from now on, but not saved: {self._ids_file.file}: {reason}; "
                "writing is retried until the fleet ends"
            )
        return [
            f"{site}/{system} {f'= {own_id}' if own_id else 'is excluded'}"
            for (site, system), own_id in self._ids.items()
        ]

    async def _poll(self) -> None:
        while True:
            await self._session.open()
            await self._ids_file.keep()
            now_us = self._now_us()
            for site in self._sites.values():
                site.translation.mark(now_us)
            self._find_clients()
            self._make_room(now_us)
            if self._ping_interval_us and now_us - self._ping_us >= self._ping_interval_us:
                self._ping_us = now_us
                self._session.ask_round_trips()
            await asyncio.sleep(POLL_S)

    def _find_clients(self) -> None:
        """Note the client of each site, so that no client gets all ids by using many names.

        A site belongs to the linked session that announces it, and a session has only one site.
        All sites without their own session share the quota of one client.
        """
        if (clients := self._session.clients()) is None:
            return
        sessions = self._site_of_session
        for gone in sessions.keys() - clients.keys():
            del sessions[gone]
        for name, site in self._sites.items():
            tokens = (
                t for t in site.tokens & clients.keys() if sessions.setdefault(t, name) == name
            )
            owners = {clients[token] for token in tokens}
            # A site stays with the first of several sessions that announce it.
            if owners and self._ids.clients.get(name) not in owners:
                self._ids.set_client(name, min(owners))

    def _make_room(self, now_us: int) -> None:
        """Reassign the id of one abandoned vehicle, and remove abandoned sites."""
        if self._ids.unmapped:
            received_us = {
                SiteVehicle(name, system_id): traffic.received_us
                for name, site in self._sites.items()
                for system_id, traffic in site.translation.traffic.items()
            }
            # One at a time, which takes some milliseconds if many vehicles wait.
            if done := self._ids.make_room(received_us, now_us - ABANDONED_US):
                text = "id %d of %s/%d, not received for an hour, is now of %s/%d"
                log.warning(text, done.own_id, *done.former, *done.holder)
        if len(self._sites) >= MAX_SITES:
            for name, site in list(self._sites.items()):
                if not site.is_here and now_us - (site.heard_us or site.since_us) > ABANDONED_US:
                    del self._sites[name]
                    self._ids.clients.pop(name, None)
                    self._hub.vanish(site)

    def _handle(self, name: str, payload: Payload, is_own: bool) -> None:
        if (site := self._site(name)) is not None:
            site.handle(payload, is_own=is_own)

    def _handle_round_trip(self, name: str, round_trip_us: int) -> None:
        if (site := self._sites.get(name)) is not None:
            site.round_trip_us = round_trip_us

    def _site(self, name: str) -> SiteClient | None:
        if site := self._sites.get(name):
            return site
        if not SITE_NAME.fullmatch(name) or len(self._sites) >= MAX_SITES:
            self._bad_names += 1
            return None
        site = self._sites[name] = SiteClient(
            self._hub,
            self._hub.new_client_id(),
            site_endpoint(name),
            session=self._session,
            translation=FrameTranslation(name, self._ids, self._signatures.get(name), self._loops),
        )
        if self._session.is_router:
            self._ids.set_client(name, NO_CLIENT)
        self._hub.appear(site)
        return site

    def _handle_presence(self, name: str, token: str, is_here: bool) -> None:
        site = self._site(name)
        if site is None:
            return
        before = len(site.tokens)
        has_changed = site.handle_presence(token, is_here)
        if 1 < len(site.tokens) > before:
            log.warning("%d sites are called %r; rename one of them", len(site.tokens), name)
        if not has_changed:
            return
        log.info("site %s %s", name, "connected" if site.is_here else "disconnected")
        if not site.is_here:
            site.become("gone")
            site.round_trip_us = None
            self._report_gone(site)

    def _report_gone(self, site: SiteClient) -> None:
        """Send the ground stations one text from each of the site's vehicles."""
        text = utf8(f"Site {site.endpoint.site} disconnected", TEXT_BYTES)
        for system_id in site.translation.traffic:
            own_id = self._ids.known_id(site.endpoint.site, system_id)
            if own_id is None:
                continue
            link = mavlink.MAVLink(None, own_id, ONBOARD)
            message = mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, text)
            frame = frame_of(bytes(message.pack(link)))
            site.receive([frame], len(frame.data), self._now_us())
