"""Messages as they arrive, to all subscribers, chosen by a regular expression on their names.

Each message is encoded once for all. A subscriber that reads too slowly loses its own oldest
messages.

Python's engine of regular expressions backtracks, which takes exponential time for some expressions
and blocks the whole process. So a separate process tries the names, once per expression, and the
kernel ends it when it has taken too much processor time: a busy machine makes no expression wrong.
"""

import asyncio
import functools
import json
import signal
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Set
from contextlib import contextmanager
from typing import Any, Final

from gateway.wire.mavlink_json import to_json

MAX_WAITING_BYTES: Final = 1 << 20
"""Of one subscriber: some seconds of one aircraft."""
MAX_PATTERN: Final = 1000
LIMIT_S: Final = 1
"""Of processor time: many times what the start takes, and an ordinary expression takes less yet."""
ENDED_BY_KERNEL: Final = (-signal.SIGXCPU, -signal.SIGKILL)
EVERYTHING: Final = ".*"
AT_ONCE: Final = 2
MAX_PENDING: Final = 8
"""Expressions that are tried or wait for it."""

SIEVE: Final = f"""
import json, re, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, ({LIMIT_S}, {LIMIT_S}))
pattern, names = json.load(sys.stdin)
try:
    wanted = re.compile(pattern)
except re.error as error:
    json.dump(str(error), sys.stdout)
else:
    json.dump([name for name in names if wanted.search(name)], sys.stdout)
"""


class Subscriber:
    """A client that receives some kinds of message.

    Parameters
    ----------
    names : set of str
        Names of the messages it wants.
    """

    def __init__(self, names: Set[str]) -> None:
        self.names = names
        self.dropped = 0
        self._waiting: deque[str | bytes] = deque()
        self._bytes = 0
        self._news = asyncio.Event()

    def push(self, data: str | bytes) -> None:
        """Queue a text or bytes; the oldest entries make room for it."""
        self._waiting.append(data)
        self._bytes += len(data)
        while self._bytes > MAX_WAITING_BYTES:
            self._bytes -= len(self._waiting.popleft())
            self.dropped += 1
        self._news.set()

    async def next(self) -> str | bytes:
        """Return the next entry to send."""
        while not self._waiting:
            self._news.clear()
            await self._news.wait()
        data = self._waiting.popleft()
        self._bytes -= len(data)
        return data


class MessageStream:
    """Pass messages to subscribers."""

    def __init__(self) -> None:
        self._subscribers: list[Subscriber] = []

    @contextmanager
    def subscribe(self, names: Set[str]) -> Iterator[Subscriber]:
        """Receive some kinds of message for a while."""
        subscriber = Subscriber(names)
        self._subscribers.append(subscriber)
        try:
            yield subscriber
        finally:
            self._subscribers.remove(subscriber)

    def send(self, message: Any) -> None:
        """Pass on one decoded message."""
        subscribers = [each for each in self._subscribers if message.msgname in each.names]
        if not subscribers:
            return
        text = pretty(with_header(message))
        for subscriber in subscribers:
            subscriber.push(text)


class NameFilters:
    """Regular expressions tried on a set of names.

    Parameters
    ----------
    names : iterable of str
        All names.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = frozenset(names)
        self._turns = asyncio.Semaphore(AT_ONCE)
        self._pending = 0
        self._known = functools.lru_cache(maxsize=64)(self._remember)

    async def matching(self, pattern: str) -> frozenset[str]:
        """Return the names in which an expression is found.

        Raises
        ------
        ValueError
            If it is invalid, or takes too long; the text says which.
        """
        if pattern == EVERYTHING:
            return self._names
        if len(pattern) > MAX_PATTERN:
            raise ValueError(f"filter: it has more than {MAX_PATTERN} letters")
        if self._pending >= MAX_PENDING:
            raise ValueError("filter: too many are being tried; connect again later")
        # Shielded: a client that leaves meanwhile must not cancel the answer to the others.
        return await asyncio.shield(self._known(pattern))

    def _remember(self, pattern: str) -> "asyncio.Task[frozenset[str]]":
        return asyncio.create_task(self._try(pattern))

    async def _try(self, pattern: str) -> frozenset[str]:
        self._pending += 1
        try:
            found = await self._run(pattern)
        finally:
            self._pending -= 1
        if isinstance(found, str):
            raise ValueError(f"filter {pattern!r}: {found}")  # noqa: TRY004 -- the value is wrong
        return frozenset(found)

    async def _run(self, pattern: str) -> str | list[str]:
        """Return the names that match, or why the expression cannot be tried."""
        async with self._turns:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-I", "-S", "-c", SIEVE),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.DEVNULL,
            )
            question = json.dumps([pattern, sorted(self._names)]).encode()
            answer, _ = await process.communicate(question)
        if process.returncode in ENDED_BY_KERNEL:
            return "it takes too long"
        found: str | list[str] = json.loads(answer or b'"it cannot be tried"')
        return found


def with_header(message: Any) -> dict[str, Any]:
    """Return a message with its sender, as JSON."""
    header = {
        "system_id": message.get_srcSystem(),
        "component_id": message.get_srcComponent(),
        "sequence": message.get_seq(),
    }
    return {"header": header, "message": to_json(message)}


def pretty(value: Any) -> str:
    """Write indented JSON; scripts rely on the line breaks."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
