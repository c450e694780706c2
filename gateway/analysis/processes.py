"""Forked processes, which share all data that this process has computed."""

import gc
import multiprocessing
import os
import select
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, Final, TypeVar

START: Final = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"

Item = TypeVar("Item")
Result = TypeVar("Result")

_work: Callable[[Any], Any]
"""The function that a process of `forked` runs."""


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def forked(
    work: Callable[[Item], Result], jobs: int | None = None
) -> Iterator[Callable[[Sequence[Item]], Iterator[tuple[int, Result]]]]:
    """Open processes for work on items; yields the function that returns numbered results.

    The results are in any order. The processes share all data that the function refers to.
    """
    count = jobs or cores()
    if count == 1:
        yield lambda items: enumerate(map(work, items))
        return
    with no_warning_of_threads():
        pool = multiprocessing.get_context(START).Pool(count, _begin, (_set_work, work))

    def run(items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        # Large chunks need few messages, small ones balance the load.
        chunk = max(1, min(8, len(items) // (16 * count)))
        return pool.imap_unordered(_do, enumerate(items), chunk)

    with pool:
        yield run


def _set_work(work: Callable[[Any], Any]) -> None:
    global _work
    _work = work


def _do(numbered: tuple[int, Any]) -> tuple[int, Any]:
    number, item = numbered
    return number, _work(item)


def begin_copy(work: Callable[[Any, Connection], None], argument: Any) -> Connection:
    """Run a function in a background process; return the connection for its results."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.Process(
        target=_begin, args=(_send, work, argument, sender, receiver), daemon=True
    )
    with no_warning_of_threads():
        process.start()
    # Closed here, so that the pipe ends when the process does.
    sender.close()
    return receiver


def _send(
    work: Callable[[Any, Connection], None], argument: Any, sender: Connection, receiver: Connection
) -> None:
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


def _begin(work: Callable[..., None], *arguments: Any) -> None:
    keep_inherited()
    work(*arguments)


def keep_inherited() -> None:
    """Exclude objects of the parent process from garbage collection, in a forked process.

    Destructors may wait for the parent's threads, as that of a Zenoh session does, and these do not
    exist in a forked process.
    """
    gc.freeze()


@contextmanager
def no_warning_of_threads() -> Iterator[None]:
    """Suppress Python's warning about forking with threads: the linear algebra threads are idle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
