"""Trouble with clients, in words for whoever flies: once when it comes, once when it has passed."""

from typing import Final

from gateway.routing.clients import ClientStats
from gateway.units import US_PER_S

PATIENCE_US: Final = 5 * US_PER_S
"""A network that comes back sooner is not worth a word."""
QUIET_US: Final = 30 * US_PER_S
"""A client that has dropped nothing for so long is no longer slow."""
TROUBLED_STATES: Final = frozenset({"unreachable", "resolving", "connecting"})
"""`refused` is not among them: a ground station that is not running is nothing unusual."""


class TroubleWatch:
    """Tell trouble from the clients' figures."""

    def __init__(self) -> None:
        self._away_since_us: dict[int, int] = {}
        self._away_told: set[int] = set()
        self._dropped: dict[int, int] = {}
        """Drops at the last look, of clients that were open then."""
        self._slow_until_us: dict[int, int] = {}

    def update(self, clients: tuple[ClientStats, ...], now_us: int) -> list[str]:
        """Look at all clients; return what is new to tell.

        Parameters
        ----------
        clients : tuple of ClientStats
            All clients at this moment.
        now_us : int
            Gateway time.

        Returns
        -------
        list of str
            Short texts.
        """
        self._forget_all_but({client.client_id for client in clients})
        texts = []
        for client in clients:
            texts += self._away(client, now_us)
            texts += self._slow(client, now_us)
        return texts

    def _away(self, client: ClientStats, now_us: int) -> list[str]:
        key = client.client_id
        if client.state not in TROUBLED_STATES:
            self._away_since_us.pop(key, None)
            if key in self._away_told:
                self._away_told.remove(key)
                return [f"{client.name} is back"]
            return []
        since_us = self._away_since_us.setdefault(key, now_us)
        if key in self._away_told or now_us - since_us < PATIENCE_US:
            return []
        self._away_told.add(key)
        return [f"{client.name}: {client.state}"]

    def _slow(self, client: ClientStats, now_us: int) -> list[str]:
        key = client.client_id
        before = self._dropped.pop(key, client.dropped)
        if client.state == "open":
            self._dropped[key] = client.dropped
        if client.dropped == before or client.state != "open":
            if self._slow_until_us.get(key, now_us + 1) <= now_us:
                del self._slow_until_us[key]
            return []
        was_slow = key in self._slow_until_us
        self._slow_until_us[key] = now_us + QUIET_US
        return [] if was_slow else [f"{client.name} is too slow: telemetry dropped"]

    def _forget_all_but(self, there: set[int]) -> None:
        for known in (self._away_since_us, self._dropped, self._slow_until_us):
            for key in known.keys() - there:
                del known[key]
        self._away_told &= there
