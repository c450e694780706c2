"""A rate limit for the log, so that no repeated error fills the disk.

A kind of line is the code position that writes it and, for an unexpected error, the one that
raised it. Each kind may write a few lines at once and then one a second; the next written line
gives the number of suppressed ones. Time is monotonic, so setting the wall clock back suppresses
no line.
"""

import logging
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gateway.token_bucket import TokenBucket
from gateway.units import US_PER_S

BURST: Final = 20
"""Maximum lines of a kind at once: a start with many endpoints writes one for each."""
LINES_PER_S: Final = 1.0
MAX_KINDS: Final = 1024
"""Maximum code positions; there are fewer, so none is discarded in practice."""

Kind = tuple[str, int, str]


@dataclass(slots=True)
class _Kind:
    bucket: TokenBucket
    suppressed: int = 0


class LogLimit(logging.Filter):
    """Pass a bounded number of lines of each kind to a handler."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._kinds: dict[Kind, _Kind] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a line is written; the first after a gap gets the number of suppressed."""
        if len(self._kinds) >= MAX_KINDS:
            self._kinds.clear()
        kind = self._kinds.setdefault(_kind_of(record), _Kind(TokenBucket(LINES_PER_S, BURST)))
        if not kind.bucket.take(round(self._clock() * US_PER_S)):
            kind.suppressed += 1
            return False
        if kind.suppressed:
            record.msg = f"{record.getMessage()} (and {kind.suppressed} more like it, not logged)"
            record.args = None
            kind.suppressed = 0
        return True


def _kind_of(record: logging.LogRecord) -> Kind:
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return record.pathname, record.lineno, ""
    frames = traceback.extract_tb(error.__traceback__, limit=-1)
    if not frames:
        return record.pathname, record.lineno, type(error).__name__
    return frames[-1].filename, frames[-1].lineno or 0, type(error).__name__
