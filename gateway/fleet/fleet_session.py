"""The Zenoh session of a fleet: opened until it works, declared, asked, and ended."""

import logging
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from gateway.edges.hub.fleet_link.site_keys import OWN, out_key, ping_key, presence_key, site_of
from gateway.edges.hub.fleet_link.zenoh_session import (
    Inlet,
    Outlets,
    Reader,
    end_session,
    frames_of,
    open_session,
    session_config,
)
from gateway.edges.hub.fleet_link.zenoh_threads import off_loop
from gateway.fleet.fleet_settings import FleetSettings

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

PATTERN: Final = re.compile(r"[A-Za-z0-9_.*-]{1,64}")
MAX_KEYS: Final = 4096
"""More than there are vehicles that can have an id."""
PING_TIMEOUT_S: Final = 5.0
"""An answer that takes longer says nothing of the link."""


@dataclass(frozen=True, slots=True)
class SessionEvents:
    """What is called on the loop."""

    frames: Callable[[str, bytes, bool], None]
    """With a site, what it has published, and whether that is of its gateway's own vehicles."""
    presence: Callable[[str, str, bool], None]
    """With a site, one of its sessions, and whether that has come or gone."""
    round_trip: Callable[[str, int], None]
    """With a site and the microseconds until it had answered."""


class NoAnswerError(Exception):
    """Nobody answered a query: the site, or the router, is not there."""


class QueryRefusedError(Exception):
    """A site refused a query; the text says why."""


class FleetSession:
    """A session that subscribes to sites.

    Parameters
    ----------
    settings : FleetSettings
        Which sites, the router, and Zenoh's own file.
    events : SessionEvents
        Who takes what comes.
    now_us : callable
        The gateway clock.

    Raises
    ------
    ValueError
        If a pattern, Zenoh's file or the place is wrong.
    ModuleNotFoundError
        If Zenoh is not installed.
    """

    def __init__(
        self,
        settings: FleetSettings,
        events: SessionEvents,
        now_us: Callable[[], int],
    ) -> None:
        self.is_router = not settings.router
        self.place = settings.router or settings.listen
        mode = "router" if self.is_router else "client"
        self._config = session_config(self.place, settings.zenoh_config, mode)
        self.patterns = [key_pattern(site) for site in settings.sites]
        self._events = events
        self._now_us = now_us
        self._session: zenoh.Session | None = None
        self.outlets: Outlets | None = None
        self._inlets: list[Inlet[Any]] = []
        self._readers: list[Reader] = []
        self._keys: dict[str, zenoh.KeyExpr | None] = {}
        """Those that are declared, for as long as they are kept."""
        self._declared: list[object] = []
        self._trouble = ""

    @property
    def is_open(self) -> bool:
        """Whether there is a session, with a router or without."""
        return self._session is not None

    @property
    def is_linked(self) -> bool:
        """Whether sites can be reached."""
        session = self._session
        return session is not None and (self.is_router or bool(session.info.routers_zid()))

    @property
    def overflowed(self) -> int:
        """Messages that came faster than they could be taken."""
        return sum(reader.dropped for reader in self._readers)

    async def open(self) -> None:
        """Open the session if it is not open, and declare what is wanted; log trouble once."""
        if self._session is not None:
            return
        try:
            session = await off_loop(open_session, self._config)
        except OSError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                log.warning("%s: %s; trying again until it works", self.place, error)
            return
        self._trouble = ""
        self._session, self.outlets = session, Outlets(session)
        self._declare(session)

    def close(self) -> None:
        """End the session; it says good-bye by itself, which may take a moment."""
        for inlet in self._inlets:
            inlet.close()
        for reader in self._readers:
            reader.close()
        if self.outlets is not None:
            self.outlets.close()
        if self._session is not None:
            off_loop(end_session, self._session, self.outlets, self._declared)
        self._session, self.outlets, self._declared = None, None, []

    def ask_round_trips(self) -> None:
        """Ask every site to answer at once; one query does for all that a pattern matches."""
        import zenoh

        if self._session is None or not self.is_linked:
            return
        asked_us, inlet = self._now_us(), self._inlets[-1]

        def note(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                inlet.put((site_of(str(reply.ok.key_expr)), self._now_us() - asked_us))

        for pattern in self.patterns:
            self._session.get(
                ping_key(pattern),
                note,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,
                timeout=PING_TIMEOUT_S,
            )

    async def query(self, key: str, payload: bytes, timeout_s: float) -> dict[str, bytes]:
        """Ask the sites of a key, so that no telemetry waits for question or answer.

        Parameters
        ----------
        key : str
            Of one site or, with a pattern, of several.
        payload : bytes
            The question.
        timeout_s : float
            Longest wait.

        Returns
        -------
        dict of str to bytes
            The first answer of each site.

        Raises
        ------
        NoAnswerError
            If there is none.
        QueryRefusedError
            If the only answers are refusals.
        """
        if self._session is None:
            raise NoAnswerError(f"{self.place}: no session")
        return await off_loop(_query, self._session, key, payload, timeout_s)

    def _declare(self, session: "zenoh.Session") -> None:
        import zenoh

        events = self._events
        presence: Inlet[tuple[str, bool]] = Inlet(self._note_token)
        trips: Inlet[tuple[str, int]] = Inlet(lambda item: events.round_trip(*item))
        self._inlets = [presence, trips]
        here = zenoh.SampleKind.PUT
        for pattern in self.patterns:
            reader = Reader(session, out_key(pattern, "*"), self._take)
            self._readers.append(reader)
            self._declared += [
                reader,
                session.liveliness().declare_subscriber(
                    presence_key(pattern, "*"),
                    lambda sample: presence.put((str(sample.key_expr), sample.kind == here)),
                    history=True,
                ),
            ]

    def _take(self, sample: "zenoh.Sample") -> None:
        key, mark = str(sample.key_expr), sample.attachment
        if key not in self._keys and len(self._keys) < MAX_KEYS:
            self._keys[key] = None
            off_loop(_declare_key, self._session, key, self._keys)
        is_own = mark is not None and mark.to_bytes() == OWN
        self._events.frames(site_of(key), frames_of(sample), is_own)

    def _note_token(self, news: tuple[str, bool]) -> None:
        key, is_here = news
        self._events.presence(site_of(key), key.rpartition("/")[2], is_here)


def _declare_key(
    session: "zenoh.Session", key: str, declared: "dict[str, zenoh.KeyExpr | None]"
) -> None:
    """Have Zenoh find once who takes a key: it would look at the tokens of all sites a message."""
    import zenoh

    with suppress(zenoh.ZError):
        declared[key] = session.declare_keyexpr(key)


def key_pattern(site: str) -> str:
    """Return a pattern of sites as Zenoh writes it in one part of a key.

    Raises
    ------
    ValueError
        If it is none.
    """
    if not PATTERN.fullmatch(site) or "**" in site:
        raise ValueError(f"site {site!r}: letters, digits, . _ - and single * only")
    return site if site == "*" else site.replace("*", "$*")


def _query(
    session: "zenoh.Session", key: str, payload: bytes, timeout_s: float
) -> dict[str, bytes]:
    import zenoh

    found: dict[str, bytes] = {}
    refusal = ""
    try:
        for reply in session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=zenoh.Priority.BACKGROUND,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=timeout_s,
            payload=payload,
        ):
            if reply.ok is not None:
                found.setdefault(site_of(str(reply.ok.key_expr)), reply.ok.payload.to_bytes())
            elif reply.err is not None:
                refusal = reply.err.payload.to_bytes().decode(errors="replace")
    except zenoh.ZError as error:
        raise NoAnswerError(str(error)) from error
    if found:
        return found
    if refusal and refusal != "Timeout":
        raise QueryRefusedError(refusal)
    raise NoAnswerError("no answer")
