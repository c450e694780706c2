"""Limit how much of a recording each client fills with its requests and their answers.

A client decides how often it asks; without a limit, one of them could fill the disk. Requests
beyond the limit are answered all the same, but not recorded.
"""

from typing import Final

from gateway.units import US_PER_S

TRUSTED_BPS: Final = 64_000
"""Bytes a second for each client that may change things: more than any ground station sends."""
STRANGERS_BPS: Final = 4_000
"""Bytes a second for all others together."""
BURST_S: Final = 16
"""Length of a burst: a ground station asks much when it connects, then little."""


class _Bucket:
    """A token bucket."""

    def __init__(self, rate_bps: int, now_us: int) -> None:
        self._rate_bps = rate_bps
        self._bytes = float(rate_bps * BURST_S)
        self._filled_us = now_us

    def draw(self, size: int, now_us: int) -> bool:
        added = self._rate_bps * (now_us - self._filled_us) / US_PER_S
        self._bytes = min(self._bytes + added, self._rate_bps * BURST_S)
        self._filled_us = now_us
        if self._bytes < size:
            return False
        self._bytes -= size
        return True


class RecordingBudget:
    """What may still be recorded of each client; one that was never noted is untrusted."""

    def __init__(self) -> None:
        self._strangers = _Bucket(STRANGERS_BPS, 0)
        self._trusted: dict[int, _Bucket] = {}

    def note(self, client_id: int, now_us: int, *, trusted: bool) -> None:
        """Note whether a client may change things."""
        if not trusted:
            self._trusted.pop(client_id, None)
        elif client_id not in self._trusted:
            self._trusted[client_id] = _Bucket(TRUSTED_BPS, now_us)

    def forget_client(self, client_id: int) -> None:
        """Forget a client that has gone."""
        self._trusted.pop(client_id, None)

    def takes(self, client_id: int, size: int, now_us: int) -> bool:
        """Return whether a frame from a client, or to it alone, is recorded.

        Parameters
        ----------
        client_id : int
        size : int
            Of the frame in bytes.
        now_us : int
            Gateway clock.

        Returns
        -------
        bool
        """
        return self._trusted.get(client_id, self._strangers).draw(size, now_us)
