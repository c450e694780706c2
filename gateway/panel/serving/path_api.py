"""The path of an aircraft so far, for a page that was opened later."""

from typing import Any, Final

import msgspec
from fastapi import FastAPI
from starlette.responses import Response

from gateway.panel.state.fleet_picture import FleetPicture
from gateway.panel.state.vehicle_picture import PathPoint

PATH: Final = "/path/{system_id}"


def add_paths(app: FastAPI, fleet: FleetPicture) -> None:
    """Serve `/path/1`: `track` and `fixes` as lists of latitude, longitude, height AMSL."""

    @app.get(PATH)
    def _path(system_id: int) -> Response:
        vehicle = fleet.vehicles.get(system_id)
        if vehicle is None:
            return Response(status_code=404)
        paths: dict[str, Any] = {
            "track": [_plain(point) for point in vehicle.track],
            "fixes": [_plain(point) for point in vehicle.fixes],
        }
        return Response(msgspec.json.encode(paths), media_type="application/json")


def _plain(point: PathPoint) -> tuple[float, float, float]:
    return (point.lat_deg, point.lon_deg, point.alt_amsl_m)
