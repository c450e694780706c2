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
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from gateway.records import Incoming
from gateway.token_bucket import ClientQuotas, TokenBucket

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


class RequestQueue:
    """Requests of all clients, served in turn and within each client's quota."""

    def __init__(self) -> None:
        self._quotas = ClientQuotas(CLIENT_RATE, CLIENT_BURST, UNTRUSTED_RATE, UNTRUSTED_BURST)
        self._waiting: dict[int, deque[Incoming]] = {}
        """Waiting requests by client; the first client was served longest ago."""

    def offer(self, incoming: Incoming, now_us: int) -> bool:
        """Queue a request; return whether there was room."""
        self._quotas.of(incoming.client_id, now_us, trusted=incoming.trusted)
        waiting = self._waiting.setdefault(incoming.client_id, deque())
        if len(waiting) >= MAX_WAITING:
            return False
        waiting.append(incoming)
        return True

    def take(self, now_us: int) -> Incoming | None:
        """Return the next request; None if no client with quota left has one."""
        for client_id, bucket in self._buckets(now_us):
            if bucket.level > 0:
                bucket.level -= REQUEST_COST
                waiting = self._waiting.pop(client_id)
                incoming = waiting.popleft()
                if waiting:
                    self._waiting[client_id] = waiting
                return incoming
        return None

    def wait_us(self, now_us: int) -> int | None:
        """Return the time until `take` returns a request; None if the queue is empty."""
        return min((bucket.wait_us() for _, bucket in self._buckets(now_us)), default=None)

    def charge(self, client_id: int, size: int) -> None:
        """Charge a client for bytes that were sent because of it."""
        if bucket := self._quotas.known(client_id):
            bucket.level -= size

    def remove(self, client_id: int) -> None:
        """Drop the requests of a client that has gone."""
        self._quotas.remove_client(client_id)
        self._waiting.pop(client_id, None)

    def _buckets(self, now_us: int) -> Iterator[tuple[int, TokenBucket]]:
        """Yield the clients with waiting requests in turn, each with its refilled bucket."""
        for client_id in self._waiting:
            if bucket := self._quotas.known(client_id):
                bucket.refill(now_us)
                yield client_id, bucket


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
