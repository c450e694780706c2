"""Clients that are links to one peer."""

from typing import Final

from gateway.units import US_PER_S

LINKED_US: Final = 60 * US_PER_S
"""A pair ends after this time without a copy: it was chance, or one of the links has gone."""


class RedundantLinks:
    """Pairs of clients that are links to one peer, because both brought copies of a frame recently.

    Frames that we forward may return and look the same, so only frames that are not forwarded
    count. Both links of a pair get every answer, and also any stream that only one of them
    requested: then both carry the same sequence numbers, and the peer can recognise copies by their
    bytes too. Two ground stations that share an id and were started at the same moment look like
    such a pair: each gets the answers to the other's requests.
    """

    def __init__(self) -> None:
        self._seen_us: dict[tuple[int, int], int] = {}
        self._groups: dict[int, tuple[int, ...]] = {}

    def register(self, first: int, second: int, now_us: int) -> bool:
        """Register that a client brought a copy of another's frame; return if the pair is new."""
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
        """Separate pairs that no longer bring copies."""
        self._part([pair for pair, us in self._seen_us.items() if now_us - us > LINKED_US])

    def remove(self, client_id: int) -> None:
        """Separate a client from all others."""
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
