"""Where the work on many recordings is done: one interface, and the local processes behind it."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from typing import Any, Final, Protocol, TypeVar

from gateway.analysis.processes import START, cores, keep_inherited, no_warning_of_threads
from gateway.reasons import reason_of

WAITING: Final = 2
"""Pieces of work a process that are handed out: one is worked at, one waits. Bounds the memory."""
LOOK_S: Final = 1.0
"""Between two looks at whether the parent process lives."""

Item = TypeVar("Item")
Result = TypeVar("Result")


class WorkError(Exception):
    """What the work says in words of its own when it cannot be done."""


@dataclass(frozen=True, slots=True)
class WorkFailed:
    """Work that came to no result, through no fault of the others."""

    reason: str


class Executor(Protocol):
    """Does a work on many items, in any order."""

    def run(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | WorkFailed]]:
        """Yield the number of each item and what came out, as it is done.

        An exception of the work fails that item alone; where a process or machine dies, its items
        are done again by others, and one that kills all who take it fails.
        """
        ...


class ThisProcess:
    """Do little work in the calling process, which would not repay starting others."""

    def run(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | WorkFailed]]:
        """See `Executor`."""
        for number, item in enumerate(items):
            try:
                yield number, work(item)
            except Exception as error:  # noqa: BLE001 - it fails this item alone
                yield number, failure_of(error)


class LocalProcesses:
    """Processes of this machine."""

    def __init__(self, jobs: int | None) -> None:
        self._jobs = jobs or cores()

    def run(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | WorkFailed]]:
        """See `Executor`."""
        waiting = deque(range(len(items)))
        suspects: deque[int] = deque()
        while waiting or suspects:
            # After a death each that may have caused it is tried alone.
            queue, jobs = (suspects, 1) if suspects else (waiting, min(self._jobs, len(waiting)))
            lost = yield from _run_in_one_pool(work, items, queue, jobs)
            if jobs == 1 and lost:
                guilty = lost.pop(0)
                yield guilty, WorkFailed("its process died: out of memory, or killed")
            suspects.extend(lost)


def _run_in_one_pool(
    work: Callable[[Item], Result], items: Sequence[Item], queue: deque[int], jobs: int
) -> Any:
    """Work the queue off as long as no process dies; return what was being worked at then."""
    running: dict[Future[Result], int] = {}
    with _processes(jobs) as pool:
        while queue or running:
            try:
                while queue and len(running) < (jobs * WAITING if jobs > 1 else 1):
                    running[pool.submit(work, items[queue[0]])] = queue[0]
                    queue.popleft()
            except BrokenProcessPool:
                return sorted(running.values())
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    return sorted(running.values())
                yield running.pop(future), failure_of(error) if error else future.result()
    return []


def failure_of(error: BaseException) -> WorkFailed:
    """Say what was wrong."""
    if isinstance(error, WorkError):
        return WorkFailed(str(error))
    if isinstance(error, OSError) and error.filename:
        return WorkFailed(f"{error.filename}: {error.strerror or reason_of(error)}")
    return WorkFailed(f"{type(error).__name__}: {error}")


@contextmanager
def _processes(jobs: int) -> Iterator[ProcessPoolExecutor]:
    context = multiprocessing.get_context(START)
    stop = context.Event()
    with no_warning_of_threads():
        pool = ProcessPoolExecutor(jobs, context, _begin, (stop, os.getpid()))
        # All processes begin now, before a thread of the pool's own.
        pool.submit(os.getpid).result()
    try:
        yield pool
    except BaseException:
        stop.set()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(stop: Event, parent: int) -> None:
    """Leave an interrupt to the parent, and end when it does."""
    keep_inherited()
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            if stop.wait(LOOK_S):
                break
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
