"""The status of one aircraft besides its navigation state, read from its stages."""

import math

from gateway.aircraft import Aircraft
from gateway.status import AircraftStatus, Way
from gateway.vehicle.plan import Location, distance_and_bearing


def status_of(aircraft: Aircraft) -> AircraftStatus:
    """Return the present status of an aircraft."""
    vehicle, state = aircraft.vehicle, aircraft.state
    home, here = vehicle.telemetry.home, None
    if state is not None and math.isfinite(state.lat_deg + state.lon_deg):
        here = Location(state.lat_deg, state.lon_deg, state.alt_amsl_m)
    return AircraftStatus(
        aircraft.vehicle_id,
        vehicle.telemetry.fix,
        _way(here, None if home is None else home.location),
        _way(here, vehicle.plan.mark.location),
        vehicle.health.boards.statuses,
    )


def _way(here: Location | None, there: Location | None) -> Way | None:
    if there is None:
        return None
    location = (there.lat_deg, there.lon_deg, there.alt_amsl_m)
    if here is None:
        return Way(*location, None, None)
    distance_m, bearing_rad = distance_and_bearing(here, there)
    return Way(*location, distance_m, math.degrees(bearing_rad) % 360.0)
