"""The pool of processes for work on many items, and copies of this process.

Processes are forked where possible, and then share all data that this process has computed. They
exclude its objects from garbage collection: destructors may wait for threads of this process, as
that of a Zenoh session does, and these do not exist in a forked one.
"""

import gc
import multiprocessing
import os
import select
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from typing import Any, Final, TypeVar

START: Final = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
LOOK_S: Final = 1.0
"""Interval of checking whether the parent process is alive, s."""

Item = TypeVar("Item")
Result = TypeVar("Result")

_work: Callable[[Any], Any]
"""The function that a process of the pool runs."""


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def pool_of(work: Callable[[Any], Any], jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Open processes that run a function, as `do`; they end with this process."""
    context = multiprocessing.get_context(START)
    stop = context.Event()
    with _no_warning_of_threads():
        pool = ProcessPoolExecutor(jobs, context, _begin, (stop, os.getpid(), work))
        # Start all processes now, before the pool starts a thread of its own.
        pool.submit(os.getpid).result()
    try:
        yield pool
    except BaseException:
        stop.set()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def do(item: Any) -> Any:
    """Run the function of a pool on an item, in one of its processes."""
    return _work(item)


def _begin(stop: Event, parent: int, work: Callable[[Any], Any]) -> None:
    """Leave interrupts to the parent, and exit when it does."""
    global _work
    _work = work
    gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            if stop.wait(LOOK_S):
                break
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def forked(
    work: Callable[[Item], Result], jobs: int | None = None
) -> Iterator[Callable[[Sequence[Item]], Iterator[tuple[int, Result]]]]:
    """Open processes for work on items; yields the function that returns numbered results.

    The results are in any order.
    """
    count = jobs or cores()
    if count == 1:
        yield lambda items: enumerate(map(work, items))
        return
    with pool_of(work, count) as pool:

        def run(items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
            futures = {pool.submit(do, item): number for number, item in enumerate(items)}
            return ((futures[future], future.result()) for future in as_completed(futures))

        yield run


def begin_copy(work: Callable[[Any, Connection], None], argument: Any) -> Connection:
    """Run a function in a background process; return the connection for its results."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.Process(
        target=_send, args=(work, argument, sender, receiver), daemon=True
    )
    with _no_warning_of_threads():
        process.start()
    # Closed here, so that the pipe ends when the process does.
    sender.close()
    return receiver


def _send(
    work: Callable[[Any, Connection], None], argument: Any, sender: Connection, receiver: Connection
) -> None:
    gc.freeze()
    # Closed here, so that the pipe reports when the parent no longer receives.
    receiver.close()
    threading.Thread(target=_end_without_receiver, args=(sender,), daemon=True).start()
    with suppress(BrokenPipeError):
        work(argument, sender)


def _end_without_receiver(sender: Connection) -> None:
    """End this process when the pipe has no receiver, even if nothing is being sent."""
    hang_up = select.poll()
    hang_up.register(sender, 0)  # only POLLHUP and POLLERR
    hang_up.poll()
    os._exit(0)


@contextmanager
def _no_warning_of_threads() -> Iterator[None]:
    """Suppress Python's warning about forking with threads: the linear algebra threads are idle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
