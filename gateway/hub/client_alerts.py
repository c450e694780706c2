"""Problems of clients and ports, announced as text: once when they begin, once when they end.

Every configured client gets its own texts. The clients of a listening port may be anybody, and any
number: of them only a few are named in a minute, so that an attack cannot hide other texts.
"""

from typing import Final, NamedTuple

from gateway.hub.client_table import ClientStats, ListenerStats
from gateway.hub.log_rate_limiter import Digest
from gateway.units import US_PER_S

PATIENCE_US: Final = 5 * US_PER_S
"""A shorter outage is not announced."""
QUIET_US: Final = 30 * US_PER_S
"""A client that has dropped nothing for so long is no longer slow."""
TROUBLED_STATES: Final = {
    "unreachable": "unreachable",
    "resolving": "its address is not known",
    "connecting": "not connected",
}
"""What to say if there is no reason. `refused` is not among them: a ground station that is not
running is nothing unusual."""
CALLERS_IN_FULL: Final = 3
"""Problems of listening ports' clients that are announced one by one in a minute."""

Key = int | str
"""Id of a client, or URL of a listening port."""


class News(NamedTuple):
    """The begin or the end of a problem."""

    is_trouble: bool
    text: str


class TroubleWatch:
    """Detect problems from the figures of clients and listening ports."""

    def __init__(self) -> None:
        self._away_since_us: dict[Key, int] = {}
        self._away_told: set[Key] = set()
        self._dropped: dict[int, int] = {}
        """Drops at the last look, of clients that were open then."""
        self._slow_until_us: dict[int, int] = {}
        self._callers = Digest(CALLERS_IN_FULL, "more troubles of clients of listening ports")

    def update(
        self,
        clients: tuple[ClientStats, ...],
        listeners: tuple[ListenerStats, ...],
        now_us: int,
    ) -> list[News]:
        """Look at all figures; return what is new.

        Parameters
        ----------
        clients : tuple of ClientStats
            All clients at this moment.
        listeners : tuple of ListenerStats
            All listening ports at this moment.
        now_us : int
            Gateway time.

        Returns
        -------
        list of News
            Short texts.
        """
        ports = {listener.endpoint for listener in listeners}
        self._forget_all_but({client.client_id for client in clients}, ports)
        news = [News(True, text) for text in self._callers.poll(now_us)]
        for listener in listeners:
            news += self._away(listener.endpoint, listener.name, listener.reason, now_us)
        for client in clients:
            state = TROUBLED_STATES.get(client.state, "")
            trouble = client.reason or state if state else ""
            found = self._away(client.client_id, client.name, trouble, now_us)
            found += self._slow(client, now_us)
            if client.endpoint in ports:
                found = [
                    News(is_trouble, line)
                    for is_trouble, text in found
                    for line in self._callers.say(text, now_us)
                ]
            news += found
        return news

    def _away(self, key: Key, name: str, trouble: str, now_us: int) -> list[News]:
        if not trouble:
            self._away_since_us.pop(key, None)
            if key in self._away_told:
                self._away_told.remove(key)
                return [News(False, f"{name} is back")]
            return []
        since_us = self._away_since_us.setdefault(key, now_us)
        if key in self._away_told or now_us - since_us < PATIENCE_US:
            return []
        self._away_told.add(key)
        return [News(True, f"{name}: {trouble}")]

    def _slow(self, client: ClientStats, now_us: int) -> list[News]:
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
        return [] if was_slow else [News(True, f"{client.name} is too slow: telemetry dropped")]

    def _forget_all_but(self, clients: set[int], listeners: set[str]) -> None:
        for known in (self._dropped, self._slow_until_us):
            for client_id in known.keys() - clients:
                del known[client_id]
        there = clients | listeners
        for key in self._away_since_us.keys() - there:
            del self._away_since_us[key]
        self._away_told &= there
