"""Who is served at a listening port, and who leaves when it is full.

A UDP port identifies its clients only by the addresses they send from. A client is removed after a
timeout; one that returns on another port (a restarted ground station) replaces its old entry as
soon as that has missed a few heartbeats, so that no client is served twice; and a port never serves
more than a bounded number. In a full port a silent client is removed for a new one, and so is a
client of a host that holds more than its share, for a host that holds less.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from gateway.units import US_PER_S

SILENT_AFTER_US: Final = 3 * US_PER_S
"""Three missed heartbeats: a client so silent may be replaced."""
SHARE: Final = 4
"""One host is left a quarter of the clients when others want them,"""
FEW: Final = 4
"""and at least these: a ground station, a script and a display."""


@dataclass(slots=True)
class Presence:
    """A client of a listening port."""

    client_id: int
    address: tuple[str, int]
    """Host and port of the peer."""
    heard_us: int
    identity: tuple[int, int] | None = None
    """System and component of its first frame."""


class ClientTable:
    """The clients of one listening port.

    Parameters
    ----------
    max_clients : int
        Most clients at once.
    idle_timeout_us : int
        Time without a frame after which a client is gone.
    """

    def __init__(self, max_clients: int, idle_timeout_us: int) -> None:
        self.max_clients = max_clients
        self.idle_timeout_us = idle_timeout_us
        self._by_address: dict[tuple[str, int], Presence] = {}
        self._full_until_us = 0
        """Until then no client of a full table can have been silent for long enough."""

    def __len__(self) -> int:
        return len(self._by_address)

    def is_full(self, now_us: int) -> bool:
        """Return whether the table is full of live clients; cheaper than `admit`."""
        return len(self) >= self.max_clients and now_us < self._full_until_us

    def presences(self) -> tuple[Presence, ...]:
        """Return all clients."""
        return tuple(self._by_address.values())

    def find(self, address: tuple[str, int]) -> Presence | None:
        """Return the client at an address."""
        return self._by_address.get(address)

    def admit(
        self, address: tuple[str, int], client_id: int, now_us: int
    ) -> tuple[Presence | None, Presence | None]:
        """Admit a client at a new address.

        Returns
        -------
        tuple
            The client, or None if the table is full of clients that are alive; and the client that
            was removed for it, if any.
        """
        removed = None
        if len(self._by_address) >= self.max_clients:
            present = self._by_address.values()
            removed = client_to_remove(present, address[0], self.max_clients, now_us)
            if removed is None:
                if crowded_host(present, self.max_clients) is None:
                    stalest = min(present, key=lambda presence: presence.heard_us)
                    self._full_until_us = stalest.heard_us + SILENT_AFTER_US
                return None, None
            self.remove(removed)
        presence = Presence(client_id, address, now_us)
        self._by_address[address] = presence
        return presence, removed

    def remove(self, presence: Presence) -> None:
        """Remove a client."""
        self._by_address.pop(presence.address, None)

    def expire(self, now_us: int) -> list[Presence]:
        """Remove and return the clients that have gone or have come back on another port."""
        newest: dict[tuple[str, tuple[int, int]], Presence] = {}
        for presence in self._by_address.values():
            if presence.identity:
                key = (presence.address[0], presence.identity)
                if key not in newest or presence.heard_us > newest[key].heard_us:
                    newest[key] = presence
        gone = [
            presence
            for presence in self._by_address.values()
            if self._has_gone(presence, newest, now_us)
        ]
        for presence in gone:
            self.remove(presence)
        return gone

    def _has_gone(
        self,
        presence: Presence,
        newest: dict[tuple[str, tuple[int, int]], Presence],
        now_us: int,
    ) -> bool:
        silent_us = now_us - presence.heard_us
        if silent_us >= self.idle_timeout_us:
            return True
        if silent_us < SILENT_AFTER_US or presence.identity is None:
            return False
        return newest[presence.address[0], presence.identity] is not presence


def client_to_remove(
    present: Collection[Presence], host: str, max_clients: int, now_us: int
) -> Presence | None:
    """Choose the client to remove from a full port.

    Parameters
    ----------
    present : collection of Presence
        All clients, in the order of admission.
    host : str
        Address of the new client.
    max_clients : int
        Most clients at once.
    now_us : int
        Gateway time.

    Returns
    -------
    Presence or None
        The client that has been silent longest, else the newest of the host that holds more than
        its share; None if all are alive and no host, or only the new client's, holds more.
    """
    stalest = min(present, key=lambda presence: presence.heard_us)
    if now_us - stalest.heard_us >= SILENT_AFTER_US:
        return stalest
    crowded = crowded_host(present, max_clients)
    if crowded in (None, host):
        return None
    return [presence for presence in present if presence.address[0] == crowded][-1]


def crowded_host(present: Collection[Presence], max_clients: int) -> str | None:
    """Return the host with the most clients if those are more than its share."""
    host, count = Counter(presence.address[0] for presence in present).most_common(1)[0]
    return host if count > max(FEW, max_clients // SHARE) else None
