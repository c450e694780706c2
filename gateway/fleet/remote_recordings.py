"""Recordings of the sites, asked for over the fleet's session: lists, pieces, digests."""

import asyncio
import logging
from typing import Final

import msgspec

from gateway.edges.hub.fleet_link.recording_answers import RecordingQuery, RemoteRecording
from gateway.edges.hub.fleet_link.site_keys import recordings_key
from gateway.fleet.fleet_session import (
    FleetSession,
    NoAnswerError,
    QueryRefusedError,
    key_pattern,
)
from gateway.hub.endpoint import SITE_NAME
from gateway.live.control_socket import ControlError, ControlServer

log = logging.getLogger(__name__)

LIST_TIMEOUT_S: Final = 5.0
PIECE_TIMEOUT_S: Final = 8.0
"""For 4 KiB on a line of 10 kbit/s; well within the wait of whoever asks the control socket."""
DIGEST_TIMEOUT_S: Final = 300.0
"""For gigabytes from a slow card."""


class SitePattern(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which sites; without a pattern all that the fleet shows."""

    site: str = ""


class PieceParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bytes of a file of a site's recording."""

    site: str
    file: str
    offset: int
    size: int


class DigestParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The beginning of a file of a site's recording."""

    site: str
    file: str
    size: int


class RemoteRecordings:
    """The verbs `fleet.recordings`, `fleet.piece` and `fleet.digest`.

    Parameters
    ----------
    session : FleetSession
        Over which sites are asked.
    """

    def __init__(self, session: FleetSession) -> None:
        self._session = session

    def register(self, server: ControlServer) -> None:
        """Offer the verbs on a socket."""
        server.register("fleet.recordings", SitePattern, self._list)
        server.register("fleet.piece", PieceParams, self._piece)
        server.register("fleet.digest", DigestParams, self._digest)

    async def _list(self, params: SitePattern) -> dict[str, list[RemoteRecording]]:
        patterns = self._session.patterns
        try:
            if params.site:
                patterns = [key_pattern(params.site)]
        except ValueError as error:
            raise ControlError(str(error)) from error
        found: dict[str, list[RemoteRecording]] = {}
        asked = (self._query(pattern, RecordingQuery(), LIST_TIMEOUT_S) for pattern in patterns)
        for answers in await asyncio.gather(*asked):
            for site, data in answers.items():
                try:
                    found[site] = msgspec.json.decode(data, type=list[RemoteRecording])
                except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                    log.warning("site %s answers for its recordings with no list: %s", site, error)
        return found

    async def _piece(self, params: PieceParams) -> dict[str, bytes | None]:
        query = RecordingQuery(params.file, params.offset, params.size)
        return {"data": await self._ask_one(params.site, query, PIECE_TIMEOUT_S)}

    async def _digest(self, params: DigestParams) -> dict[str, str | None]:
        query = RecordingQuery(params.file, size=params.size, digest=True)
        answer = await self._ask_one(params.site, query, DIGEST_TIMEOUT_S)
        return {"sha256": None if answer is None else answer.decode("ascii", "replace")}

    async def _ask_one(self, site: str, query: RecordingQuery, timeout_s: float) -> bytes | None:
        if not SITE_NAME.fullmatch(site):
            raise ControlError(f"{site!r} is no name of a site")
        return (await self._query(site, query, timeout_s)).get(site)

    async def _query(self, site: str, query: RecordingQuery, timeout_s: float) -> dict[str, bytes]:
        payload = msgspec.json.encode(query)
        try:
            return await self._session.query(recordings_key(site), payload, timeout_s)
        except NoAnswerError:
            return {}
        except QueryRefusedError as error:
            raise ControlError(str(error)) from error
