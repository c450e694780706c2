"""A browser that does not keep up gets fewer states, and never old ones."""

import asyncio
import json
from typing import Any, cast

from starlette.websockets import WebSocket

from gateway.clock import GatewayClock
from gateway.panel.state.fleet import FleetState
from gateway.panel.telemetry_feed import GRANTS, TelemetryFeed
from tests.panel.messages import position

LIMIT_S = 60.0


class Browser:
    """What a page is to the feed."""

    def __init__(self) -> None:
        self.frames: list[dict[str, Any]] = []
        self.grants: asyncio.Queue[str | None] = asyncio.Queue()
        self.arrived = asyncio.Event()

    async def accept(self) -> None:
        pass

    async def receive(self) -> dict[str, Any]:
        grant = await self.grants.get()
        if grant is None:
            return {"type": "websocket.disconnect"}
        return {"type": "websocket.receive", "text": grant}

    async def send_text(self, text: str) -> None:
        self.frames.append(json.loads(text))
        self.arrived.set()

    async def until(self, count: int) -> None:
        async with asyncio.timeout(LIMIT_S):
            while len(self.frames) < count:
                self.arrived.clear()
                await self.arrived.wait()


async def test_slow_browser_gets_the_newest_only() -> None:
    fleet, browser = FleetState(), Browser()
    feed = TelemetryFeed(fleet, GatewayClock())
    serving = asyncio.create_task(feed.serve(cast(WebSocket, browser)))
    fleet.take(position(10.0, 20.0), 0)
    await browser.until(GRANTS)
    for step in range(200):
        fleet.take(position(10.0 + step / 1000, 20.0), step)
        await asyncio.sleep(0)
    assert len(browser.frames) == GRANTS
    await browser.grants.put("1")
    await browser.until(GRANTS + 1)
    assert browser.frames[-1]["vehicles"]["1"]["lat_deg"] == 10.199
    await browser.grants.put(None)
    async with asyncio.timeout(LIMIT_S):
        await serving


async def test_page_cannot_save_up_grants() -> None:
    fleet, browser = FleetState(), Browser()
    feed = TelemetryFeed(fleet, GatewayClock())
    serving = asyncio.create_task(feed.serve(cast(WebSocket, browser)))
    await browser.until(GRANTS)
    for _ in range(50):
        await browser.grants.put("1")
    while not browser.grants.empty():
        await asyncio.sleep(0)
    await browser.until(2 * GRANTS)
    before = len(browser.frames)
    for step in range(50):
        fleet.take(position(10.0 + step / 1000, 20.0), step)
        await asyncio.sleep(0)
    assert len(browser.frames) <= before + GRANTS
    await browser.grants.put(None)
    async with asyncio.timeout(LIMIT_S):
        await serving
