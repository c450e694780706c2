"""Lists and files that are sent in batches of a few answers, each transfer in turn.

That bounds the load of the gateway, and overflows neither a receive buffer nor a slow link.
"""

from collections.abc import Iterator
from typing import Final

from gateway.vehicle.service import Answer, Service

BATCH: Final = 10
BATCH_INTERVAL_US: Final = 10_000
"""Size and interval of batches, for all transfers of a service together."""
MAX_TRANSFERS: Final = 512


class TransferService(Service):
    """A service that sends lists and files."""

    def __init__(self) -> None:
        self._transfers: dict[int, Iterator[Answer]] = {}
        """Remaining answers of each transfer; the first transfer is the next one to continue."""
        self._due_us = 0

    def poll(self, now_us: int) -> list[Answer]:
        """Return the next answers of the transfers."""
        found: list[Answer] = []
        if not self._transfers or now_us < self._due_us:
            return found
        while self._transfers and len(found) < BATCH:
            key = next(iter(self._transfers))
            answers = self._transfers.pop(key)
            if (answer := next(answers, None)) is not None:
                found.append(answer)
                self._transfers[key] = answers
        self._due_us = now_us + BATCH_INTERVAL_US
        return found

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self._transfers else None

    def _start(self, key: int, answers: Iterator[Answer], now_us: int) -> list[Answer]:
        """Start a transfer, or start it again; return its first answers."""
        if key in self._transfers or len(self._transfers) < MAX_TRANSFERS:
            self._transfers[key] = answers
        return self.poll(now_us)
