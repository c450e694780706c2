"""Forked processes, which share all that this one has computed."""

import gc
import multiprocessing
import os
import select
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.pool import Pool
from typing import Any, Final

START: Final = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def copies(count: int, begin: Callable[..., None], *arguments: Any) -> Iterator[Pool]:
    """Open a pool of forked processes."""
    with no_warning_of_threads():
        pool = multiprocessing.get_context(START).Pool(count, _begin, (begin, *arguments))
    with pool:
        yield pool


def begin_copy(work: Callable[[Any, Connection], None], argument: Any) -> Connection:
    """Call a function in a background process, which sends what it makes."""
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
    work: Callable[[Any, Connection], None],
    argument: Any,
    sender: Connection,
    receiver: Connection,
) -> None:
    # So that the pipe reports when no process receives.
    receiver.close()
    threading.Thread(target=_end_unheard, args=(sender,), daemon=True).start()
    with suppress(BrokenPipeError):
        work(argument, sender)


def _end_unheard(sender: Connection) -> None:
    """End this process when nobody can receive any more; it may be long before it sends."""
    heard = select.poll()
    heard.register(sender, 0)  # no event but that one
    heard.poll()
    os._exit(0)


def _begin(work: Callable[..., None], *arguments: Any) -> None:
    keep_inherited()
    work(*arguments)


def keep_inherited() -> None:
    """Never collect what the parent process has left; for the beginning of a forked process.

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
