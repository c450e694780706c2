"""The page's telemetry: the newest `Instant` of every aircraft, and the path of each so far.

The `Instant` is sent over a separate WebSocket. Flow control is by credits: the browser grants
frames, and each one uses a grant. So a slow browser or network gets fewer frames but never outdated
ones, and no queue builds up here.
"""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import suppress
from http import HTTPStatus
from typing import Any, Final

import msgspec
from fastapi import FastAPI, HTTPException
from starlette.responses import Response, StreamingResponse
from starlette.status import WS_1008_POLICY_VIOLATION
from starlette.websockets import WebSocket, WebSocketDisconnect

from gateway.clock import GatewayClock
from gateway.panel.state.fleet import FleetState
from gateway.panel.state.vehicle import VehicleState

PATH: Final = "/telemetry"
TRACKS_PATH: Final = "/path/{system_id}"
HISTORY_PATH: Final = "/history/{system_id}"
MAX_HISTORY: Final = 6000
"""Maximum moments of a history that is sent to a browser; of a longer one every n-th is sent."""
INTERVAL_S: Final = 0.033
"""Least interval of frames: 30 a second, a little more than sources send. At the same rate the two
would beat, and a state could wait a whole interval. The browser interpolates."""
IDLE_S: Final = 0.5
"""Interval of frames without new data, so that ages are updated."""
GRANT: Final = "1"
GRANTS: Final = 2
"""Frames that may be in transit at once."""


class TelemetryFeed:
    """Serve all open pages."""

    def __init__(self, fleet: FleetState, clock: GatewayClock) -> None:
        self._fleet = fleet
        self._clock = clock
        self._made = (-1, -1, b"")

    async def serve(self, socket: WebSocket) -> None:
        """Serve one browser until it leaves."""
        await socket.accept()
        grants = asyncio.Semaphore(GRANTS)
        page = socket.query_params.get("page", "")
        sending = asyncio.create_task(self._send(socket, grants, page))
        with suppress(WebSocketDisconnect, asyncio.CancelledError):
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                if message.get("text") != GRANT:
                    await socket.close(WS_1008_POLICY_VIOLATION, "only grants may be sent")
                    break
                if grants._value < GRANTS:  # noqa: SLF001 -- a browser may not save up
                    grants.release()
        sending.cancel()

    async def _send(self, socket: WebSocket, grants: asyncio.Semaphore, page: str) -> None:
        news = asyncio.Event()
        leave = self._fleet.listen(lambda *_: news.set())
        try:
            with suppress(WebSocketDisconnect, RuntimeError):
                while True:
                    await grants.acquire()
                    with suppress(TimeoutError):
                        async with asyncio.timeout(IDLE_S):
                            await news.wait()
                    news.clear()
                    await socket.send_text(self._frame(page).decode())
                    await asyncio.sleep(INTERVAL_S)
        finally:
            leave()

    def _frame(self, page: str) -> bytes:
        """Encode the present state, once for all pages that play no recording."""
        now_us = self._clock()
        if any(origin.page == page for origin in self._fleet.origins.values()):
            return self._encoded(now_us, page)
        version, made_us, frame = self._made
        if version != self._fleet.version or now_us - made_us > INTERVAL_S * 1e6:
            frame = self._encoded(now_us, "")
            self._made = (self._fleet.version, now_us, frame)
        return frame

    def _encoded(self, now_us: int, page: str) -> bytes:
        instants = {
            str(system_id): vehicle.instant(now_us)
            for system_id, vehicle in self._fleet.visible(page).items()
        }
        return msgspec.json.encode({"time_us": now_us, "vehicles": instants})


def add_tracks(app: FastAPI, fleet: FleetState) -> None:
    """Serve `/path/1`: `track` and `fixes` as lists of latitude, longitude, height AMSL, and time.

    And `/history/1`: the columns of `FlightHistory`. The endpoints are coroutines, because they
    must run on the loop, which changes the data that they read.
    """

    def vehicle_of(system_id: int) -> VehicleState:
        if (vehicle := fleet.vehicles.get(system_id)) is None:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        return vehicle

    @app.get(TRACKS_PATH)
    async def _track(system_id: int) -> Response:
        vehicle = vehicle_of(system_id)
        fixes = [(at.lat_deg, at.lon_deg, at.alt_amsl_m, at.time_us) for at in vehicle.fixes]
        return _streamed({"track": vehicle.history.track(), "fixes": fixes})

    @app.get(HISTORY_PATH)
    async def _history(system_id: int) -> Response:
        history = vehicle_of(system_id).history
        step = max(1, len(history) // MAX_HISTORY + 1)
        columns: dict[str, Sequence[float]] = {"time_us": [*history.time_us[::step]]}
        columns |= {name: column[::step] for name, column in history.columns.items()}
        return _streamed(columns)


def _streamed(columns: Mapping[str, Sequence[Any]]) -> Response:
    """Answer with a JSON object, column by column, since it may have a megabyte."""

    async def pieces() -> AsyncIterator[bytes]:
        before = b"{"
        for name, column in columns.items():
            plain = [float(f"{x:.9g}") if isinstance(x, float) else x for x in column]
            yield before + msgspec.json.encode(name) + b":" + msgspec.json.encode(plain)
            before = b","
        yield b"}"

    return StreamingResponse(pieces(), media_type="application/json")
