"""Orders to the gateway over its control socket, without making the page wait."""

import asyncio
from pathlib import Path
from typing import Any, Final

from gateway.edges.operator.control_finder import find_socket
from gateway.edges.operator.control_socket import request

READING: Final = frozenset(
    {"status", "verbs", "clients.list", "record.status", "record.list", "play.status"}
)
"""What a viewer may ask: it changes nothing."""


class ControlClient:
    """Asks a gateway (or a player) that runs.

    Parameters
    ----------
    path : Path or None
        Its socket; None for the gateway that is found on this machine, at each request anew.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path

    async def ask(self, verb: str, **params: Any) -> Any:
        """Ask, and return the answer as JSON has it.

        Raises
        ------
        ControlError
            If nobody listens, or the request is refused.
        """
        return await asyncio.to_thread(self._ask, verb, params)

    def _ask(self, verb: str, params: dict[str, Any]) -> Any:
        return request(self.path or find_socket("run"), verb, params)
