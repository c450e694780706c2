"""The marked location: distance and bearing to it, in NAV_CONTROLLER_OUTPUT.

The newest mark wins, whoever set it: the current item of an uploaded mission, the first rally
point, a region of interest, a home set by hand, or the command line.
"""

from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import NAN, NavState
from gateway.vehicle.client_place import is_on_earth
from gateway.vehicle.home import Place, distance_and_bearing
from gateway.vehicle.services.missions.mission_items import Item
from gateway.vehicle.telemetry import fields


class Mark:
    """The marked location of one vehicle."""

    def __init__(self) -> None:
        self.place: Place | None = None
        self.of: int | None = None
        """Kind of the stored items that it follows; None if it was put by itself."""

    def put(self, place: Place | None) -> None:
        """Mark a place, or none.

        Raises
        ------
        ValueError
            If it is no place on earth; its height may be NaN.
        """
        if place is not None and not is_on_earth(place.lat_deg, place.lon_deg):
            raise ValueError(f"no place on earth: {place.lat_deg}, {place.lon_deg}")
        self.place, self.of = place, None

    def follow(self, kind: int, items: tuple[Item, ...], home_alt_m: float) -> None:
        """Mark the first place among stored items; without one, clear a mark that they had set.

        Parameters
        ----------
        kind : int
            MAV_MISSION_TYPE of the items.
        items : tuple of Item
            From the current one on.
        home_alt_m : float
            Height of home above mean sea level, NaN while there is none.
        """
        places = (item.place(home_alt_m) for item in items)
        place = next((place for place in places if place is not None), None)
        if place is not None:
            self.place, self.of = place, kind
        elif self.of == kind:
            self.put(None)

    def way(self, state: NavState) -> tuple[float, float] | None:
        """Measure distance and bearing from the vehicle to the mark.

        Parameters
        ----------
        state : NavState
            Where the vehicle is.

        Returns
        -------
        tuple of 2 floats, or None
            Distance along the ellipsoid in metres and bearing at the vehicle in rad from north;
            None without a mark or a position.
        """
        if self.place is None or not is_on_earth(state.lat_deg, state.lon_deg):
            return None
        here = Place(state.lat_deg, state.lon_deg, state.alt_amsl_m)
        return distance_and_bearing(here, self.place)

    def nav_controller_output(self, state: NavState | None) -> Any:
        """Encode distance and bearing to the mark; None without a mark or a position.

        The desired heading is the bearing; bearings are -180 to 180, as autopilots send them.
        Desired roll and pitch and the crosstrack do not exist here and are NaN. The airspeed error
        is 0, since none is desired; clients print it as an integer, so NaN would fail.
        """
        way = None if state is None else self.way(state)
        if state is None or self.place is None or way is None:
            return None
        distance_m, bearing_rad = way
        bearing_deg = (fields.compass_deg(bearing_rad) + 180) % 360 - 180
        return mavlink.MAVLink_nav_controller_output_message(
            nav_roll=NAN,
            nav_pitch=NAN,
            nav_bearing=bearing_deg,
            target_bearing=bearing_deg,
            wp_dist=fields.uint16(distance_m, unknown=0),
            alt_error=self.place.alt_amsl_m - state.alt_amsl_m,
            aspd_error=0.0,
            xtrack_error=NAN,
        )
