"""Quotas of recorded bytes for each client."""

from typing import Final

from gateway.token_bucket import TokenBucket

TRUSTED_RATE: Final = 64_000
"""Bytes a second for each trusted client: more than any ground station sends."""
UNTRUSTED_RATE: Final = 4_000
"""Bytes a second for all untrusted clients together."""
BURST_S: Final = 16
"""Size of a burst as time: a ground station requests much when it connects, then little."""


class RecordingBudget:
    """Quotas of recorded bytes for each client; an unknown client is untrusted."""

    def __init__(self) -> None:
        self._untrusted = TokenBucket(UNTRUSTED_RATE, UNTRUSTED_RATE * BURST_S)
        self._trusted: dict[int, TokenBucket] = {}

    def note(self, client_id: int, now_us: int, *, trusted: bool) -> None:
        """Give a trusted client a quota of its own; all others share one."""
        if not trusted:
            self._trusted.pop(client_id, None)
        elif client_id not in self._trusted:
            self._trusted[client_id] = TokenBucket(TRUSTED_RATE, TRUSTED_RATE * BURST_S, now_us)

    def remove_client(self, client_id: int) -> None:
        """Discard the quota of a client that has gone."""
        self._trusted.pop(client_id, None)

    def allows(self, client_id: int, size: int, now_us: int) -> bool:
        """Return whether a frame from a client, or to it alone, is recorded."""
        return self._trusted.get(client_id, self._untrusted).take(now_us, size)
