"""Which request is answered next, and how many bytes of answers each client may cause.

Theory of operation. Requests wait in a bounded queue for each client and are taken in turn: a
client that asks a thousand times a second delays only itself. Answers are limited by a token
bucket for each client, in bytes, which fills at a steady rate: a request costs what reading it
costs, each byte of an answer costs one, and nothing is taken from a client that is in debt. All
untrusted clients share a single small bucket, because one that is turned away could come back
under another address.

What a ground station does in a session (a parameter list, files of metadata, a mission of two
thousand items) fits into a full bucket; the rate matters only after that.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from gateway.hub.token_bucket import Purse
from gateway.records import Incoming

REQUEST_COST: Final = 200
"""Bytes: decoding a request and building its answer takes as long as sending this many."""
CLIENT_RATE: Final = 80_000
"""Bytes a second: 400 requests, a few percent of a processor."""
CLIENT_BURST: Final = 400_000
STRANGERS_RATE: Final = 20_000
STRANGERS_BURST: Final = 200_000
"""The start of three ground stations on tablets."""
MAX_WAITING: Final = 64
"""Requests of a client; one that waits for its answers has one or two."""


@dataclass(slots=True, eq=False)
class _Line:
    """One client's requests."""

    purse: Purse
    waiting: deque[Incoming] = field(default_factory=deque)


class RequestQueue:
    """Requests of all clients, taken in turn and within each client's quota."""

    def __init__(self) -> None:
        self._lines: dict[int, _Line] = {}
        self._turns: dict[int, _Line] = {}
        """Those who have something waiting; who is first was served longest ago."""
        self._strangers = Purse(STRANGERS_RATE, STRANGERS_BURST, STRANGERS_BURST)

    def offer(self, incoming: Incoming, now_us: int) -> bool:
        """Let a request wait for its turn; return whether there was room."""
        line = self._lines.get(incoming.client_id)
        if line is None or (line.purse is self._strangers) == incoming.trusted:
            purse = self._strangers
            if incoming.trusted:
                purse = Purse(CLIENT_RATE, CLIENT_BURST, CLIENT_BURST, now_us)
            line = self._lines[incoming.client_id] = _Line(purse)
            self._turns.pop(incoming.client_id, None)
        if len(line.waiting) >= MAX_WAITING:
            return False
        line.waiting.append(incoming)
        self._turns.setdefault(incoming.client_id, line)
        return True

    def take(self, now_us: int) -> Incoming | None:
        """Return the request to serve now; None if none waits from a client with quota left."""
        for line in self._turns.values():
            line.purse.fill(now_us)
            if line.purse.level > 0:
                return self._take_of(line)
        return None

    def wait_us(self, now_us: int) -> int | None:
        """Return how long until `take` gives something; None if nothing waits."""
        for line in self._turns.values():
            line.purse.fill(now_us)
        return min((line.purse.wait_us() for line in self._turns.values()), default=None)

    def charge(self, client_id: int, size: int) -> None:
        """Charge a client for bytes that were sent because of it."""
        if line := self._lines.get(client_id):
            line.purse.level -= size

    def forget(self, client_id: int) -> None:
        """Drop the requests of a client that has gone; the strangers' common debt stays."""
        self._lines.pop(client_id, None)
        self._turns.pop(client_id, None)

    def _take_of(self, line: _Line) -> Incoming:
        incoming = line.waiting.popleft()
        del self._turns[incoming.client_id]
        if line.waiting:
            self._turns[incoming.client_id] = line
        line.purse.level -= REQUEST_COST
        return incoming
