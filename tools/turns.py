"""Measure the turns of an event loop, and the program's own share of each.

A turn is the time between two waits of the loop, in which no input is handled. The program's own
share is the time in which its thread computes or waits for a disk, a lock or another thread. In a
turn without such a wait that is its processor time; in any other turn, the time in which the thread
was ready but the kernel ran others is subtracted. Time used by the host of a virtual machine is
still included: `even_turns`, a loop whose turns do the same work, measures that.
"""

import asyncio
import contextlib
import gc
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
    end_ns: int
    """End by `time.perf_counter_ns`, which is the same for all programs of a machine."""
    longest: str
    """The longest callback."""


class TurnWatch(selectors.EpollSelector):
    """The selector of an event loop, which is called at the beginning and the end of every turn."""

    def __init__(self) -> None:
        super().__init__()
        self.worst: list[Turn] = []
        """The turns with the longest own share; a heap."""
        self.turns = self.long_turns = 0
        self.longest_wall_us = 0.0
        self.longest_collection_us = [0.0, 0.0, 0.0]
        """Longest run of the garbage collector by generation."""
        self.marks: list[tuple[float, str]] = []
        """Times (s since the start) and texts of noted events."""
        self._run = asyncio.Handle._run  # noqa: SLF001
        self._schedule = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        self._waited_ns = self._waits = self._computed_ns = 0
        self._longest: tuple[int, object] = (0, None)
        self._collecting_ns = 0
        self.restart()

    def restart(self) -> None:
        """Start measuring, and discard earlier results."""
        self._is_on = True
        self.worst.clear()
        self.turns = self.long_turns = 0
        self.longest_wall_us = 0.0
        self.longest_collection_us[:] = 0.0, 0.0, 0.0
        self.marks.clear()
        self._began_ns = time.perf_counter_ns()
        self._begin_ns: int | None = None

    def stop(self) -> None:
        """Stop measuring."""
        self._is_on = False

    def mark(self, what: str) -> None:
        """Note an event, for comparison with the longest turns."""
        self.marks.append((self.seconds_at(time.perf_counter_ns()), what))

    def seconds_at(self, time_ns: int) -> float:
        """Convert a time of `time.perf_counter_ns` to seconds since the start."""
        return (time_ns - self._began_ns) / 1e9

    def longest(self) -> Turn:
        """Return the turn with the longest own share."""
        return max(self.worst)

    def install(self) -> None:
        """Measure single callbacks and garbage collections too."""
        watch = self

        def run(handle: asyncio.Handle) -> None:
            begin_ns = time.perf_counter_ns()
            watch._run(handle)
            took_ns = time.perf_counter_ns() - begin_ns
            if took_ns > watch._longest[0]:
                watch._longest = took_ns, getattr(handle, "_callback", None)

        asyncio.Handle._run = run  # type: ignore[method-assign, assignment]  # noqa: SLF001
        gc.callbacks.append(self._on_collection)

    def select(self, timeout: float | None = None) -> list[Any]:
        """Wait for events; the time between two calls is a turn."""
        if self._begin_ns is not None and self._is_on:
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
        self.longest_wall_us = max(self.longest_wall_us, wall_us)
        self.turns += 1
        self.long_turns += own_us > LONG_US
        if len(self.worst) < WORST or own_us > self.worst[0].own_us:
            turn = Turn(own_us, wall_us, now_ns, _name(self._longest[1]))
            (heapq.heappush if len(self.worst) < WORST else heapq.heapreplace)(self.worst, turn)

    def _ready_ns(self) -> int:
        """Return the total time for which the thread has waited for a processor."""
        return int(os.pread(self._schedule, 64, 0).split()[1])

    def _on_collection(self, phase: str, info: dict[str, int]) -> None:
        now_ns = time.thread_time_ns()
        if phase == "start":
            self._collecting_ns = now_ns
            return
        longest, generation = self.longest_collection_us, info["generation"]
        longest[generation] = max(longest[generation], (now_ns - self._collecting_ns) / 1e3)

    def report(self) -> str:
        """Describe the results in some lines."""
        lines = [
            f"  {self.long_turns} of {self.turns} turns took more than {LONG_US / 1e3:.0f} ms",
            f"  longest turn, the machine's share included: {self.longest_wall_us / 1e3:.2f} ms",
        ]
        lines += [
            f"  own {turn.own_us / 1e3:6.2f} ms of {turn.wall_us / 1e3:6.2f} ms at "
            f"{self.seconds_at(turn.end_ns):7.1f} s, mostly {turn.longest}"
            for turn in sorted(self.worst, reverse=True)
        ]
        lines += [f"  at {at_s:7.1f} s {what}" for at_s, what in self.marks]
        collected = ", ".join(f"{us / 1e3:.2f}" for us in self.longest_collection_us)
        return "\n".join([*lines, f"  longest collections by generation: {collected} ms"])


def waits() -> int:
    """Return the number of voluntary waits of the thread."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


def _name(callback: object) -> str:
    owner = getattr(callback, "__self__", None)
    if isinstance(owner, asyncio.Task):
        return getattr(owner.get_coro(), "__qualname__", repr(owner))
    return getattr(callback, "__qualname__", type(callback).__name__)


async def _add_up(parent: int) -> None:
    while os.getppid() == parent:
        await asyncio.sleep(PAUSE_S)
        sum(range(COUNT))


def even_turns(seconds: float) -> tuple[Turn, float, int, int]:
    """Measure a loop that does the same work in every turn, until its parent process ends.

    Returns
    -------
    longest : Turn
        The turn with the longest own share.
    wall_us : float
        The longest turn of all.
    long_turns, turns : int
        Turns whose own share exceeds `LONG_US`, and all turns.
    """
    watch = TurnWatch()
    with (
        contextlib.suppress(TimeoutError),
        asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner,
    ):
        runner.run(asyncio.wait_for(_add_up(os.getppid()), seconds))
    return watch.longest(), watch.longest_wall_us, watch.long_turns, watch.turns
