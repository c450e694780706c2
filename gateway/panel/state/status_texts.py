"""STATUSTEXT: long texts put together from their chunks, with time and severity."""

from collections import deque
from dataclasses import dataclass, replace
from typing import Any, Final

CHUNK: Final = 50
"""Letters of one message; a shorter one, or one with a zero, ends its text."""
MAX_TEXTS: Final = 500
MAX_LETTERS: Final = 2_000
"""Longer texts are cut there."""


@dataclass(frozen=True, slots=True)
class TimedText:
    """One text."""

    number: int
    """Counts up from 1, so that a page knows which are new."""
    time_us: int
    """On the panel's clock."""
    severity: int
    """MAV_SEVERITY: 0 emergency to 7 debug."""
    text: str


class StatusTexts:
    """The texts of one aircraft, the oldest first."""

    def __init__(self) -> None:
        self.all: deque[TimedText] = deque(maxlen=MAX_TEXTS)
        self._count = 0
        self._open: tuple[int, int] | None = None
        """Id and next chunk of the newest entry, while it is incomplete."""

    def take(self, message: Any, now_us: int) -> None:
        """Take one STATUSTEXT; the chunks of a long one go into one entry, blanks into none."""
        text, number, chunk = message.text, message.id, message.chunk_seq
        if self._open == (number, chunk) and self.all:
            joined = (self.all[-1].text + text)[:MAX_LETTERS]
            self.all[-1] = replace(self.all[-1], text=joined)
        elif text.strip():
            self._count += 1
            self.all.append(TimedText(self._count, now_us, message.severity, text))
        else:
            self._open = None
            return
        continues = number and len(text) == CHUNK
        self._open = (number, chunk + 1) if continues else None
