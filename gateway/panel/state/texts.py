"""The texts of an aircraft."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from gateway.vehicle_state.status_texts import JoinedText, TextJoiner

MAX_TEXTS: Final = 500
MAX_LETTERS: Final = 2_000
"""Maximum characters; longer texts are cut."""


@dataclass(frozen=True, slots=True)
class TimedText:
    """One text."""

    number: int
    """Counts up from 1, so that a page can find the new ones."""
    time_us: int
    """Time on the panel's clock."""
    severity: int
    """MAV_SEVERITY: 0 emergency to 7 debug."""
    text: str


class StatusTexts:
    """The texts of one aircraft, the oldest first."""

    def __init__(self) -> None:
        self.all: deque[TimedText] = deque(maxlen=MAX_TEXTS)
        self._count = 0
        self._joiner = TextJoiner()

    def feed(self, message: Any, now_us: int) -> None:
        """Add one STATUSTEXT; chunks of a long text share an entry, blank texts are ignored."""
        self._add(self._joiner.feed(bytes(message.get_msgbuf()), now_us))

    def poll(self, now_us: int) -> None:
        """Add the texts whose last chunks are lost."""
        self._add(self._joiner.poll(now_us))

    def _add(self, texts: Iterable[JoinedText]) -> None:
        for joined in texts:
            if text := joined.text.strip()[:MAX_LETTERS]:
                self._count += 1
                self.all.append(TimedText(self._count, joined.time_us, joined.severity, text))
