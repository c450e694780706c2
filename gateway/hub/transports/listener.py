"""Base of listening ports: clients come up to a bounded number, and stale or crowded ones go."""

import asyncio
import logging
import socket
from collections import Counter
from collections.abc import Collection
from typing import Final, Generic, TypeVar

from gateway.hub.endpoint import Endpoint
from gateway.hub.stats import ListenerStats
from gateway.hub.transports.base import RETRY_US, STALE_AFTER_US, Client, HubContext
from gateway.printable import reason_of

log = logging.getLogger(__name__)

SHARE: Final = 4
"""Divisor: one host keeps a quarter of a full port's clients when others connect."""
FEW: Final = 4
"""Clients that one host keeps in any case, such as a ground station, a script and a display."""
Peer = TypeVar("Peer", bound=Client)


def client_to_remove(
    present: Collection[Peer], host: str, max_clients: int, now_us: int
) -> Peer | None:
    """Choose the client to remove from a full port for a new one from `host`.

    It is the one that has sent nothing for longest, else the newest of the host that holds more
    than its share; None if all are alive and no host, or only the new client's, holds more.
    """
    stalest = min(present, key=lambda client: client.last_us)
    if now_us - stalest.last_us >= STALE_AFTER_US:
        return stalest
    crowded = crowded_host(present, max_clients)
    if crowded in (None, host):
        return None
    return [client for client in present if client.host == crowded][-1]


def crowded_host(present: Collection[Client], max_clients: int) -> str | None:
    """Return the host with the most clients if those are more than its share."""
    host, count = Counter(client.host for client in present).most_common(1)[0]
    return host if count > max(FEW, max_clients // SHARE) else None


class Listener(Generic[Peer]):
    """An endpoint that makes a client of every peer that connects, up to a bounded number."""

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
        """Remove all clients and close the port."""
        for client in list(self._clients.values()):
            self.leave(client)
        self._shut()

    def fail(self, error: Exception) -> None:
        """Close the port after an unexpected error; `tick` reopens it."""
        self._report(error)
        self._shut()

    def leave(self, client: Client) -> None:
        """Remove one client."""
        self._clients.pop(client.client_id, None)
        self._context.vanish(client)

    def _has_room(self, host: str, now_us: int) -> bool:
        """Return whether there is room for a new client, after removing another if needed."""
        most = self._context.settings.max_clients
        if len(self._clients) < most:
            return True
        removed = client_to_remove(self._clients.values(), host, most, now_us)
        if removed is not None:
            self.leave(removed)
        return removed is not None

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
        """Accept clients of the port from now on."""
        raise NotImplementedError

    def _report(self, error: Exception | None) -> None:
        """Note why no client can connect, or that one could; a change is logged."""
        self.reason = "" if error is None else reason_of(error)
        if self.reason == self._logged:
            return
        self._logged = self.reason
        if self.reason:
            log.warning("%s: %s; trying again until it works", self.endpoint.name, self.reason)
        else:
            log.info("%s is open", self.endpoint.name)
