"""Which clients are links to one and the same peer.

Two links to one peer bring the same bytes, each by its own way. What we pass on may come back and
looks the same, so only frames that go no further count. Whoever is known to be such a pair is
answered on both, and what is sent to one in a stream of its own is sent to the other: then both
links carry the same numbers, and the peer can tell copies by their bytes in its turn. Two ground
stations that share an id and were started at the same moment look alike, and are served alike: each
gets the answer to what only one of them was heard to ask.
"""

from typing import Final

from gateway.units import US_PER_S

LINKED_US: Final = 60 * US_PER_S
"""Without a further copy for so long, it was chance, or one of the two links has gone."""


class RedundantLinks:
    """Pairs of clients that have brought copies of each other's frames lately."""

    def __init__(self) -> None:
        self._seen_us: dict[tuple[int, int], int] = {}
        self._groups: dict[int, tuple[int, ...]] = {}

    def note(self, first: int, second: int, now_us: int) -> bool:
        """Note that a client has brought a copy of another's frame; return whether that is news."""
        pair = (first, second) if first < second else (second, first)
        is_new = pair not in self._seen_us
        self._seen_us[pair] = now_us
        if is_new:
            self._regroup()
        return is_new

    def group(self, client_id: int) -> tuple[int, ...]:
        """Return all links to a client's peer, the client included, lowest id first."""
        return self._groups.get(client_id, (client_id,))

    def expire(self, now_us: int) -> None:
        """Part pairs of which no copies come any more."""
        gone = [pair for pair, us in self._seen_us.items() if now_us - us > LINKED_US]
        self._part(gone)

    def forget(self, client_id: int) -> None:
        """Forget a client that has gone."""
        self._part([pair for pair in self._seen_us if client_id in pair])

    def _part(self, pairs: list[tuple[int, int]]) -> None:
        for pair in pairs:
            del self._seen_us[pair]
        if pairs:
            self._regroup()

    def _regroup(self) -> None:
        """Join pairs that share a client."""
        groups: dict[int, set[int]] = {}
        for first, second in self._seen_us:
            joined = groups.get(first, {first}) | groups.get(second, {second})
            for client_id in joined:
                groups[client_id] = joined
        self._groups = {client_id: tuple(sorted(group)) for client_id, group in groups.items()}
