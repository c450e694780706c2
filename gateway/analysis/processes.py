"""Processes that begin as copies of this one, with all that it has computed and compiled."""

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
    """Open a pool of copies.

    Parameters
    ----------
    count : int
        How many.
    begin : callable
        Called first in each of them.
    *arguments : object
        For it; in a forked process they need not be picklable.

    Yields
    ------
    Pool
        Open it before a thread is started, such as that of a progress bar.
    """
    with warnings.catch_warnings():
        # The threads that Python warns of are those of the linear algebra; they are idle here.
        warnings.simplefilter("ignore", DeprecationWarning)
        pool = multiprocessing.get_context(START).Pool(count, begin, arguments)
    with pool:
        yield pool
