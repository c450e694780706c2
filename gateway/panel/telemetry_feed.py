"""The page's telemetry: the newest `Instant` of every aircraft, and the path of each so far.

The first comes over a separate WebSocket. Flow control by credits: the browser grants frames, and
each one uses a grant. So a slow browser or network gets fewer frames but never old ones, and
nothing queues up here.
"""

import asyncio
from contextlib import suppress
from typing import Final

import msgspec
from fastapi import FastAPI
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from gateway.clock import GatewayClock
from gateway.panel.access import WS_POLICY_VIOLATION
from gateway.panel.state.fleet_picture import FleetPicture
from gateway.panel.state.vehicle_picture import PathPoint

PATH: Final = "/telemetry"
TRACKS_PATH: Final = "/path/{system_id}"
INTERVAL_S: Final = 0.033
"""Up to 30 frames a second, a little more than sources send: at the same rate the two would beat,
and a state could wait a whole interval. The browser interpolates."""
IDLE_S: Final = 0.5
"""Interval of frames without new data, so that ages are updated."""
GRANT: Final = "1"
GRANTS: Final = 2
"""Frames that may be in transit at once."""


class TelemetryFeed:
    """Serve all open pages.

    Parameters
    ----------
    fleet : FleetPicture
        The aircraft.
    clock : GatewayClock
        The panel's clock.
    """

    def __init__(self, fleet: FleetPicture, clock: GatewayClock) -> None:
        self._fleet = fleet
        self._clock = clock
        self._made = (-1, -1, b"")

    async def serve(self, socket: WebSocket) -> None:
        """Serve one browser until it leaves."""
        await socket.accept()
        grants = asyncio.Semaphore(GRANTS)
        sending = asyncio.create_task(self._send(socket, grants))
        with suppress(WebSocketDisconnect, asyncio.CancelledError):
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                if message.get("text") != GRANT:
                    await socket.close(WS_POLICY_VIOLATION, "only grants may be sent")
                    break
                if grants._value < GRANTS:  # noqa: SLF001 -- a browser may not save up
                    grants.release()
        sending.cancel()

    async def _send(self, socket: WebSocket, grants: asyncio.Semaphore) -> None:
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
                    await socket.send_text(self._frame().decode())
                    await asyncio.sleep(INTERVAL_S)
        finally:
            leave()

    def _frame(self) -> bytes:
        """Encode the present state, once for all browsers."""
        now_us = self._clock()
        version, made_us, frame = self._made
        if version != self._fleet.version or now_us - made_us > INTERVAL_S * 1e6:
            instants = {
                str(system_id): vehicle.instant(now_us)
                for system_id, vehicle in self._fleet.vehicles.items()
            }
            frame = msgspec.json.encode({"time_us": now_us, "vehicles": instants})
            self._made = (self._fleet.version, now_us, frame)
        return frame


def add_tracks(app: FastAPI, fleet: FleetPicture) -> None:
    """Serve `/path/1`: `track` and `fixes` as lists of latitude, longitude, height AMSL.

    The endpoint is a coroutine: it must run on the loop, which changes the paths.
    """

    @app.get(TRACKS_PATH)
    async def _track(system_id: int) -> Response:
        vehicle = fleet.vehicles.get(system_id)
        if vehicle is None:
            return Response(status_code=404)
        paths = {"track": vehicle.track, "fixes": vehicle.fixes}
        plain = {name: [_plain(point) for point in points] for name, points in paths.items()}
        return Response(msgspec.json.encode(plain), media_type="application/json")


def _plain(point: PathPoint) -> tuple[float, float, float]:
    return (point.lat_deg, point.lon_deg, point.alt_amsl_m)
