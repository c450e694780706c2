"""Threads that wait for Zenoh, so that neither the event loop nor the end of the process does.

On a link that stalls Zenoh waits 5 s before it gives a message up and 10 s before it gives a
session up, and as long as it does Python cannot end in order: it would wait for the thread, or
abort when the thread comes back. So whatever may wait runs here, and who ends the process asks
first whether all of it is over.
"""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

MAX_CALLS: Final = 64
"""At a time: sessions that open or end, and a query for each recording that is being fetched."""
GOOD_BYE_S: Final = 3.0
"""Ten times what ending takes over a link that works."""

Result = TypeVar("Result")

_calls: Final = ThreadPoolExecutor(MAX_CALLS, "zenoh")


def off_loop(work: Callable[..., Result], *args: object) -> "asyncio.Future[Result]":
    """Call something that waits for Zenoh; unlike the loop's own threads, its end is bounded."""
    return asyncio.get_running_loop().run_in_executor(_calls, work, *args)


def end_calls() -> bool:
    """Let what runs end, take nothing more, and return whether nothing waits any longer."""
    ending = threading.Thread(target=_calls.shutdown, daemon=True)
    ending.start()
    ending.join(GOOD_BYE_S)
    return not ending.is_alive()
