"""Direction of a tracking antenna: azimuth, elevation and distance from a station to a vehicle.

The station is the home of the vehicle, a given position, or another system, such as a GPS receiver
at the antenna. Heights above mean sea level are converted to heights above the ellipsoid with the
geoid separation at the vehicle, if it is reported. Between vehicle and station it changes by a few
centimetres per kilometre, a few thousandths of a degree. The earth's curvature is exact.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from pymap3d import geodetic2aer

from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import Position, named_position

HOME: Final = "home"
SYSTEM: Final = "system:"
LEAST_DISTANCE_M: Final = 2.0
"""Minimum distance, m; below it the position errors exceed the distance and hide the direction."""
MAX_ALT_M: Final = 10_000.0


@dataclass(frozen=True, slots=True)
class Pointing:
    """The direction to a vehicle, seen from the station."""

    azimuth_deg: float
    """Clockwise from true north, in [0, 360)."""
    elevation_deg: float
    """Above the horizontal plane of the station."""
    distance_m: float
    """Along the line of sight."""


@dataclass(frozen=True, slots=True)
class AntennaStation:
    """Location of the antenna: a fixed position, another system, or the home of the vehicle."""

    place: Position | None = None
    system_id: int = 0

    def position(
        self, state: NewestState, states: Mapping[int, NewestState], now_us: int
    ) -> Position | None:
        """Return the position of the antenna for a vehicle; None if it is not known."""
        if self.place is not None:
            return self.place
        if self.system_id:
            other = states.get(self.system_id)
            return None if other is None else other.valid_position(now_us)
        home = state.fields.get("HOME_POSITION")
        return None if home is None else named_position(home)


def station_from(text: str) -> AntennaStation:
    """Read a station: `home`, `system:ID`, or `LATITUDE,LONGITUDE,HEIGHT` above mean sea level.

    Raises ValueError for any other text.
    """
    if text == HOME:
        return AntennaStation()
    number = text.removeprefix(SYSTEM)
    if number != text and number.isascii() and number.isdecimal() and 0 < int(number[:4]) < 250:
        return AntennaStation(system_id=int(number))
    try:
        lat_deg, lon_deg, alt_m = map(float, text.split(","))
    except ValueError:
        lat_deg = lon_deg = alt_m = math.nan
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and abs(alt_m) <= MAX_ALT_M):
        raise ValueError(
            f"station {text!r} is not home, system:ID, or LATITUDE,LONGITUDE,HEIGHT (degrees, m)"
        )
    return AntennaStation(Position(lat_deg, lon_deg, alt_m))


def pointing_of(
    station: AntennaStation, state: NewestState, states: Mapping[int, NewestState], now_us: int
) -> Pointing | None:
    """Return the direction to a vehicle.

    None if a position is not valid, or if both are too close to each other.
    """
    there, here = state.valid_position(now_us), station.position(state, states, now_us)
    if there is None or here is None:
        return None
    report = state.fix()
    raised_m = report.separation_m if report and math.isfinite(report.separation_m) else 0.0
    azimuth_deg, elevation_deg, distance_m = geodetic2aer(
        there.lat_deg,
        there.lon_deg,
        there.alt_amsl_m + raised_m,
        here.lat_deg,
        here.lon_deg,
        here.alt_amsl_m + raised_m,
    )
    # Negated, so that NaN (height not known) returns None as well.
    if not distance_m >= LEAST_DISTANCE_M:
        return None
    return Pointing(float(azimuth_deg) % 360.0, float(elevation_deg), float(distance_m))
