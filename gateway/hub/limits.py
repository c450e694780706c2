"""Quotas of answers and rates of messages.

Theory of operation. Requests wait in a bounded queue for each client and are taken in turn: a
client that asks a thousand times a second delays only itself. Answers are limited by a token
bucket for each client, in bytes, which fills at a steady rate: a request costs what reading it
costs, each byte of an answer costs one, and no request is taken from a client whose level is
negative. All untrusted clients share a single small bucket, because a refused one could return
from another address.

The requests of a ground station in a session (a parameter list, files of metadata, a mission of
two thousand items) fit into a full bucket; the rate matters only after that.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from gateway.records import Incoming
from gateway.token_bucket import TokenBucket

REQUEST_COST: Final = 200
"""Cost of a request, bytes: reading and answering it takes as long as sending this many."""
CLIENT_RATE: Final = 80_000
"""Refill of a client's bucket, bytes a second: 400 requests, a few percent of a processor."""
CLIENT_BURST: Final = 400_000
UNTRUSTED_RATE: Final = 20_000
UNTRUSTED_BURST: Final = 200_000
"""Bucket of the untrusted, bytes: the start-up traffic of three ground stations on tablets."""
MAX_WAITING: Final = 64
"""Maximum waiting requests of a client; one that waits for its answers has one or two."""
SLACK_SHIFT: Final = 2
"""A limited frame may be a quarter of its interval early, or jitter would halve the rate."""


@dataclass(slots=True, eq=False)
class _Line:
    """Waiting requests of one client."""

    bucket: TokenBucket
    waiting: deque[Incoming] = field(default_factory=deque)


class RequestQueue:
    """Requests of all clients, served in turn and within each client's quota."""

    def __init__(self) -> None:
        self._lines: dict[int, _Line] = {}
        self._turns: dict[int, _Line] = {}
        """Clients with waiting requests; the first was served longest ago."""
        self._untrusted = TokenBucket(UNTRUSTED_RATE, UNTRUSTED_BURST)

    def offer(self, incoming: Incoming, now_us: int) -> bool:
        """Queue a request; return whether there was room."""
        line = self._lines.get(incoming.client_id)
        if line is None or (line.bucket is self._untrusted) == incoming.trusted:
            bucket = self._untrusted
            if incoming.trusted:
                bucket = TokenBucket(CLIENT_RATE, CLIENT_BURST, now_us)
            line = self._lines[incoming.client_id] = _Line(bucket)
            self._turns.pop(incoming.client_id, None)
        if len(line.waiting) >= MAX_WAITING:
            return False
        line.waiting.append(incoming)
        self._turns.setdefault(incoming.client_id, line)
        return True

    def take(self, now_us: int) -> Incoming | None:
        """Return the next request; None if no client with quota left has one."""
        for line in self._turns.values():
            line.bucket.refill(now_us)
            if line.bucket.level > 0:
                return self._take_of(line)
        return None

    def wait_us(self, now_us: int) -> int | None:
        """Return the time until `take` returns a request; None if the queue is empty."""
        for line in self._turns.values():
            line.bucket.refill(now_us)
        return min((line.bucket.wait_us() for line in self._turns.values()), default=None)

    def charge(self, client_id: int, size: int) -> None:
        """Charge a client for bytes that were sent because of it."""
        if line := self._lines.get(client_id):
            line.bucket.level -= size

    def remove(self, client_id: int) -> None:
        """Drop the requests of a client that has gone; a shared bucket keeps its level."""
        self._lines.pop(client_id, None)
        self._turns.pop(client_id, None)

    def _take_of(self, line: _Line) -> Incoming:
        incoming = line.waiting.popleft()
        del self._turns[incoming.client_id]
        if line.waiting:
            self._turns[incoming.client_id] = line
        line.bucket.level -= REQUEST_COST
        return incoming


@dataclass(slots=True)
class RateLimit:
    """Least time between two frames of one kind to one client."""

    interval_us: int
    due_us: int = 0
    least_us: int = 0
    """Interval by settings and requests, which a plan of the bandwidth may only increase."""

    def is_due(self, now_us: int) -> bool:
        """Return whether a frame may be sent now, and count it as sent."""
        slack_us = self.interval_us >> SLACK_SHIFT
        if now_us < self.due_us - slack_us:
            return False
        self.due_us = max(self.due_us, now_us - slack_us) + self.interval_us
        return True

    def change(self, interval_us: int) -> None:
        """Apply another interval from the next frame on."""
        if interval_us == self.interval_us:
            return
        if self.due_us:
            self.due_us += interval_us - self.interval_us
        self.interval_us = interval_us
