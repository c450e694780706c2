"""Lock-step: every board and every model on one time line, in picoseconds.

All boards run to the same moment, the next event of a model or `STEP_PS` on, whichever is sooner.
A board's action may then schedule an event behind that moment only: the radio's 130 us from the
order to send to the first bit is the look-ahead that makes its timing exact.
"""

import heapq
import itertools
from collections.abc import Callable
from typing import Final, Protocol

PS_PER_S: Final = 1_000_000_000_000
PS_PER_US: Final = 1_000_000
STEP_PS: Final = 100 * PS_PER_US
_FS_PER_S: Final = 1_000_000_000_000_000


class RunsOnCycles(Protocol):
    """What the bench needs of a chip."""

    frequency_hz: int

    def run(self, cycle: int) -> None:
        """Run to at least this cycle."""

    @property
    def cycle(self) -> int:
        """Cycles run so far."""


class Timer:
    """A chip's cycles on the bench's time line.

    Parameters
    ----------
    chip : RunsOnCycles
    clock_ppm : float
        How much faster than its nominal frequency the chip's crystal runs.
    """

    def __init__(self, chip: RunsOnCycles, clock_ppm: float = 0.0) -> None:
        self.chip = chip
        self._period_fs = round(_FS_PER_S / (chip.frequency_hz * (1 + clock_ppm * 1e-6)))
        self._halted_ps = 0

    def time_of(self, cycle: int) -> int:
        """Return when a cycle begins, in ps."""
        return self._halted_ps + cycle * self._period_fs // 1000

    @property
    def now_ps(self) -> int:
        """The chip's present."""
        return self.time_of(self.chip.cycle)

    def run(self, until_ps: int) -> None:
        """Run to at least this time."""
        self.chip.run(-((self._halted_ps - until_ps) * 1000 // self._period_fs))

    def halt(self, until_ps: int) -> None:
        """Let time pass until then without a cycle."""
        self._halted_ps += max(0, until_ps - self.now_ps)


class Bench:
    """The time line: boards, and events of the models."""

    def __init__(self) -> None:
        self.now_ps = 0
        self.timers: list[Timer] = []
        self.after_step: list[Callable[[], None]] = []
        """Called whenever all boards have reached the same moment."""
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def at(self, time_ps: int, action: Callable[[], None]) -> None:
        """Have `action` called at a time; if that is past, at once."""
        heapq.heappush(self._events, (time_ps, next(self._order), action))

    def run_until(self, time_ps: int) -> None:
        """Run boards and models to this time."""
        while self.now_ps < time_ps:
            next_ps = self._events[0][0] if self._events else time_ps
            self.now_ps = max(self.now_ps, min(next_ps, self.now_ps + STEP_PS, time_ps))
            for timer in self.timers:
                timer.run(self.now_ps)
            while self._events and self._events[0][0] <= self.now_ps:
                heapq.heappop(self._events)[2]()
            for action in self.after_step:
                action()

    def run_for(self, seconds: float) -> None:
        """Run boards and models on."""
        self.run_until(self.now_ps + round(seconds * PS_PER_S))
