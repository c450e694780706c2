"""The open pages: slots for those that have not connected, and the session of each.

NiceGUI keeps a loaded page for a minute, and a client could load pages without running their
scripts. Messages name their page, so each is checked: a page accepts messages only from the session
that has loaded it, and ends with that session.
"""

from collections.abc import Awaitable, Callable
from typing import Any, Final
from urllib.parse import parse_qs

from nicegui import Client, core

from gateway.panel.access import HOLDER
from gateway.panel.admission import Holder, Slots

PENDING_OF_SESSION: Final = 8
"""Maximum pages of a session that are loading: a browser may restore some tabs at once."""
PENDING_OF_ADDRESS: Final = 12
PENDING_OF_ROLE: Final = 16
NAMESPACE: Final = "/"
MESSAGES: Final = ("handshake", "event", "javascript_response", "ack", "log")
"""Messages of a browser to a page."""


class OpenPages:
    """The pages of all browsers."""

    def __init__(self) -> None:
        self._pages: dict[str, tuple[Client, Holder]] = {}
        """Pages and their holders by the id of the page."""
        self._pending: Slots[str] = Slots(
            PENDING_OF_SESSION, PENDING_OF_ADDRESS, PENDING_OF_ROLE, self._delete
        )

    def add(self, page: Client, holder: Holder) -> None:
        """Add a page that is being loaded; an older one of the same role may be deleted for it."""
        self._pages[page.id] = page, holder
        page.on_connect(lambda: self._pending.release(page.id))
        page.on_delete(lambda: self._discard(page.id))
        self._pending.admit(page.id, holder)

    def holder(self, page_id: str) -> Holder:
        """Return the holder of a page."""
        return self._pages[page_id][1]

    def end_session(self, token: str) -> None:
        """Delete the pages of a session."""
        for page, holder in [*self._pages.values()]:
            if holder.session == token:
                self._delete(page.id)

    def guard_socket(self) -> None:
        """Check the session of every message to a page."""
        handlers = core.sio.handlers[NAMESPACE]
        for name in MESSAGES:
            core.sio.on(name, self._guarded(handlers[name]))
        connect = handlers["connect"]

        async def guarded_connect(sid: str, environ: dict[str, Any], *rest: Any) -> Any:
            asked = parse_qs(environ.get("QUERY_STRING", "")).get("client_id", [""])[0]
            return await connect(sid, environ, *rest) if self.belongs(asked, environ) else False

        core.sio.on("connect", guarded_connect)

    def belongs(self, page_id: str, environ: dict[str, Any]) -> bool:
        """Return whether a page, if it exists, belongs to the session of a connection."""
        known = self._pages.get(page_id)
        holder = environ.get("asgi.scope", {}).get(HOLDER)
        return known is None or (holder is not None and holder.session == known[1].session)

    def _guarded(self, handle: Callable[..., Any]) -> Callable[..., Awaitable[Any]]:
        async def guarded(sid: str, message: dict[str, Any]) -> Any:
            if not self.belongs(str(message.get("client_id")), core.sio.get_environ(sid) or {}):
                return False
            result = handle(sid, message)
            return await result if isinstance(result, Awaitable) else result

        return guarded

    def _delete(self, page_id: str) -> None:
        if (known := self._pages.pop(page_id, None)) is not None:
            known[0].delete()

    def _discard(self, page_id: str) -> None:
        self._pending.release(page_id)
        self._pages.pop(page_id, None)
