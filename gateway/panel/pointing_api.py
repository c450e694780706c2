"""REST: antenna pointing to a live vehicle, from home, a location or another system."""

import dataclasses
from collections.abc import Callable
from http import HTTPStatus

from fastapi import APIRouter, HTTPException

from gateway.panel.state.fleet import FleetState
from gateway.vehicle_state.antenna import HOME, pointing_of, station_from


def pointing_router(fleet: FleetState, now_us: Callable[[], int]) -> APIRouter:
    """Return the router with `/v1/pointing/{system_id}`."""
    router = APIRouter(tags=["antenna"])

    @router.get("/v1/pointing/{system_id}")
    async def pointing(system_id: int, station: str = HOME) -> dict[str, float]:
        """Return azimuth, elevation and distance; `station` is as in `rotator:` endpoints."""
        states = {key: vehicle.state for key, vehicle in fleet.visible("").items()}
        if system_id not in states:
            raise HTTPException(HTTPStatus.NOT_FOUND, f"no vehicle {system_id}")
        try:
            antenna = station_from(station)
        except ValueError as error:
            raise HTTPException(HTTPStatus.BAD_REQUEST, str(error)) from None
        found = pointing_of(antenna, states[system_id], states, now_us())
        if found is None:
            reason = "the vehicle or the station has no valid position, or they are too near"
            raise HTTPException(HTTPStatus.CONFLICT, reason)
        return dataclasses.asdict(found)

    return router
