"""A child process that ends with its parent, however that ends: by the end of a pipe between them.

The parent gives it a pipe as standard input and keeps the other end open. The kernel closes that
end even if the parent is killed.
"""

import asyncio
import os
import sys
from collections.abc import Callable
from typing import Final

READ_BYTES: Final = 1024
"""Nothing is meant to come; what comes is ignored."""


def on_parent_gone(end: Callable[[], None]) -> None:
    """Call back on the running event loop when standard input ends.

    Parameters
    ----------
    end : callable
        Called once.
    """
    loop, source = asyncio.get_running_loop(), sys.stdin.fileno()

    def read() -> None:
        if not os.read(source, READ_BYTES):
            loop.remove_reader(source)
            end()

    loop.add_reader(source, read)
