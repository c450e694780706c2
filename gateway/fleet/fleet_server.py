"""`mavgate fleet`: sites in, one picture out, through the hub that every gateway has."""

import asyncio
import json
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from gateway.edges.clock import GatewayClock
from gateway.edges.hub.fleet_link.site_keys import out_key, presence_key, site_of
from gateway.edges.hub.fleet_link.zenoh_session import (
    Inlet,
    Outlets,
    end_session,
    open_session,
    session_config,
)
from gateway.edges.hub.hub import Hub
from gateway.edges.operator.control_socket import (
    ControlError,
    ControlServer,
    NoParams,
    socket_path,
)
from gateway.fleet.fleet_settings import FleetSettings
from gateway.fleet.frame_translation import FrameTranslation
from gateway.fleet.id_map import IdMap
from gateway.fleet.site_client import SiteClient, site_endpoint
from gateway.routing.endpoint import SITE_NAME
from gateway.routing.hub_settings import HubSettings
from gateway.units import US_PER_S
from gateway.vehicle.signing import key_from_passphrase

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

PATTERN: Final = re.compile(r"[A-Za-z0-9_.*-]{1,64}")
KEEP_S: Final = 1.0
"""How often changed ids are written, and the router is looked for."""
ONBOARD: Final = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER: its numbers are not the vehicle's, so that a text is no loss."""
MAX_SITES: Final = 2000
"""Names that strangers may fill the memory with."""


class IdParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vehicle of a site, and its id here."""

    site: str
    system_id: int
    own_id: int


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
        self._settings = settings
        self._patterns = [_key_pattern(site) for site in settings.sites]
        self._is_router = not settings.router
        place = settings.router or settings.listen
        mode = "router" if self._is_router else "client"
        self._config = session_config(place, settings.zenoh_config, mode)
        self._place = place
        self._ids_file = Path(settings.ids_file).expanduser()
        self._ids = IdMap(_read_ids(self._ids_file))
        self._kept = self._ids.version
        self._keys = {
            each.name: key_from_passphrase(each.passphrase)
            for each in settings.site
            if each.passphrase
        }
        self._now_us = GatewayClock()
        self._hub = Hub(hub_settings, lambda _: None, self._now_us)
        self._sites: dict[str, SiteClient] = {}
        self._tokens: dict[str, set[str]] = {}
        self._left_out = 0
        self._session: zenoh.Session | None = None
        self._outlets: Outlets | None = None
        self._inlets: list[Inlet[Any]] = []
        self._declared: list[object] = []
        self._task: asyncio.Task[None] | None = None
        self._control = ControlServer(socket_path("fleet"))
        self._control.register("fleet.status", NoParams, lambda _: self.status())
        self._control.register("fleet.id", IdParams, self._set_id)

    @property
    def control_socket(self) -> Path:
        """Where it can be asked."""
        return self._control.path

    async def start(self) -> None:
        """Open everything; a router that is not there yet is waited for.

        Raises
        ------
        ControlError
            If the control socket cannot be made.
        """
        await self._control.start()
        self._hub.start()
        self._task = asyncio.get_running_loop().create_task(self._keep())

    async def close(self) -> None:
        """End everything."""
        if self._task is not None:
            self._task.cancel()
        for inlet in self._inlets:
            inlet.close()
        if self._outlets is not None:
            self._declared += self._outlets.close()
            self._outlets = None
        if self._session is not None:
            session, self._session = self._session, None
            await asyncio.to_thread(end_session, session, self._declared)
        self._write_ids()
        self._hub.close()
        self._control.close()

    def status(self) -> dict[str, Any]:
        """Return sites and vehicles as they are now, for people and programs."""
        routers = [] if self._session is None else self._session.info.routers_zid()
        return {
            "router": self._place,
            "is_router": self._is_router,
            "is_linked": self._session is not None and (self._is_router or bool(routers)),
            "sites": [self._site_status(name) for name in sorted(self._sites)],
            "unmapped": sorted(f"{site}/{system}" for site, system in self._ids.unmapped),
            "left_out": self._left_out,
            "clients": [client for client in self._hub.clients() if client.name not in self._sites],
        }

    def _site_status(self, name: str) -> dict[str, Any]:
        site, now_us = self._sites[name], self._now_us()
        counters = site.translation.counters
        vehicles = []
        for system_id, traffic in sorted(site.translation.traffic.items()):
            span_us = max(traffic.heard_us - traffic.since_us, 1)
            vehicles.append(
                {
                    "system_id": system_id,
                    "id": self._ids.known_id(name, system_id),
                    "rate_hz": (traffic.frames - 1) * US_PER_S / span_us,
                    "age_s": (now_us - traffic.heard_us) / US_PER_S,
                    "frames": traffic.frames,
                    "lost": traffic.lost,
                }
            )
        return {
            "name": name,
            "is_here": site.is_here,
            "sessions": len(self._tokens.get(name, ())),
            "vehicles": vehicles,
            "sent": site.counters.sent,
            "dropped": site.counters.dropped,
            "bytes_garbage": site.counters.bytes_garbage,
            "unknown": counters.unknown,
            "signed": counters.signed,
            "forged": counters.forged,
        }

    def _set_id(self, params: IdParams) -> list[str]:
        if not SITE_NAME.fullmatch(params.site):
            raise ControlError(f"site {params.site!r}: letters, digits, . _ and - only")
        try:
            self._ids.set_by_hand(params.site, params.system_id, params.own_id)
        except ValueError as error:
            raise ControlError(str(error)) from error
        self._write_ids()
        return [f"{site}/{system} = {own_id}" for (site, system), own_id in self._ids.items()]

    async def _keep(self) -> None:
        told = ""
        while True:
            if self._session is None:
                try:
                    session = await asyncio.to_thread(open_session, self._config)
                except OSError as error:
                    if str(error) != told:
                        told = str(error)
                        log.warning("%s: %s; trying again until it works", self._place, told)
                else:
                    self._declare(session)
            self._write_ids()
            await asyncio.sleep(KEEP_S)

    def _declare(self, session: "zenoh.Session") -> None:
        """Subscribe to the sites, and to their coming and going."""
        import zenoh

        self._session, self._outlets = session, Outlets(session)
        frames: Inlet[tuple[str, bytes]] = Inlet(self._take)
        presence: Inlet[tuple[bool, str]] = Inlet(self._note_token)
        self._inlets = [frames, presence]
        here = zenoh.SampleKind.PUT
        for pattern in self._patterns:
            self._declared += [
                session.declare_subscriber(
                    out_key(pattern, "*"),
                    lambda sample: frames.put((str(sample.key_expr), sample.payload.to_bytes())),
                ),
                session.liveliness().declare_subscriber(
                    presence_key(pattern, "*"),
                    lambda sample: presence.put((sample.kind == here, str(sample.key_expr))),
                    history=True,
                ),
            ]

    def _take(self, sample: tuple[str, bytes]) -> None:
        key, data = sample
        if (site := self._site(site_of(key))) is not None:
            site.take(data)

    def _site(self, name: str) -> SiteClient | None:
        if site := self._sites.get(name):
            return site
        if not SITE_NAME.fullmatch(name) or len(self._sites) >= MAX_SITES:
            self._left_out += 1
            return None
        client = SiteClient(self._hub, self._hub.new_client_id(), site_endpoint(name))
        translation = FrameTranslation(name, self._ids, self._keys.get(name))
        site = self._sites[name] = client.set_up(translation, lambda: self._outlets)
        self._hub.appear(site)
        return site

    def _note_token(self, news: tuple[bool, str]) -> None:
        is_here, key = news
        name, token = site_of(key), key.rpartition("/")[2]
        site = self._site(name)
        if site is None:
            return
        tokens = self._tokens.setdefault(name, set())
        if is_here:
            tokens.add(token)
            if len(tokens) > 1:
                log.warning("%d sites are called %r; rename one of them", len(tokens), name)
        else:
            tokens.discard(token)
        if bool(tokens) == site.is_here:
            return
        site.is_here = bool(tokens)
        log.info("site %s %s", name, "is here" if tokens else "is gone")
        if not tokens:
            site.become("gone")
            self._tell_gone(site)

    def _tell_gone(self, site: SiteClient) -> None:
        """Tell the ground stations once, in the name of each of the site's vehicles."""
        text = f"Site {site.endpoint.site} is gone"[:50].encode()
        for system_id in site.translation.traffic:
            own_id = self._ids.known_id(site.endpoint.site, system_id)
            if own_id is None:
                continue
            link = mavlink.MAVLink(None, own_id, ONBOARD)
            message = mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, text)
            frame = bytes(message.pack(link))
            site.receive([frame], len(frame), self._now_us())

    def _write_ids(self) -> None:
        if self._kept == self._ids.version:
            return
        table = {f"{site}/{system}": own_id for (site, system), own_id in self._ids.items()}
        try:
            self._ids_file.parent.mkdir(parents=True, exist_ok=True)
            fresh = self._ids_file.with_suffix(".new")
            fresh.write_text(json.dumps(table, indent=2) + "\n")
            fresh.replace(self._ids_file)
        except OSError as error:
            log.warning("%s: %s; ids are kept only until the end", self._ids_file, error.strerror)
        self._kept = self._ids.version


def _read_ids(file: Path) -> dict[tuple[str, int], int]:
    try:
        table = msgspec.json.decode(file.read_bytes(), type=dict[str, int])
    except FileNotFoundError:
        return {}
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{file}: {error}") from error
    ids: dict[tuple[str, int], int] = {}
    for vehicle, own_id in table.items():
        site, _, system = vehicle.rpartition("/")
        if not SITE_NAME.fullmatch(site) or not system.isdecimal():
            raise ValueError(f"{file}: {vehicle!r} is not SITE/SYSTEM")
        if own_id in ids.values():
            raise ValueError(f"{file}: id {own_id} is there twice")
        ids[site, int(system)] = own_id
    return ids


def _key_pattern(site: str) -> str:
    """Return a pattern of sites as Zenoh writes it in one part of a key."""
    if not PATTERN.fullmatch(site) or "**" in site:
        raise ValueError(f"site {site!r}: letters, digits, . _ - and single * only")
    return site if site == "*" else site.replace("*", "$*")
