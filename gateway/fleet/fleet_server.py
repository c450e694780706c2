"""`mavgate fleet`: sites in, one picture out, through the hub that every gateway has."""

import asyncio
import logging
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Final

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.fleet.fleet_hub import FleetHub
from gateway.fleet.fleet_session import FleetSession, SessionEvents
from gateway.fleet.fleet_settings import FleetSettings
from gateway.fleet.frame_translation import FrameTranslation
from gateway.fleet.id_map import LEFT_OUT
from gateway.fleet.ids_file import IdsFile
from gateway.fleet.loop_watch import LoopWatch
from gateway.fleet.remote_recordings import RemoteRecordings
from gateway.fleet.site_client import SiteClient, site_endpoint
from gateway.hub.endpoint import SITE_NAME
from gateway.hub.settings import HubSettings
from gateway.live.control_socket import (
    ControlError,
    ControlServer,
    NoParams,
    socket_path,
)
from gateway.live.metrics_server import MetricsServer
from gateway.units import US_PER_S
from gateway.vehicle.signing import key_from_passphrase

log = logging.getLogger(__name__)

KEEP_S: Final = 1.0
"""How often changed ids are written, rates are taken, and the router is looked for."""
ONBOARD: Final = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER: its numbers are not the vehicle's, so that a text is no loss."""
MAX_SITES: Final = 2000
"""Names that strangers may fill the memory with."""
FORGET_US: Final = 3600 * US_PER_S
"""After so long without a frame a vehicle's id, or a site's place, may go to another."""


class IdParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vehicle of a site, and its id here."""

    site: str
    system_id: int
    own_id: int
    """0 to leave it out."""


class FleetServer:
    """Sites, their vehicles, and the ground stations here.

    Parameters
    ----------
    settings : FleetSettings
        Which sites, through which router.
    hub_settings : HubSettings
        Where ground stations are.

    Raises
    ------
    ValueError
        If a pattern, Zenoh's file or the file of ids is wrong.
    ModuleNotFoundError
        If Zenoh is not installed.
    """

    def __init__(self, settings: FleetSettings, hub_settings: HubSettings) -> None:
        self._now_us = GatewayClock()
        events = SessionEvents(self._take, self._note_session, self._note_round_trip)
        self._session = FleetSession(settings, events, self._now_us)
        self._ids_file = IdsFile(Path(settings.ids_file).expanduser())
        self._ids = self._ids_file.ids
        self._keys = {
            each.name: key_from_passphrase(each.passphrase)
            for each in settings.site
            if each.passphrase
        }
        self._ping_interval_us = round(hub_settings.ping_interval_s * US_PER_S)
        self._ping_us = 0
        self._loops = LoopWatch()
        self._hub = FleetHub(hub_settings, self._now_us, self._loops)
        self._metrics = MetricsServer(self._metrics_text)
        self._metrics_port = hub_settings.metrics_port
        self._sites: dict[str, SiteClient] = {}
        self._bad_names = 0
        self._task: asyncio.Task[None] | None = None
        self._control = ControlServer(socket_path("fleet"))
        self._control.register("fleet.status", NoParams, lambda _: self.status())
        self._control.register("fleet.id", IdParams, self._set_id)
        RemoteRecordings(self._session).register(self._control)

    @property
    def control_socket(self) -> Path:
        """Where it can be asked."""
        return self._control.path

    @property
    def place(self) -> str:
        """Where the router is, or where this one listens as the router."""
        return self._session.place

    async def start(self) -> None:
        """Open everything; a router that is not there yet is waited for.

        Raises
        ------
        ControlError
            If the control socket cannot be made.
        """
        await self._control.start()
        self._hub.start()
        self._metrics.listen(self._metrics_port)
        self._task = asyncio.get_running_loop().create_task(self._keep())

    def close(self) -> None:
        """End everything."""
        if self._task is not None:
            self._task.cancel()
        self._session.close()
        self._ids_file.close()
        self._metrics.close()
        self._hub.close()
        self._control.close()

    def status(self) -> dict[str, Any]:
        """Return sites and vehicles as they are now, for people and programs."""
        now_us = self._now_us()
        return {
            "router": self._session.place,
            "is_router": self._session.is_router,
            "is_linked": self._session.is_linked,
            "sites": [self._sites[name].describe(now_us) for name in sorted(self._sites)],
            "unmapped": sorted(f"{site}/{system}" for site, system in self._ids.unmapped),
            "left_out": sorted(f"{site}/{system}" for site, system in self._ids.left_out),
            "bad_names": self._bad_names,
            "looped": self._loops.looped,
            "overflowed": self._session.overflowed,
            "clients": [client for client in self._hub.clients() if client.name not in self._sites],
        }

    def _metrics_text(self) -> Iterator[str]:
        # Not above: most fleets serve no metrics, and need not wait for the library.
        from gateway.fleet.fleet_metrics import fleet_families
        from gateway.live.hub_metrics import hub_families, text_of

        status, hub = self.status(), self._hub
        clients = tuple(status["clients"])
        about_hub = hub_families(hub.counters(), hub.listeners(), clients, self._now_us())
        return text_of(chain(fleet_families(status), about_hub))

    async def _set_id(self, params: IdParams) -> list[str]:
        if not SITE_NAME.fullmatch(params.site):
            raise ControlError(f"site {params.site!r}: letters, digits, . _ and - only")
        try:
            if params.own_id == LEFT_OUT:
                self._ids.leave_out(params.site, params.system_id)
            else:
                self._ids.set_by_hand(params.site, params.system_id, params.own_id)
        except ValueError as error:
            raise ControlError(str(error)) from error
        if reason := await self._ids_file.keep():
            raise ControlError(
                f"the id counts from now on, but is not kept: {self._ids_file.file}: {reason}; "
                "it is tried again until the fleet ends"
            )
        return [
            f"{site}/{system} {f'= {own_id}' if own_id else 'is left out'}"
            for (site, system), own_id in self._ids.items()
        ]

    async def _keep(self) -> None:
        while True:
            await self._session.open()
            await self._ids_file.keep()
            now_us = self._now_us()
            for site in self._sites.values():
                site.translation.mark(now_us)
            self._make_room(now_us)
            if self._ping_interval_us and now_us - self._ping_us >= self._ping_interval_us:
                self._ping_us = now_us
                self._session.ask_round_trips()
            await asyncio.sleep(KEEP_S)

    def _make_room(self, now_us: int) -> None:
        """Let those wait no longer whom others, of whom nothing is heard, keep out."""
        if self._ids.unmapped:
            heard_us = {
                (name, system_id): traffic.heard_us
                for name, site in self._sites.items()
                for system_id, traffic in site.translation.traffic.items()
            }
            # One at a time: it takes some milliseconds where many wait.
            if done := self._ids.make_room(heard_us, now_us - FORGET_US):
                text = "id %d of %s/%d, long not heard, is that of %s/%d now"
                log.warning(text, done.own_id, *done.former, *done.holder)
        if len(self._sites) >= MAX_SITES:
            for name, site in list(self._sites.items()):
                if not site.is_here and now_us - (site.heard_us or site.since_us) > FORGET_US:
                    del self._sites[name]
                    self._hub.vanish(site)

    def _take(self, name: str, data: bytes, is_own: bool) -> None:
        if (site := self._site(name)) is not None:
            site.take(data, is_own=is_own)

    def _note_round_trip(self, name: str, round_trip_us: int) -> None:
        if (site := self._sites.get(name)) is not None:
            site.round_trip_us = round_trip_us

    def _site(self, name: str) -> SiteClient | None:
        if site := self._sites.get(name):
            return site
        if not SITE_NAME.fullmatch(name) or len(self._sites) >= MAX_SITES:
            self._bad_names += 1
            return None
        client = SiteClient(self._hub, self._hub.new_client_id(), site_endpoint(name))
        translation = FrameTranslation(name, self._ids, self._keys.get(name), self._loops)
        site = self._sites[name] = client.set_up(translation, lambda: self._session.outlets)
        self._hub.appear(site)
        return site

    def _note_session(self, name: str, token: str, is_here: bool) -> None:
        site = self._site(name)
        if site is None:
            return
        was_here = site.is_here
        if is_here:
            site.tokens.add(token)
            if len(site.tokens) > 1:
                log.warning("%d sites are called %r; rename one of them", len(site.tokens), name)
        else:
            site.tokens.discard(token)
        if site.is_here == was_here:
            return
        log.info("site %s %s", name, "is here" if site.is_here else "is gone")
        if not site.is_here:
            site.become("gone")
            site.round_trip_us = None
            self._report_gone(site)

    def _report_gone(self, site: SiteClient) -> None:
        """Report it to the ground stations once, in the name of each of the site's vehicles."""
        text = f"Site {site.endpoint.site} is gone"[:50].encode()
        for system_id in site.translation.traffic:
            own_id = self._ids.known_id(site.endpoint.site, system_id)
            if own_id is None:
                continue
            link = mavlink.MAVLink(None, own_id, ONBOARD)
            message = mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, text)
            frame = bytes(message.pack(link))
            site.receive([frame], len(frame), self._now_us())
