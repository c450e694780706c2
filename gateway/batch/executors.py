"""Executors of the work on many recordings: local processes, or a Dask cluster."""

import asyncio
import ctypes
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Protocol

from gateway import __version__
from gateway.analysis.processes import Item, Result, cores, do, pool_of
from gateway.extensions import load_extensions
from gateway.printable import UserError, reason_of

WAITING: Final = 2
"""Items submitted per process: one in work and one waiting, to bound the memory."""
CONNECT_S: Final = 10.0
WORKERS_S: Final = 30.0
M_TRIM_THRESHOLD: Final = -1
M_MMAP_THRESHOLD: Final = -3
"""Option number of mallopt, from malloc.h."""
KEPT_BYTES: Final = 256 << 20
LARGEST_KEPT_BYTES: Final = 32 << 20
"""Blocks larger than this are freed at once; glibc allows no greater value."""
_SAME: Final = f"install mavgate[batch]=={__version__} on every worker"


class WorkError(UserError):
    """Work that cannot be done; the text states the reason."""


@dataclass(frozen=True, slots=True)
class WorkFailed:
    """An item whose work failed without affecting the others."""

    reason: str


Outcomes = Iterator[tuple[int, Result | WorkFailed]]
"""The index of each item, and its result."""


class Executor(Protocol):
    """Runs a function on many items, in any order."""

    def run(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Outcomes[Result]:
        """Yield the index of each item and its result when it is finished.

        An exception fails that item alone. If a process or machine dies, its items are repeated by
        others; an item that kills every process that runs it fails.
        """
        ...


class ThisProcess:
    """Run small tasks in the calling process, since starting others would take longer."""

    def run(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Outcomes[Result]:
        """See `Executor`."""
        for number, item in enumerate(items):
            try:
                yield number, work(item)
            except Exception as error:  # noqa: BLE001 - it fails this item alone
                yield number, failure_of(error)


class LocalProcesses:
    """Processes of this machine; one that dies fails its item only, and is replaced."""

    def __init__(self, jobs: int | None) -> None:
        self._jobs = jobs or cores()

    def run(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Outcomes[Result]:
        """See `Executor`."""
        waiting = deque(range(len(items)))
        suspects: deque[int] = deque()
        while waiting or suspects:
            # After a process died, the items it may have run are repeated one by one.
            queue, jobs = (suspects, 1) if suspects else (waiting, min(self._jobs, len(waiting)))
            lost = yield from _run_in_one_pool(work, items, queue, jobs)
            if jobs == 1 and lost:
                guilty = lost.pop(0)
                yield guilty, WorkFailed("its process died: out of memory, or killed")
            suspects.extend(lost)


def _run_in_one_pool(
    work: Callable[[Item], Result], items: Sequence[Item], queue: deque[int], jobs: int
) -> Any:
    """Process the queue until a process dies; return the items in work at that time."""
    running: dict[Future[Result], int] = {}
    with pool_of(work, jobs) as pool:
        while queue or running:
            try:
                while queue and len(running) < (jobs * WAITING if jobs > 1 else 1):
                    running[pool.submit(do, items[queue[0]])] = queue[0]
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
    """Describe the exception of an item."""
    if isinstance(error, WorkError):
        return WorkFailed(str(error))
    if isinstance(error, OSError) and error.filename:
        return WorkFailed(f"{error.filename}: {error.strerror or reason_of(error)}")
    return WorkFailed(f"{type(error).__name__}: {error}")


class ClusterError(UserError):
    """A cluster that cannot be used; the text states the reason."""


class DaskCluster:
    """Workers of a Dask cluster.

    Raises ClusterError if it cannot be reached, has no worker, or its workers run another version
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
                f"{address}: no Dask scheduler responds ({error}); start one: `dask scheduler`"
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
        """Disconnect; the cluster cancels this client's unfinished work."""
        self._client.close()

    def run(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Outcomes[Result]:
        """See `Executor`; the items of a worker that dies are repeated by others."""
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
            return WorkFailed("it was cancelled, or its data was lost with a worker")
        return failure_of(error)

    def _check_versions(self) -> None:
        try:
            versions = self._client.run(prepare_worker)
        except (ImportError, ModuleNotFoundError) as error:
            raise ClusterError(f"a worker cannot run the task: {error}; {_SAME}") from error
        other = {name: version for name, version in versions.items() if version != __version__}
        if other:
            listed = ", ".join(f"{name} has {version}" for name, version in sorted(other.items()))
            raise ClusterError(f"this is mavgate {__version__}, but {listed}; {_SAME}")


def prepare_worker() -> str:
    """Load the extensions in a worker, and return its version."""
    load_extensions()
    _keep_freed_memory()
    return __version__


def _keep_freed_memory() -> None:
    """Let the C library keep freed memory, up to `KEPT_BYTES`, for the next flight.

    Dask's nanny sets MALLOC_TRIM_THRESHOLD_ to 64 KiB, so every large array needs new pages, which
    costs a third of the time per flight.
    """
    # Only glibc has mallopt.
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
