"""Forked processes, which share all that this one has computed."""

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
"""The work of a process of `forked`."""


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def forked(
    work: Callable[[Item], Result], jobs: int | None = None
) -> Iterator[Callable[[Sequence[Item]], Iterator[tuple[int, Result]]]]:
    """Open processes that work on items; yields the function that numbers their results.

    The results come in any order. The processes share all that the work refers to.
    """
    count = jobs or cores()
    if count == 1:
        yield lambda items: enumerate(map(work, items))
        return
    with no_warning_of_threads():
        pool = multiprocessing.get_context(START).Pool(count, _begin, (_set_work, work))

    def run(items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        # Few messages, and an even load.
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
    """Call a function in a background process, which sends its results."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.Process(
        target=_begin, args=(_send, work, argument, sender, receiver), daemon=True
    )
    with no_warning_of_threads():
        process.start()
    # So that the pipe ends with that process.
    sender.close()
    return receiver


def _send(
    work: Callable[[Any, Connection], None], argument: Any, sender: Connection, receiver: Connection
) -> None:
    # So that the pipe reports when no process receives.
    receiver.close()
    threading.Thread(target=_end_without_receiver, args=(sender,), daemon=True).start()
    with suppress(BrokenPipeError):
        work(argument, sender)


def _end_without_receiver(sender: Connection) -> None:
    """End this process when the pipe has no receiver, even if nothing is being sent."""
    hang_up = select.poll()
    hang_up.register(sender, 0)  # no event but that one
    hang_up.poll()
    os._exit(0)


def _begin(work: Callable[..., None], *arguments: Any) -> None:
    keep_inherited()
    work(*arguments)


def keep_inherited() -> None:
    """Exclude objects of the parent process from garbage collection, in a forked process.

    Destructors may wait for the parent's threads, as that of a Zenoh session does, and a forked
    process has none of them.
    """
    gc.freeze()


@contextmanager
def no_warning_of_threads() -> Iterator[None]:
    """Suppress Python's warning about forking with threads: those of linear algebra are idle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
