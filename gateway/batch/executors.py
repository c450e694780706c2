"""Where the work on many recordings is done: in local processes, or on a Dask cluster."""

import asyncio
import ctypes
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
from importlib import import_module
from multiprocessing.synchronize import Event
from typing import Any, Final, Protocol, TypeVar

from gateway import __version__
from gateway.analysis.processes import START, cores, keep_inherited, no_warning_of_threads
from gateway.extensions import load_extensions
from gateway.printable import UserError, reason_of

WAITING: Final = 2
"""Pieces of work a process that are handed out: one is worked at, one waits. Bounds the memory."""
LOOK_S: Final = 1.0
"""Between two looks at whether the parent process lives."""

Item = TypeVar("Item")
Result = TypeVar("Result")
CONNECT_S: Final = 10.0
WORKERS_S: Final = 30.0
"""How long to wait for the first worker."""
M_TRIM_THRESHOLD: Final = -1
M_MMAP_THRESHOLD: Final = -3
"""Of malloc.h."""
KEPT_BYTES: Final = 256 << 20
LARGEST_KEPT_BYTES: Final = 32 << 20
"""Larger blocks are freed at once; glibc takes no more."""
_SAME: Final = f"install mavgate[batch]=={__version__} on every worker"


class WorkError(UserError):
    """Work that cannot be done; the text says why."""


@dataclass(frozen=True, slots=True)
class WorkFailed:
    """Work that came to no result, through no fault of the others."""

    reason: str


class Executor(Protocol):
    """Does a work on many items, in any order."""

    def run(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | WorkFailed]]:
        """Yield the number of each item and its result, as it is done.

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
    """Work the queue off until a process dies; return the items that were in work then."""
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
    """Describe the error of an item."""
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


class ClusterError(UserError):
    """A cluster that cannot be used; the text says why."""


class DaskCluster:
    """Workers of a Dask cluster.

    Raises ClusterError if there is none, it has no worker, or its workers run another version
    of mavgate.
    """

    def __init__(self, address: str) -> None:
        self._distributed: Any = import_module("distributed")
        try:
            self._client = self._distributed.Client(
                address, timeout=CONNECT_S, set_as_default=False
            )
        except (OSError, ValueError, TimeoutError) as error:
            raise ClusterError(
                f"{address}: no Dask scheduler answers ({error}); start one: `dask scheduler`"
            ) from error
        try:
            self._client.wait_for_workers(1, timeout=WORKERS_S)
            self._check_versions()
        except TimeoutError as error:
            self.close()
            raise ClusterError(
                f"{address}: has no worker; start some: `dask worker {address} --nthreads 1`"
            ) from error
        except ClusterError:
            self.close()
            raise

    def close(self) -> None:
        """Leave the cluster; its unfinished work for this client is cancelled."""
        self._client.close()

    def run(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | WorkFailed]]:
        """See `Executor`: a worker that dies is made up for by the others."""
        done = self._distributed.as_completed(loop=self._client.loop)
        numbers: dict[Any, int] = {}
        waiting = iter(range(len(items)))

        def hand_out() -> None:
            number = next(waiting, None)
            if number is not None:
                future = self._client.submit(work, items[number], pure=False)
                numbers[future] = number
                done.add(future)

        for _ in range(WAITING * max(sum(self._client.nthreads().values()), 1)):
            hand_out()
        for future in done:
            number = numbers.pop(future)
            error = future.exception()
            outcome = self._failure_of(error) if error is not None else future.result()
            future.release()
            hand_out()
            yield number, outcome

    def _failure_of(self, error: BaseException) -> WorkFailed:
        if isinstance(error, self._distributed.KilledWorker):
            return WorkFailed("every worker that took it died: out of memory, or killed")
        if isinstance(error, asyncio.CancelledError):
            return WorkFailed("it was given up, or its data was lost with a worker")
        return failure_of(error)

    def _check_versions(self) -> None:
        try:
            versions = self._client.run(prepare_worker)
        except (ImportError, ModuleNotFoundError) as error:
            raise ClusterError(f"a worker cannot do the work: {error}; {_SAME}") from error
        other = {name: version for name, version in versions.items() if version != __version__}
        if other:
            listed = ", ".join(f"{name} has {version}" for name, version in sorted(other.items()))
            raise ClusterError(f"here is mavgate {__version__}, but {listed}; {_SAME}")


def prepare_worker() -> str:
    """Let a worker load its extensions, and return its version."""
    load_extensions()
    _keep_freed_memory()
    return __version__


def _keep_freed_memory() -> None:
    """Have the C library keep freed memory, up to `KEPT_BYTES`, for the next flight.

    Dask's nanny sets MALLOC_TRIM_THRESHOLD_ to 64 KiB, so that every large array costs new pages:
    a third of the time that a flight takes.
    """
    # Only glibc has it.
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
