"""What is known of each client, and which clients of a listening port are still there.

A UDP port knows its clients only by what they send. A client is dropped after a silence; one that
comes back on another port (a ground station that was restarted) takes over its old place as soon
as that has missed a few heartbeats, so that no client is served twice; and a port never serves
more than a bounded number. In a full port a silent client makes room, and so does a machine that
holds more than its share, for one that holds less.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from gateway.units import US_PER_S

SILENT_AFTER_US: Final = 3 * US_PER_S
"""Three missed heartbeats: a client so silent may be replaced."""
SHARE: Final = 4
"""One machine is left a quarter of the places when others want them,"""
FEW: Final = 4
"""and at least these: a ground station, a script and a display."""


@dataclass(frozen=True, slots=True)
class ClientStats:
    """One client at one moment, for the live view, the status command and the metrics."""

    client_id: int
    name: str
    endpoint: str
    remote: str
    """Where the peer is; empty while unknown."""
    state: str
    """`open`, or why nothing goes out: `refused`, `unreachable`, `connecting`, `resolving`."""
    trusted: bool
    systems: tuple[tuple[int, int], ...]
    """System and component ids that were heard from it."""
    sent: int
    """Frames handed to the network."""
    dropped: int
    """Frames given up: unreachable, or older than newer ones in a full queue."""
    bytes_sent: int
    received: int
    bytes_received: int
    bytes_garbage: int
    """Bytes from it that were no MAVLink."""
    queued: int
    """Frames that wait for a slow link."""
    since_us: int
    heard_us: int | None
    round_trip_us: int | None
    reason: str = ""
    """Why nothing is sent: the operating system's error; empty if frames are sent."""
    unheard: int = 0
    """Frames sent to a port on which nobody listened; they do not count as loss."""


@dataclass(frozen=True, slots=True)
class ListenerStats:
    """One listening port at one moment."""

    name: str
    endpoint: str
    state: str
    """`open`, or `closed` while it cannot be bound or accept clients."""
    reason: str
    """Why it is closed: the operating system's error; empty if it is open."""
    port: int
    """The port that is bound, or 0."""
    clients: int
    turned_away: int
    """How often a new client was turned away for lack of room."""


@dataclass(frozen=True, slots=True)
class HubCounters:
    """What the hub as a whole has seen since it started."""

    published: int = 0
    """Frames of ours."""
    forwarded: int = 0
    """Frames of other systems that were passed on."""
    duplicates: int = 0
    """Copies that came by a second path."""
    looped: int = 0
    """Frames of ours that came back."""
    unroutable: int = 0
    """Frames for an unknown system, or from a client that may not send to it."""
    unserved: int = 0
    """Requests dropped because their client exceeded its quota."""


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
        Silence after which a client is gone.
    """

    def __init__(self, max_clients: int, idle_timeout_us: int) -> None:
        self.max_clients = max_clients
        self.idle_timeout_us = idle_timeout_us
        self._by_address: dict[tuple[str, int], Presence] = {}
        self._full_until_us = 0
        """Until then nobody in a full table can have been silent for long enough."""

    def __len__(self) -> int:
        return len(self._by_address)

    def is_full(self, now_us: int) -> bool:
        """Return whether there is no room and no client is silent; cheaper than `admit`."""
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
        """Take in a client at a new address.

        Returns
        -------
        tuple
            The client, or None if the table is full of clients that are alive; and the silent
            client that had to make room, if any.
        """
        leaver = None
        if len(self._by_address) >= self.max_clients:
            present = self._by_address.values()
            leaver = who_leaves(present, address[0], self.max_clients, now_us)
            if leaver is None:
                if crowded_host(present, self.max_clients) is None:
                    stalest = min(present, key=lambda presence: presence.heard_us)
                    self._full_until_us = stalest.heard_us + SILENT_AFTER_US
                return None, None
            self.remove(leaver)
        presence = Presence(client_id, address, now_us)
        self._by_address[address] = presence
        return presence, leaver

    def remove(self, presence: Presence) -> None:
        """Forget a client."""
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


def who_leaves(
    present: Collection[Presence], host: str, max_clients: int, now_us: int
) -> Presence | None:
    """Choose who makes room in a full port.

    Parameters
    ----------
    present : collection of Presence
        All clients, in the order in which they came.
    host : str
        Address of the newcomer.
    max_clients : int
        Most clients at once.
    now_us : int
        Gateway time.

    Returns
    -------
    Presence or None
        The client that has been silent longest, else the newest from the machine that holds more
        than its share; None if all are alive and no machine, or only the newcomer's, holds more.
    """
    stalest = min(present, key=lambda presence: presence.heard_us)
    if now_us - stalest.heard_us >= SILENT_AFTER_US:
        return stalest
    crowded = crowded_host(present, max_clients)
    if crowded in (None, host):
        return None
    return [presence for presence in present if presence.address[0] == crowded][-1]


def crowded_host(present: Collection[Presence], max_clients: int) -> str | None:
    """Return the machine with the most clients if those are more than its share."""
    host, count = Counter(presence.address[0] for presence in present).most_common(1)[0]
    return host if count > max(FEW, max_clients // SHARE) else None
