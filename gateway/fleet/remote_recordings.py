"""Control verbs for the recordings of the sites: lists, pieces of files, digests."""

import asyncio
import logging
from itertools import chain
from typing import Final

import msgspec

from gateway.fleet.session import FleetSession, NoAnswerError, QueryRefusedError, key_pattern
from gateway.hub.endpoint import SITE_NAME
from gateway.hub.transports.zenoh.session import off_loop, site_key
from gateway.hub.transports.zenoh.site_queries import (
    DIGEST_TIMEOUT_S,
    RecordingQuery,
    RemoteRecording,
)
from gateway.live.control_socket import ControlError, Verbs
from gateway.recordings.index import check_name, is_file_name

log = logging.getLogger(__name__)

LIST_TIMEOUT_S: Final = 5.0
PIECE_TIMEOUT_S: Final = 8.0
"""Timeout of a piece: 4 KiB at 10 kbit/s; less than that of the control socket's client."""


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
        asked = (self._query(each, query, LIST_TIMEOUT_S) for each in patterns)
        answers = [*chain.from_iterable(each.items() for each in await asyncio.gather(*asked))]
        # Not on the loop: a list may be long.
        return await off_loop(_lists_in, answers)

    async def _piece(self, site: str, file: str, offset: int, size: int) -> dict[str, bytes | None]:
        query = RecordingQuery(file, offset, size)
        return {"data": await self._ask_one(site, query, PIECE_TIMEOUT_S)}

    async def _digest(self, site: str, file: str, size: int) -> dict[str, str | None]:
        query = RecordingQuery(file, size=size, digest=True)
        answer = await self._ask_one(site, query, DIGEST_TIMEOUT_S)
        return {"sha256": None if answer is None else answer.decode("ascii", "replace")}

    async def _ask_one(self, site: str, query: RecordingQuery, timeout_s: float) -> bytes | None:
        if not SITE_NAME.fullmatch(site):
            raise ControlError(f"{site!r} is not the name of a site")
        return (await self._query(site, query, timeout_s)).get(site)

    async def _query(self, site: str, query: RecordingQuery, timeout_s: float) -> dict[str, bytes]:
        payload = msgspec.json.encode(query)
        try:
            return await self._session.query(site_key(site, "recordings"), payload, timeout_s)
        except NoAnswerError:
            return {}
        except QueryRefusedError as error:
            raise ControlError(str(error)) from error


def _lists_in(answers: list[tuple[str, bytes]]) -> dict[str, list[RemoteRecording]]:
    """Decode the lists of sites; malformed lists and names are left out with a warning."""
    found = {}
    for site, data in answers:
        try:
            listed = msgspec.json.decode(data, type=list[RemoteRecording])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            log.warning("site %s: malformed list of recordings: %s", site, error)
            continue
        found[site] = [each for each in listed if _has_sound_names(each)]
        if left_out := len(listed) - len(found[site]):
            log.warning("site %s: %d recordings with unusual names are left out", site, left_out)
    return found


def _has_sound_names(recording: RemoteRecording) -> bool:
    """Return whether all names follow the rules of an upload, since they become file names here."""
    try:
        check_name(recording.name)
        for file in recording.files:
            check_name(file.name)
    except ValueError:
        return False
    return all(is_file_name(file.name) for file in recording.files)
