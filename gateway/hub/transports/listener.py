"""Base of listening ports: bound as soon as possible, with the reason while it is not."""

import asyncio
import logging
import socket
from typing import Final, Generic, TypeVar

from gateway.hub.client_table import ListenerStats
from gateway.hub.endpoint import Endpoint
from gateway.hub.transports.base import Client, HubContext
from gateway.reasons import reason_of
from gateway.units import US_PER_S

log = logging.getLogger(__name__)

RETRY_US: Final = US_PER_S
"""Between attempts to reopen a socket."""

Peer = TypeVar("Peer", bound=Client)


class Listener(Generic[Peer]):
    """An endpoint that makes a client of every peer that connects.

    Parameters
    ----------
    context : HubContext
        The hub.
    endpoint : Endpoint
        Where to listen.
    """

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.reason = ""
        self.turned_away = 0
        self._context = context
        self._loop = asyncio.get_running_loop()
        self._clients: dict[int, Peer] = {}
        self._socket: socket.socket | None = None
        self._retry_us = 0
        self._logged = ""

    @property
    def port(self) -> int:
        """The port that is bound, or 0."""
        return self._socket.getsockname()[1] if self._socket else 0

    def tick(self, now_us: int) -> None:
        """Bind if that failed; called a few times a second."""
        if now_us < self._retry_us or self._socket is not None:
            return
        self._retry_us = now_us + RETRY_US
        try:
            self._socket = self._bind()
        except OSError as error:
            self._report(error)
            return
        self._report(None)
        self._watch(self._socket)

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options of the same endpoint, to its clients too."""
        self.endpoint = endpoint
        for client in self._clients.values():
            client.reconfigure(endpoint)

    def close(self) -> None:
        """Drop all clients and close the port."""
        for client in list(self._clients.values()):
            self.leave(client)
        self._shut()

    def fail(self, error: Exception) -> None:
        """Close the port after an unexpected error; `tick` reopens it."""
        self._report(error)
        self._shut()

    def leave(self, client: Peer) -> None:
        """Drop one client."""
        self._clients.pop(client.client_id, None)
        self._context.vanish(client)

    def stats(self) -> ListenerStats:
        """Return the port's present figures."""
        return ListenerStats(
            name=self.endpoint.name,
            endpoint=self.endpoint.url,
            state="closed" if self.reason else "open",
            reason=self.reason,
            port=self.port,
            clients=len(self._clients),
            turned_away=self.turned_away,
        )

    def _shut(self) -> None:
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _bind(self) -> socket.socket:
        """Open the port or raise OSError."""
        raise NotImplementedError

    def _watch(self, sock: socket.socket) -> None:
        """Take what comes to the port from now on."""
        raise NotImplementedError

    def _report(self, error: Exception | None) -> None:
        """Note why nobody can come in, or that one could; a change is logged."""
        self.reason = "" if error is None else reason_of(error)
        if self.reason == self._logged:
            return
        self._logged = self.reason
        if self.reason:
            log.warning("%s: %s; trying again until it works", self.endpoint.name, self.reason)
        else:
            log.info("%s is open", self.endpoint.name)
