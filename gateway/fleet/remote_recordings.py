"""Control verbs for the recordings of the sites: lists, pieces of files, digests."""

import asyncio
import logging
from collections.abc import Callable
from typing import Final

import msgspec

from gateway.fleet.session import (
    Decoded,
    FleetSession,
    NoAnswerError,
    QueryRefusedError,
    key_pattern,
)
from gateway.hub.endpoint import SITE_NAME
from gateway.hub.transports.zenoh.session import recordings_key
from gateway.hub.transports.zenoh.site_queries import RecordingQuery, RemoteRecording
from gateway.live.control_socket import ControlError, Verbs

log = logging.getLogger(__name__)

LIST_TIMEOUT_S: Final = 5.0
PIECE_TIMEOUT_S: Final = 8.0
"""4 KiB on a line of 10 kbit/s; less than the timeout of the control socket's client."""
DIGEST_TIMEOUT_S: Final = 300.0
"""Gigabytes on a slow card."""


class RemoteRecordings:
    """The verbs `fleet.recordings`, `fleet.piece` and `fleet.digest`."""

    def __init__(self, session: FleetSession) -> None:
        self._session = session

    def verbs(self) -> Verbs:
        """Return the handlers."""
        return {
            "fleet.recordings": self._list,
            "fleet.piece": self._piece,
            "fleet.digest": self._digest,
        }

    async def _list(self, site: str = "") -> dict[str, list[RemoteRecording]]:
        patterns = [key_pattern(site)] if site else self._session.patterns
        query = RecordingQuery()
        asked = (self._query(each, query, LIST_TIMEOUT_S, _list_from) for each in patterns)
        found: dict[str, list[RemoteRecording]] = {}
        for answers in await asyncio.gather(*asked):
            found |= {site: listed for site, listed in answers.items() if listed is not None}
        return found

    async def _piece(self, site: str, file: str, offset: int, size: int) -> dict[str, bytes | None]:
        query = RecordingQuery(file, offset, size)
        return {"data": await self._ask_one(site, query, PIECE_TIMEOUT_S)}

    async def _digest(self, site: str, file: str, size: int) -> dict[str, str | None]:
        query = RecordingQuery(file, size=size, digest=True)
        answer = await self._ask_one(site, query, DIGEST_TIMEOUT_S)
        return {"sha256": None if answer is None else answer.decode("ascii", "replace")}

    async def _ask_one(self, site: str, query: RecordingQuery, timeout_s: float) -> bytes | None:
        if not SITE_NAME.fullmatch(site):
            raise ControlError(f"{site!r} is no name of a site")
        return (await self._query(site, query, timeout_s, lambda _, data: data)).get(site)

    async def _query(
        self,
        site: str,
        query: RecordingQuery,
        timeout_s: float,
        decode: Callable[[str, bytes], Decoded],
    ) -> dict[str, Decoded]:
        payload = msgspec.json.encode(query)
        try:
            return await self._session.query(recordings_key(site), payload, timeout_s, decode)
        except NoAnswerError:
            return {}
        except QueryRefusedError as error:
            raise ControlError(str(error)) from error


def _list_from(site: str, data: bytes) -> list[RemoteRecording] | None:
    """Decode the list of a site; None, with a warning, if it is malformed."""
    try:
        return msgspec.json.decode(data, type=list[RemoteRecording])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        log.warning("site %s: malformed list of recordings: %s", site, error)
        return None
