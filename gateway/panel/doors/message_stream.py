"""Messages as they arrive, to all followers; each is encoded once for all.

A follower that reads too slowly loses its own oldest messages.
"""

import asyncio
import json
from collections import deque
from collections.abc import Iterator, Set
from contextlib import contextmanager
from typing import Any, Final

from gateway.panel.doors.message_json import to_json

MAX_WAITING: Final = 1000
"""Messages: some seconds of one aircraft."""


class Follower:
    """A client that follows some kinds of message.

    Parameters
    ----------
    names : set of str
        Names of the messages it wants.
    """

    def __init__(self, names: Set[str]) -> None:
        self.names = names
        self.dropped = 0
        self._waiting: deque[str | bytes] = deque(maxlen=MAX_WAITING)
        self._news = asyncio.Event()

    def push(self, text: str | bytes) -> None:
        """Queue a text or bytes; the oldest makes room."""
        self.dropped += len(self._waiting) == MAX_WAITING
        self._waiting.append(text)
        self._news.set()

    async def next(self) -> str | bytes:
        """Return the next item to send."""
        while not self._waiting:
            self._news.clear()
            await self._news.wait()
        return self._waiting.popleft()


class MessageStream:
    """Pass messages to followers."""

    def __init__(self) -> None:
        self._followers: list[Follower] = []

    @contextmanager
    def follow(self, names: Set[str]) -> Iterator[Follower]:
        """Follow some kinds of message for a while."""
        follower = Follower(names)
        self._followers.append(follower)
        try:
            yield follower
        finally:
            self._followers.remove(follower)

    def take(self, message: Any) -> None:
        """Pass on one decoded message."""
        followers = [each for each in self._followers if message.msgname in each.names]
        if not followers:
            return
        text = pretty(with_header(message))
        for follower in followers:
            follower.push(text)


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
