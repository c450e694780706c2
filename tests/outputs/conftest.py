"""A hub with an output on the manual clock."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any

import pytest

from gateway.hub.stats import ClientStats
from gateway.outputs import extend
from gateway.outputs.output import Output
from tests.hub.web.conftest import certificate
from tests.kit.hub import Rig, Station
from tests.kit.mavlink import Sender

__all__ = ["certificate"]

UNIX_US = 1_717_243_384_560_000
"""2024-06-01 12:03:04.56 UTC."""


class OutputRig(Rig):
    """An output of a hub; `hear` sends messages of a vehicle through the hub."""

    target: Station
    """Of an output by UDP."""

    async def output(self, url: str) -> Any:
        self.of_hub = self.hub(url)
        (found,) = self.of_hub._clients.values()
        assert isinstance(found, Output)
        self._output = found
        found.unix_us = lambda: UNIX_US + self.clock()
        # It is turned by hand.
        assert found._timer
        found._timer.cancel()
        await self.until(lambda: self.shown.state not in ("connecting", "resolving"))
        return found

    async def udp(self, kind: str, options: str = "") -> Any:
        """Return an output of a kind, to a station of ours."""
        self.target = self.station()
        return await self.output(f"{kind}:udp:127.0.0.1:{self.target.port}{options}")

    @property
    def shown(self) -> ClientStats:
        (shown,) = self.of_hub.clients()
        return shown

    def hear(self, *messages: Any, system: int = 1, component: int = 1) -> None:
        """Send messages of a vehicle to all clients of the hub."""
        sender = Sender(system, component)
        self.publish(self.of_hub, *map(sender.pack, messages))

    def turn(self) -> None:
        """Let the output send what is due now."""
        now_us = self.clock()
        for data in self._output.compose(now_us):
            self._output.put(data)

    async def sent(self) -> bytes:
        """Return the next datagram of an output's turn."""
        self.turn()
        return await self.target.receive()

    async def sends_nothing(self) -> bool:
        self.turn()
        await self.quiet()
        return self.target.is_empty()


async def connected(port: int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to a program that has just been started."""
    while True:
        with suppress(ConnectionRefusedError):
            return await asyncio.open_connection("127.0.0.1", port)
        await asyncio.sleep(0.01)


@pytest.fixture
async def outputs() -> AsyncIterator[OutputRig]:
    extend()
    rig = OutputRig()
    yield rig
    rig.close()
    # Transports close in the next turns of the loop.
    for _ in range(5):
        await asyncio.sleep(0)
