"""Requests to the gateway over its control socket, without blocking the page."""

import asyncio
from pathlib import Path
from typing import Any, Final

from gateway.live.control_finder import find_socket
from gateway.live.control_socket import request

READING: Final = frozenset(
    {"status", "verbs", "clients.list", "record.status", "record.list", "play.status"}
)
"""Verbs that a viewer may use: they change nothing."""


class ControlClient:
    """Send requests to a running gateway (or player).

    Parameters
    ----------
    path : Path or None
        Its socket; None for the gateway on this machine, searched at each request.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path

    async def ask(self, verb: str, **params: Any) -> Any:
        """Send a request, and return the result, decoded from JSON.

        Raises
        ------
        ControlError
            If no gateway listens, or the request is refused.
        """
        return await asyncio.to_thread(self._ask, verb, params)

    def _ask(self, verb: str, params: dict[str, Any]) -> Any:
        return request(self.path or find_socket("run"), verb, params)
