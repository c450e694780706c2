"""Limit the lines that strangers can cause: a few a minute in full, the rest as a number."""

from typing import Final

from gateway.units import US_PER_S

WINDOW_US: Final = 60 * US_PER_S


class Digest:
    """Lines of one kind: a few of each minute in full, the others as their number.

    Parameters
    ----------
    in_full : int
        Most lines passed in full in one minute.
    rest : str
        Text that follows the number of the others.
    """

    def __init__(self, in_full: int, rest: str) -> None:
        self._in_full = in_full
        self._rest = rest
        self._begin_us = 0
        self._lines = 0

    def say(self, line: str, now_us: int) -> list[str]:
        """Return the line if it may pass in full, else nothing."""
        found = self.poll(now_us)
        self._lines += 1
        return [*found, line] if self._lines <= self._in_full else found

    def poll(self, now_us: int) -> list[str]:
        """Return at the end of a minute how many lines were held back, if any."""
        if now_us - self._begin_us < WINDOW_US:
            return []
        untold, self._lines, self._begin_us = self._lines - self._in_full, 0, now_us
        return [f"{untold} {self._rest}"] if untold > 0 else []
