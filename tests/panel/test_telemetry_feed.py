"""A browser that does not keep up gets fewer states, and never old ones."""

import asyncio
import inspect
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any, cast

from fastapi import FastAPI
from fastapi.routing import APIRoute
from starlette.websockets import WebSocket

from gateway.clock import GatewayClock
from gateway.panel.map_tiles import MapTiles
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.recording_transfer import add_recording_files
from gateway.panel.rest_api import RestApi
from gateway.panel.state.fleet import FleetState
from gateway.panel.telemetry_feed import GRANTS, MAX_HISTORY, TelemetryFeed, add_tracks
from tests.kit.process import START_LIMIT_S, until
from tests.panel.messages import position
from tests.panel.web_client import client_of


class Browser:
    """The WebSocket of a page."""

    def __init__(self) -> None:
        self.frames: list[dict[str, Any]] = []
        self.grants: asyncio.Queue[str | None] = asyncio.Queue()
        self.query_params: dict[str, str] = {}

    async def accept(self) -> None:
        pass

    async def receive(self) -> dict[str, Any]:
        grant = await self.grants.get()
        if grant is None:
            return {"type": "websocket.disconnect"}
        return {"type": "websocket.receive", "text": grant}

    async def send_text(self, text: str) -> None:
        self.frames.append(json.loads(text))

    async def until(self, count: int) -> None:
        await until(lambda: len(self.frames) >= count)


@asynccontextmanager
async def served() -> AsyncIterator[tuple[FleetState, Browser]]:
    fleet, browser = FleetState(), Browser()
    feed = TelemetryFeed(fleet, GatewayClock())
    serving = asyncio.create_task(feed.serve(cast(WebSocket, browser)))
    yield fleet, browser
    await browser.grants.put(None)
    await asyncio.wait_for(serving, START_LIMIT_S)


async def test_slow_browser_gets_only_the_newest_state() -> None:
    async with served() as (fleet, browser):
        fleet.update(position(10.0, 20.0), 0)
        await browser.until(GRANTS)
        for step in range(200):
            fleet.update(position(10.0 + step / 1000, 20.0), step)
            await asyncio.sleep(0)
        assert len(browser.frames) == GRANTS
        await browser.grants.put("1")
        await browser.until(GRANTS + 1)
        assert browser.frames[-1]["vehicles"]["1"]["lat_deg"] == 10.199


async def test_unused_grants_do_not_accumulate() -> None:
    async with served() as (fleet, browser):
        await browser.until(GRANTS)
        for _ in range(50):
            await browser.grants.put("1")
        while not browser.grants.empty():
            await asyncio.sleep(0)
        await browser.until(2 * GRANTS)
        before = len(browser.frames)
        for step in range(50):
            fleet.update(position(10.0 + step / 1000, 20.0), step)
            await asyncio.sleep(0)
        assert len(browser.frames) <= before + GRANTS


async def test_history_and_path_are_served_in_flight() -> None:
    fleet = FleetState()
    async with client_of(lambda app: add_tracks(app, fleet)) as client:
        assert (await client.get("/history/1")).status_code == 404
        for n in range(2 * MAX_HISTORY):
            fleet.update(position(47.0 + n * 1e-6, 8.0), n * 250_000)
        history = (await client.get("/history/1")).json()
        path = (await client.get("/path/1")).json()
    assert MAX_HISTORY // 2 < len(history["time_us"]) <= MAX_HISTORY
    assert {len(column) for column in history.values()} == {len(history["time_us"])}
    assert history["q_nb.0"][0] is None
    assert len(path["track"]) == 2 * MAX_HISTORY
    assert path["track"][3] == [47.0 + 3e-6, 8.0, 100.0, 750_000]


def test_every_endpoint_runs_on_the_event_loop() -> None:
    """One in a thread would read what the loop changes meanwhile."""
    app = FastAPI()
    fleet = FleetState()
    parts: Any = SimpleNamespace(recordings_folder=None)
    add_tracks(app, fleet)
    add_recording_files(app, parts)
    MapTiles(PanelSettings(map_styles=())).serve(app)
    uplink: Any = SimpleNamespace(listen=lambda _: None)
    routes = [*app.routes, *(r for router in RestApi(uplink).routers() for r in router.routes)]
    endpoints = [route.endpoint for route in routes if isinstance(route, APIRoute)]
    assert len(endpoints) > 8
    assert all(map(inspect.iscoroutinefunction, endpoints))
