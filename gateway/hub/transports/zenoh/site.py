"""A site of a fleet: frames under the keys of its systems, its presence and its recordings."""

import logging
from typing import Final

from gateway.hub.transports.zenoh.client import Topic, ZenohClient
from gateway.hub.transports.zenoh.session import OWN, Connection, site_key
from gateway.hub.transports.zenoh.site_queries import QueryAnswers, RecordingAnswers
from gateway.wire.mavlink_splitter import MavFrame

log = logging.getLogger(__name__)

MAX_DUPLICATE_SESSIONS: Final = 16
"""Maximum registered sessions with this site's name; more are forged."""


class ZenohSite(ZenohClient):
    """One site, whose name no other site of the fleet may have."""

    def __post_init__(self) -> None:
        """Begin without other sessions of the same name."""
        super().__post_init__()
        self._duplicate_sessions: set[str] = set()

    @property
    def in_key(self) -> str:
        """The key of frames for any system of the site."""
        return site_key(self.endpoint.site, "*", "in")

    def topic_of(self, frame: MavFrame) -> Topic:
        """Return where a frame is published: by its system, and marked if that is our own."""
        attachment = OWN if self.context.is_own(frame.origin) else None
        return Topic(site_key(self.endpoint.site, frame.origin[0], "out"), attachment)

    def declare(self, connection: Connection) -> None:
        """Announce the site's presence, and answer queries."""
        session, site = connection.session, self.endpoint.site
        self._duplicate_sessions.clear()
        token = session.liveliness().declare_token(site_key(site, "site", session.zid()))
        connection.declared += [token, QueryAnswers(session, site_key(site, "ping"), lambda _: b"")]
        connection.watch_presence(site, self._handle_presence)
        if self.trusted and self.context.recordings is not None:
            answers = RecordingAnswers(self.context.recordings)
            connection.declared.append(QueryAnswers(session, site_key(site, "recordings"), answers))

    def tick(self, now_us: int) -> None:
        """Open the session, check whether it has a router, and report duplicate names."""
        super().tick(now_us)
        self._report_duplicates()

    def _handle_presence(self, _site: str, session: str, is_here: bool) -> None:
        if self._connection is None or session == str(self._connection.session.zid()):
            return
        if is_here and len(self._duplicate_sessions) < MAX_DUPLICATE_SESSIONS:
            self._duplicate_sessions.add(session)
        elif not is_here:
            self._duplicate_sessions.discard(session)
        self._report_duplicates()

    def _report_duplicates(self) -> None:
        """Report, for as long as it lasts, that another session uses this site's name."""
        text = (
            f"another site is called {self.endpoint.site!r} too" if self._duplicate_sessions else ""
        )
        if self.state != "open" or text == self.reason:
            return
        self.reason = text
        if text:
            log.warning("%s: %s; rename one of them", self.name, text)
