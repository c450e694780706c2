"""Faults of the operating system."""

import asyncio
import errno
import os
import threading
from collections.abc import Callable
from typing import NoReturn

FAR_S = 60.0
"""Timeout of waiting for a sync, s."""


def refusing(number: int) -> Callable[..., NoReturn]:
    """Return a system call that fails with an error number."""

    def refuse(*_: object, **__: object) -> NoReturn:
        raise OSError(number, os.strerror(number))

    return refuse


class SlowDisk:
    """Syncs of files and folders, which end only when the test allows it."""

    def __init__(self) -> None:
        self.begun = threading.Semaphore(0)
        self.may_end = threading.Event()
        self.failures = 0
        """Number of the next syncs that fail."""
        self.syncing = self.most = self.count = 0

    def sync(self, file: int) -> None:
        self.syncing += 1
        self.count += 1
        self.most = max(self.most, self.syncing)
        self.begun.release()
        self.may_end.wait(FAR_S)
        os.fstat(file)
        self.syncing -= 1
        if self.failures:
            self.failures -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    async def await_sync(self) -> None:
        assert await asyncio.to_thread(self.begun.acquire, timeout=FAR_S)
