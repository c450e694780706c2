"""The event loop of a running gateway."""

import asyncio
import gc
import signal
from typing import Any

from gateway.cli.live.run import serve


class Daemon:
    """Loads something as it starts, and ends at its first turn."""

    def __init__(self) -> None:
        self.is_collected: bool | None = None

    def start(self) -> None:
        self._loaded = [[] for _ in range(10)]
        asyncio.get_running_loop().call_soon(self._look)

    def _look(self) -> None:
        self.is_collected = any(found is self._loaded for found in gc.get_objects())
        signal.raise_signal(signal.SIGTERM)

    def close(self) -> None:
        """Nothing is open."""


async def test_what_the_start_loads_is_left_to_no_collection() -> None:
    daemon: Any = Daemon()
    await serve(lambda: daemon, plain=True)
    assert daemon.is_collected is False
