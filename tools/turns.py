"""Measure the turns of an event loop, and the program's own share of each.

A turn is the time between two waits of the loop, in which no input is handled. The program's own
share is the time in which its thread computes or waits for a disk, a lock or another thread. In a
turn without such a wait that is its processor time; in any other turn, the time in which the thread
was ready but the kernel ran others is subtracted. Time used by the host of a virtual machine is
still included: `even_turns`, a loop whose turns do the same work, measures that.
"""

import asyncio
import contextlib
import heapq
import os
import resource
import selectors
import time
from typing import Any, NamedTuple

WORST = 5
"""Number of stored turns."""
LONG_US = 2000.0
"""Own share above which a turn is counted as long."""
PAUSE_S = 0.001
COUNT = 25_000
"""Numbers that a turn of the baseline adds: 0.3 ms or more, like a turn of the gateway, so that the
machine affects both equally."""


class Turn(NamedTuple):
    """One turn of the loop."""

    own_us: float
    wall_us: float
    at_s: float
    """Its end, since the start of the measurement."""
    longest: str
    """Its longest callback."""


class TurnWatch(selectors.EpollSelector):
    """The selector of an event loop, which is called at the beginning and the end of every turn."""

    def __init__(self) -> None:
        super().__init__()
        self._schedule = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        self._waited_ns = self._waits = self._computed_ns = 0
        self._longest: tuple[int, object] = (0, None)
        run = asyncio.Handle._run  # noqa: SLF001

        def timed_run(handle: asyncio.Handle) -> None:
            begin_ns = time.perf_counter_ns()
            run(handle)
            took_ns = time.perf_counter_ns() - begin_ns
            if took_ns > self._longest[0]:
                self._longest = took_ns, getattr(handle, "_callback", None)

        asyncio.Handle._run = timed_run  # type: ignore[method-assign, assignment]  # noqa: SLF001
        self.restart()

    def restart(self) -> None:
        """Start measuring, and discard earlier results."""
        self.worst: list[Turn] = []
        """The turns with the longest own share; a heap."""
        self.turns = self.long_turns = 0
        self._began_ns = time.perf_counter_ns()
        self._begin_ns: int | None = None

    def longest(self) -> Turn:
        """Return the turn with the longest own share."""
        return max(self.worst)

    def select(self, timeout: float | None = None) -> list[Any]:
        """Wait for events; the time between two calls is a turn."""
        if self._begin_ns is not None:
            self._end_turn(self._begin_ns)
        found = super().select(timeout)
        self._longest = (0, None)
        self._waited_ns, self._waits = self._ready_ns(), waits()
        self._computed_ns = time.thread_time_ns()
        self._begin_ns = time.perf_counter_ns()
        return found

    def _end_turn(self, begin_ns: int) -> None:
        now_ns = time.perf_counter_ns()
        wall_us = (now_ns - begin_ns) / 1e3
        own_us = (time.thread_time_ns() - self._computed_ns) / 1e3
        if waits() != self._waits:
            own_us = wall_us - (self._ready_ns() - self._waited_ns) / 1e3
        self.turns += 1
        self.long_turns += own_us > LONG_US
        if len(self.worst) < WORST or own_us > self.worst[0].own_us:
            at_s = (now_ns - self._began_ns) / 1e9
            turn = Turn(own_us, wall_us, at_s, _name(self._longest[1]))
            (heapq.heappush if len(self.worst) < WORST else heapq.heapreplace)(self.worst, turn)

    def _ready_ns(self) -> int:
        """Return the total time for which the thread has waited for a processor."""
        return int(os.pread(self._schedule, 64, 0).split()[1])


def waits() -> int:
    """Return the number of voluntary waits of the thread."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


def _name(callback: object) -> str:
    owner = getattr(callback, "__self__", None)
    if isinstance(owner, asyncio.Task):
        return getattr(owner.get_coro(), "__qualname__", repr(owner))
    return getattr(callback, "__qualname__", type(callback).__name__)


def even_turns(seconds: float) -> TurnWatch:
    """Measure a loop that does the same work in every turn, until its parent process ends."""
    watch, parent = TurnWatch(), os.getppid()

    async def add_up() -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while os.getppid() == parent:
                    await asyncio.sleep(PAUSE_S)
                    sum(range(COUNT))

    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner:
        runner.run(add_up())
    return watch
