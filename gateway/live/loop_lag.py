"""Detects that the event loop does not get the processor time it needs.

The daemon's timer measures how late it is called. A single long delay, or many short ones, mean
that the computer is too slow or was stopped: samples are then lost on this side, which must not be
taken for a fault of the nodes or the radio.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

from gateway.units import US_PER_S

STALL_US: Final = 500_000
"""A delay that loses samples: the kernel buffers about 0.4 s of them."""
SPAN_US: Final = 10 * US_PER_S
MAX_SHARE: Final = 0.3
"""Delays that add up to more of the span mean that the loop cannot keep up."""
WARM_UP_US: Final = 5 * US_PER_S
"""At the start, loading machine code takes 0.25 s of a PC, several times that of a small board."""
RECOVERED_US: Final = 60 * US_PER_S
MAX_DELAYS: Final = 1000
"""In a span; the timer fires at most every millisecond, but only delays are kept."""
LEAST_DELAY_US: Final = 20_000
NEVER_US: Final = 1 << 62


@dataclass(frozen=True, slots=True)
class LagReport:
    """One measurement of the event loop."""

    stalled_us: int
    """Duration of a stall that has just ended; 0 for none."""
    changed: bool
    """Whether the state has just changed."""


class LoopLag:
    """The delays of one event loop."""

    def __init__(self) -> None:
        self.is_slow = False
        self.longest_us = 0
        """The longest delay since the state changed to slow."""
        self._delays: deque[tuple[int, int]] = deque(maxlen=MAX_DELAYS)
        self._slow_us = 0
        self.stalled_after_us = NEVER_US
        """After this time the timer, if it has not been called, is late by a stall."""
        self._due_us: int | None = None
        self._begin_us: int | None = None

    def expect(self, due_us: int) -> None:
        """Set when the timer is to be called next."""
        self._due_us = due_us
        self.stalled_after_us = due_us + STALL_US

    def update(self, now_us: int) -> LagReport:
        """Add one call of a timer.

        Parameters
        ----------
        now_us : int
            When it was called.

        Returns
        -------
        LagReport
        """
        self.stalled_after_us = NEVER_US
        if self._begin_us is None:
            self._begin_us = now_us
        delay_us = 0 if self._due_us is None else now_us - self._due_us
        self._due_us = None
        if delay_us >= LEAST_DELAY_US:
            self._delays.append((now_us, delay_us))
        while self._delays and self._delays[0][0] <= now_us - SPAN_US:
            self._delays.popleft()
        total_us = sum(delay for _, delay in self._delays)
        stalled_us = delay_us if delay_us >= STALL_US else 0
        before = self.is_slow
        is_warm = now_us - self._begin_us >= WARM_UP_US
        if is_warm and (stalled_us or total_us > MAX_SHARE * SPAN_US):
            self.longest_us = max(delay_us, self.longest_us if before else 0)
            self.is_slow, self._slow_us = True, now_us
        elif now_us - self._slow_us > RECOVERED_US:
            self.is_slow = False
        return LagReport(stalled_us, self.is_slow != before)
