"""Where to point an antenna, by REST."""

import httpx
import pytest

from gateway.panel.pointing_api import pointing_router
from gateway.panel.state.fleet import FleetState, Origin
from gateway.units import US_PER_S
from tests.panel.messages import heartbeat, position
from tests.panel.web_client import client_of


async def get(fleet: FleetState, path: str, now_us: int = US_PER_S) -> httpx.Response:
    router = pointing_router(fleet, lambda: now_us)
    async with client_of(lambda app: app.include_router(router)) as client:
        return await client.get(path)


@pytest.fixture
def fleet() -> FleetState:
    """Return vehicle 1 in the east of vehicle 2, and a played vehicle 3."""
    made = FleetState()
    made.origins[3] = Origin("recorded", 1)
    for system_id, lon_deg in ((1, 8.01), (2, 8.0), (3, 8.0)):
        made.update(heartbeat(system_id=system_id), US_PER_S)
        made.update(position(0.0, lon_deg, system_id=system_id), US_PER_S)
    return made


@pytest.mark.parametrize("station", ["0,8,100", "system:2"])
async def test_direction_is_returned(fleet: FleetState, station: str) -> None:
    answer = await get(fleet, f"/v1/pointing/1?station={station}")
    assert answer.status_code == 200
    assert answer.json() == {
        "azimuth_deg": pytest.approx(90.0, abs=0.01),
        "elevation_deg": pytest.approx(-0.005, abs=0.001),
        "distance_m": pytest.approx(1113.2, abs=0.1),
    }


@pytest.mark.parametrize(
    ("path", "age_s", "status"),
    [
        ("1", 0, 409),
        ("1?station=0,8.01,100", 0, 409),
        ("1?station=0,8,100", 6, 409),
        ("1?station=here", 0, 400),
        ("9?station=0,8,100", 0, 404),
        ("3?station=0,7,100", 0, 404),
        ("x", 0, 422),
    ],
)
async def test_unknown_direction_is_refused(
    fleet: FleetState, path: str, age_s: int, status: int
) -> None:
    answer = await get(fleet, f"/v1/pointing/{path}", (1 + age_s) * US_PER_S)
    assert answer.status_code == status
    assert answer.json()["detail"]
