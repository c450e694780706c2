"""Forked processes, which share all that this one has computed and compiled."""

import gc
import multiprocessing
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.pool import Pool
from typing import Any, Final

START: Final = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def copies(count: int, begin: Callable[..., None], *arguments: Any) -> Iterator[Pool]:
    """Open a pool of forked processes.

    Parameters
    ----------
    count : int
        Number of processes.
    begin : callable
        Called first in each of them.
    *arguments : object
        For it; in a forked process they need not be picklable.

    Yields
    ------
    Pool
        Open it before a thread is started, such as that of a progress bar.
    """
    with no_warning_of_threads():
        pool = multiprocessing.get_context(START).Pool(count, _begin, (begin, *arguments))
    with pool:
        yield pool


def begin_copy(work: Callable[[Any], None], argument: Any) -> None:
    """Call a function in a background process, which ends with this one at the latest."""
    process = multiprocessing.Process(target=_begin, args=(work, argument), daemon=True)
    with no_warning_of_threads():
        process.start()


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
    """Silence Python's warning about forking with threads: those of linear algebra are idle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
