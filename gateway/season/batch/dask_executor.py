"""The executor of many machines: a Dask cluster, reached by its scheduler's address."""

import asyncio
import ctypes
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from gateway import __version__
from gateway.extensions import load_extensions
from gateway.season.executors import WAITING, Item, Result, WorkFailed, failure_of

CONNECT_S: Final = 10.0
WORKERS_S: Final = 30.0
"""How long to wait for the first worker."""
M_TRIM_THRESHOLD: Final = -1
M_MMAP_THRESHOLD: Final = -3
"""Of malloc.h."""
KEPT_BYTES: Final = 256 << 20
LARGEST_KEPT_BYTES: Final = 32 << 20
"""Larger blocks are freed at once; glibc takes no more."""


class ClusterError(Exception):
    """A cluster that cannot be used; the text says why."""


def has_dask() -> bool:
    """Return whether a cluster can be reached from here."""
    return find_spec("distributed") is not None


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
        """Leave the cluster; what it still does for this client is given up."""
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


_SAME: Final = f"install mavgate[batch]=={__version__} on every worker"


def prepare_worker() -> str:
    """Let a worker load its extensions, and return its version."""
    load_extensions()
    _keep_freed_memory()
    return __version__


def _keep_freed_memory() -> None:
    """Have the C library keep what is freed, up to `KEPT_BYTES`, for the next flight.

    Dask's nanny sets MALLOC_TRIM_THRESHOLD_ to 64 KiB, so that every large array costs new pages:
    a third of the time that a flight takes.
    """
    # Only glibc has it.
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
