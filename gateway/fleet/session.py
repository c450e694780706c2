"""The Zenoh session of a fleet: subscriptions, presence, round trips and queries.

As a router it listens beyond loopback only with authentication: TLS that verifies client
certificates, or Zenoh's user and password. `insecure` in the settings lifts that, with a warning.
"""

import asyncio
import logging
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from gateway.fleet.settings import FleetSettings
from gateway.hub.transports.zenoh.session import (
    MAX_KEY,
    OWN,
    Connection,
    Payload,
    Publishers,
    is_local,
    off_loop,
    open_session,
    payload_of,
    session_config,
    site_key,
    site_of,
)

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

PATTERN: Final = re.compile(r"[A-Za-z0-9_.*-]{1,64}")
MAX_KEYS: Final = 4096
"""Maximum declared keys: more than the vehicles that can have an id."""
PING_TIMEOUT_S: Final = 5.0
"""Longest measured round trip."""
MAX_ANSWER: Final = 256 << 10
"""Maximum bytes of one answer of a site: a list of some 2500 recordings, or a piece of one."""
MAX_ANSWERS: Final = 16 << 20
"""Maximum bytes of the answers of all sites to one query."""
ANSWER_OVERHEAD: Final = 64
"""Bytes counted for an answer in addition to its payload, so that empty ones are bounded too."""
VERIFIED: Final = ("tls", "quic")
"""Protocols whose clients can be verified by their certificates."""


@dataclass(frozen=True, slots=True)
class SessionEvents:
    """Callbacks of a session, called on the loop."""

    frames: Callable[[str, Payload, bool], None]
    """Site, published message, and whether that is of the vehicles of the site's gateway."""
    presence: Callable[[str, str, bool], None]
    """Site, one of its sessions, and whether that session is present."""
    round_trip: Callable[[str, int], None]
    """Site, and the round trip in microseconds."""


class NoAnswerError(Exception):
    """No site answered a query: the site or the router is not connected."""


class QueryRefusedError(Exception):
    """A site refused a query; the text gives the reason."""


class FleetSession:
    """A session that subscribes to sites.

    Raises ValueError if a setting is malformed or it would listen beyond loopback without
    authentication, ModuleNotFoundError if Zenoh is not installed.
    """

    def __init__(
        self, settings: FleetSettings, events: SessionEvents, now_us: Callable[[], int]
    ) -> None:
        self.is_router = not settings.router
        self.locator = settings.router or settings.listen
        mode = "router" if self.is_router else "client"
        self._config = session_config(self.locator, settings.zenoh_config, mode)
        self.warning = ""
        """The reason why it is unsafe to listen as configured; empty if it is safe."""
        if self.is_router and (lack := missing_authentication(self.locator, self._config)):
            if not settings.insecure:
                raise ValueError(
                    f"{lack}. See docs/fleet.md, Mutual TLS, or set insecure = true in [fleet]"
                )
            self.warning = f"insecure: {lack}; everyone who reaches it can command every vehicle"
        self.patterns = [key_pattern(site) for site in settings.sites]
        self._events = events
        self._now_us = now_us
        self._connection: Connection | None = None
        self._asked: list[asyncio.Future[dict[str, int]]] = []
        """The newest queries for round trips."""
        self._keys: dict[str, zenoh.KeyExpr | None] = {}
        """Declared keys; a declaration ends with its object."""
        self._trouble = ""

    @property
    def is_linked(self) -> bool:
        """Whether sites can be reached."""
        connection = self._connection
        return connection is not None and (self.is_router or connection.has_router)

    @property
    def publishers(self) -> Publishers | None:
        """The publishers of the session, if it is open."""
        return None if self._connection is None else self._connection.publishers

    @property
    def overflowed(self) -> int:
        """Messages dropped because they arrived faster than they were handled."""
        connection = self._connection
        return 0 if connection is None else sum(each.dropped for each in connection.subscriptions)

    def clients(self) -> dict[str, str] | None:
        """Return the certificate name, or else the id, of each linked session; None in a client."""
        if self._connection is None or not self.is_router:
            return None
        links = self._connection.session.info.links()
        return {str(link.zid): link.auth_identifier or str(link.zid) for link in links}

    async def open(self) -> None:
        """Open the session if it is not open, and subscribe; log a failure once."""
        if self._connection is not None:
            return
        try:
            session = await off_loop(open_session, self._config)
        except OSError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                log.warning("%s: %s; retrying", self.locator, error)
            return
        self._trouble = ""
        self._connection = Connection(session)
        self._declare(self._connection)

    def close(self) -> None:
        """End the session; a thread closes it, which may take some time."""
        for asked in self._asked:
            asked.cancel()
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def ask_round_trips(self) -> None:
        """Query every site for its round trip; one query serves all sites of a pattern."""
        if self._connection is None or not self.is_linked:
            return
        session, now_us = self._connection.session, self._now_us
        keys = (site_key(pattern, "ping") for pattern in self.patterns)
        self._asked = [off_loop(_ping, session, key, now_us) for key in keys]
        for asked in self._asked:
            asked.add_done_callback(self._handle_round_trips)

    def _handle_round_trips(self, asked: "asyncio.Future[dict[str, int]]") -> None:
        for site, round_trip_us in () if asked.cancelled() else asked.result().items():
            self._events.round_trip(site, round_trip_us)

    async def query(self, key: str, payload: bytes, timeout_s: float) -> dict[str, bytes]:
        """Query the sites of a key at the lowest priority; return the first answer of each.

        An answer above `MAX_ANSWER` counts as a refusal. Raises NoAnswerError without an answer,
        QueryRefusedError if all are refusals.
        """
        if self._connection is None:
            raise NoAnswerError(f"{self.locator}: no session")
        return await off_loop(_query, self._connection.session, key, payload, timeout_s)

    def _declare(self, connection: Connection) -> None:
        for pattern in self.patterns:
            connection.subscribe(site_key(pattern, "*", "out"), self._handle)
            connection.watch_presence(pattern, self._events.presence)

    def _handle(self, sample: "zenoh.Sample") -> None:
        key, attachment = str(sample.key_expr), sample.attachment
        is_new = key not in self._keys and len(self._keys) < MAX_KEYS and len(key) <= MAX_KEY
        if is_new and self._connection is not None:
            self._keys[key] = None
            off_loop(_declare_key, self._connection.session, key, self._keys)
        is_own = (
            attachment is not None and len(attachment) == len(OWN) and attachment.to_bytes() == OWN
        )
        self._events.frames(site_of(key), payload_of(sample), is_own)


def _declare_key(
    session: "zenoh.Session", key: str, declared: "dict[str, zenoh.KeyExpr | None]"
) -> None:
    """Declare a key once: otherwise Zenoh would search all sites' tokens for every message."""
    import zenoh

    with suppress(zenoh.ZError):
        declared[key] = session.declare_keyexpr(key)


def key_pattern(site: str) -> str:
    """Return a pattern of sites in the form of a Zenoh key; raises ValueError."""
    if not PATTERN.fullmatch(site) or "**" in site:
        raise ValueError(f"site {site!r}: letters, digits, . _ - and single * only")
    return site if site == "*" else site.replace("*", "$*")


def missing_authentication(locator: str, config: "zenoh.Config") -> str:
    """Return the reason why a router that listens here admits everyone; empty if it does not."""
    if is_local(locator):
        return ""
    protocol = locator.partition("/")[0]
    tls = msgspec.json.decode(config.get_json("transport/link/tls")) or {}
    login = (msgspec.json.decode(config.get_json("transport/auth")) or {}).get("usrpwd") or {}
    verifies = tls.get("enable_mtls") and tls.get("root_ca_certificate")
    if (protocol in VERIFIED and verifies) or login.get("dictionary_file"):
        return ""
    return (
        f"{locator} is reachable from other machines, and zenoh_config has neither TLS with client "
        "certificates (enable_mtls, root_ca_certificate) nor users (usrpwd, dictionary_file)"
    )


def _ping(session: "zenoh.Session", key: str, now_us: Callable[[], int]) -> dict[str, int]:
    """Return the round trip of each site that answers in time, us."""
    import zenoh

    asked_us, found = now_us(), dict[str, int]()
    with suppress(zenoh.ZError):
        for reply in session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            timeout=PING_TIMEOUT_S,
        ):
            if reply.ok is not None and len(found) < MAX_KEYS:
                found.setdefault(site_of(str(reply.ok.key_expr)), now_us() - asked_us)
    return found


def _query(
    session: "zenoh.Session", key: str, payload: bytes, timeout_s: float
) -> dict[str, bytes]:
    import zenoh

    found: dict[str, bytes] = {}
    refusal = ""
    room = MAX_ANSWERS
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
            answer = reply.ok.payload if reply.ok is not None else None
            fault = reply.err.payload if reply.err is not None else None
            size = sum(len(each) for each in (answer, fault) if each is not None)
            room -= min(size, MAX_ANSWER) + ANSWER_OVERHEAD
            if room < 0:
                log.warning("query %s: answers above %d bytes are ignored", key, MAX_ANSWERS)
                break
            if size > MAX_ANSWER:
                refusal = f"the answer is above {MAX_ANSWER} bytes"
            elif answer is not None and reply.ok is not None:
                site = site_of(str(reply.ok.key_expr))
                if site and site not in found:
                    found[site] = answer.to_bytes()
            elif fault is not None:
                refusal = fault.to_bytes().decode(errors="replace")
    except zenoh.ZError as error:
        raise NoAnswerError(str(error)) from error
    if found:
        return found
    if refusal and refusal != "Timeout":
        raise QueryRefusedError(refusal)
    raise NoAnswerError("no answer")
