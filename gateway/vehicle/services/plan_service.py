"""Home, the marked location, and the plan: set by ground stations, and stored.

The newest mark is valid, from any source: the mission, from its current item on, the first rally
point, a region of interest, a home set by command, or the command line.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import NAN, GpsFix, NavState
from gateway.settings import Settings
from gateway.units import DEGE7_PER_DEG
from gateway.vehicle import encoding
from gateway.vehicle.plan import (
    FENCE,
    GLOBAL_FRAMES,
    KINDS,
    MISSION,
    RALLY,
    Home,
    HomeParameters,
    Item,
    Location,
    StoredPlan,
    distance_and_bearing,
    height_amsl_m,
    is_3d,
    is_on_earth,
    location_of,
)
from gateway.vehicle.requested_messages import whole
from gateway.vehicle.service import INFO, Answer, SavePlan, StatusText
from gateway.vehicle.services.commands import ACCEPTED, DENIED, NOT_NOW, Command, Handler, Outcome
from gateway.vehicle.services.missions import MissionService
from gateway.vehicle.telemetry.messages import has_position
from gateway.vehicle.telemetry.telemetry import Telemetry

NUMBERS: Final = {"lat_deg": "lat_deg", "lon_deg": "lon_deg", "alt_m": "alt_amsl_m"}
"""Parameters of home, and the fields of `Location` that they set."""
Announce = Callable[[StatusText, int], list[Answer]]
ROI_MODES: Final = {
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION: mavlink.MAV_ROI_LOCATION,
    mavlink.MAV_CMD_DO_SET_ROI_NONE: mavlink.MAV_ROI_NONE,
}
"""Modes of the commands that have no parameter for it."""
USE_CURRENT: Final = 1
"""Value of the first parameter of MAV_CMD_DO_SET_HOME: use the current position."""


class Mark:
    """The marked location of one vehicle."""

    def __init__(self, location: Location | None = None, of: int | None = None) -> None:
        self.location = location
        self.of = of
        """Kind of the stored items that it follows; None if it was set on its own."""

    def put(self, location: Location | None) -> None:
        """Mark a location, or clear the mark with None.

        Raises ValueError if its coordinates are out of range; its height may be NaN.
        """
        if location is not None and (fault := location.fault()):
            raise ValueError(fault)
        self.location, self.of = location, None

    def follow(self, kind: int, items: tuple[Item, ...], home_alt_m: float) -> None:
        """Mark the first location among stored items, or clear a mark that they had set."""
        locations = (item.location(home_alt_m) for item in items)
        location = next((location for location in locations if location is not None), None)
        if location is not None:
            self.location, self.of = location, kind
        elif self.of == kind:
            self.put(None)

    def nav_controller_output(self, state: NavState | None) -> Any:
        """Encode distance and bearing to the mark; None without a mark or a position.

        The desired heading is the bearing; bearings are -180 to 180, as autopilots send them.
        Desired roll and pitch and the crosstrack error do not exist here and are NaN. The airspeed
        error is 0, since no airspeed is desired; clients print it as an integer, so NaN would fail.
        """
        mark = self.location
        if state is None or mark is None or not is_on_earth(state.lat_deg, state.lon_deg):
            return None
        here = Location(state.lat_deg, state.lon_deg, state.alt_amsl_m)
        distance_m, bearing_rad = distance_and_bearing(here, mark)
        bearing_deg = (encoding.compass_deg(bearing_rad) + 180) % 360 - 180
        return mavlink.MAVLink_nav_controller_output_message(
            nav_roll=NAN,
            nav_pitch=NAN,
            nav_bearing=bearing_deg,
            target_bearing=bearing_deg,
            wp_dist=encoding.uint16(distance_m, unknown=0),
            alt_error=mark.alt_amsl_m - state.alt_amsl_m,
            aspd_error=0.0,
            xtrack_error=NAN,
        )


class PlanService:
    """Set home and the mark, and store them and the missions over a restart.

    A home that the GPS measured is measured again at every start, which may be at another field;
    one that an operator set is stored: at once if by a command, or with the parameters if by a
    parameter.
    """

    def __init__(
        self, vehicle_id: int, telemetry: Telemetry, announce: Announce, stored: StoredPlan
    ) -> None:
        self._vehicle_id = vehicle_id
        self._telemetry = telemetry
        self._announce = announce
        self.mark = Mark(stored.mark, stored.mark_of)
        self.missions = MissionService(self._on_items, self._explain, self._empty_mission)
        self.missions.items = {kind: getattr(stored, name) for kind, name in KINDS.items()}
        self.missions.current = stored.current
        self._kept_home = stored.home
        self._announces_home = stored.home is not None
        self._entered: set[str] = set()
        """Parameters of home that were set while there was no home."""
        if stored.home is not None:
            telemetry.set_home(Home(stored.home, 0, "operator"))
        telemetry.add(
            mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT,
            lambda *_: self.mark.nav_controller_output(telemetry.state),
        )
        telemetry.add(
            mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, lambda *_: self.missions.mission_current()
        )
        self.commands: dict[int, Handler] = {
            mavlink.MAV_CMD_DO_SET_HOME: self._set_home,
            **dict.fromkeys((mavlink.MAV_CMD_DO_SET_ROI, *ROI_MODES), self._set_roi),
            mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: self._set_mission_current,
        }

    def _empty_mission(self) -> tuple[Item, ...]:
        """Return the mission that is sent while none is stored: for ArduPilot, home as item 0.

        DroneKit requests item 0 of every mission, and waits for it.
        """
        home = self._telemetry.home
        if self._telemetry.autopilot != mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA or home is None:
            return ()
        at = home.location
        x, y = round(at.lat_deg * DEGE7_PER_DEG), round(at.lon_deg * DEGE7_PER_DEG)
        kind = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_NAV_WAYPOINT, 1)
        return (Item(*kind, (0.0, 0.0, 0.0, 0.0), x, y, at.alt_amsl_m),)

    def on_fix(self, fix: GpsFix, now_us: int) -> list[Answer]:
        """Announce once the distance of a stored home, which may be that of another field."""
        home = self._kept_home
        if home is None or not self._announces_home or not is_3d(fix):
            return []
        self._announces_home = False
        distance_m, _ = distance_and_bearing(location_of(fix), home)
        return self._explain(f"Stored home is used, {distance_m:.0f} m from here", now_us)

    def put_mark(self, location: Location | None, now_us: int) -> list[Answer]:
        """Mark a location, or clear the mark with None, and announce it."""
        self.mark.put(location)
        text = "Mark cleared"
        if location is not None:
            text = f"Marked {location.lat_deg:.6f}, {location.lon_deg:.6f}"
        return [self._save(), *self._explain(text, now_us)]

    def home_parameters(self) -> HomeParameters:
        """Return home as parameters."""
        home = self._telemetry.home
        if home is None:
            return HomeParameters()
        numbers = {key: getattr(home.location, part) for key, part in NUMBERS.items()}
        return HomeParameters(source=home.source, **numbers)

    def change(self, settings: Settings, key: str, now_us: int) -> list[Answer]:
        """Apply the change of a parameter of home.

        Raises ValueError if the source is set and there is no such home.
        """
        value: Any = getattr(settings, key)
        if key == "source":
            return self._change_source(value, now_us)
        part, home = NUMBERS[key], self._telemetry.home
        if home is not None:
            if np.float32(value) == np.float32(getattr(home.location, part)):
                # A parameter is less precise than home; a list that is written back must not round
                # it.
                return []
            return self._put_home(replace(home.location, **{part: value}), now_us)
        self._entered.add(key)
        if self._entered < set(NUMBERS):
            return []
        return self._put_home(Location(*(getattr(settings, each) for each in NUMBERS)), now_us)

    def store(self) -> list[Answer]:
        """Store the home that was set by parameters."""
        self._keep_home()
        return [self._save()]

    def _change_source(self, source: str, now_us: int) -> list[Answer]:
        home = self._telemetry.home
        if source == "none":
            self._entered.clear()
            self._telemetry.clear_home()
            return []
        if home is None or (source, home.source) == ("gps", "operator"):
            raise ValueError("there is no such home")
        return [] if source == home.source else self._put_home(home.location, now_us)

    def _put_home(self, location: Location, now_us: int) -> list[Answer]:
        """Set home as the operator's, and send HOME_POSITION."""
        self._entered.clear()
        return [self._telemetry.set_home(Home(location, now_us, "operator"))]

    def _keep_home(self) -> None:
        """Store the present home over a restart if an operator has set it; else store none."""
        home = self._telemetry.home
        self._kept_home = home.location if home and home.source == "operator" else None

    def _save(self) -> SavePlan:
        items = self.missions.items
        stored = StoredPlan(
            home=self._kept_home,
            mark=self.mark.location,
            mark_of=self.mark.of,
            current=self.missions.current,
            mission=items[MISSION],
            fence=items[FENCE],
            rally=items[RALLY],
        )
        return SavePlan(self._vehicle_id, stored)

    @property
    def _home_alt_m(self) -> float:
        return self._telemetry.home.location.alt_amsl_m if self._telemetry.home else NAN

    def _explain(self, text: str, now_us: int) -> list[Answer]:
        return self._announce(StatusText(INFO, text), now_us)

    def _on_items(self, kind: int) -> list[Answer]:
        if kind != FENCE:
            first = self.missions.current if kind == MISSION else 0
            self.mark.follow(kind, self.missions.items[kind][first:], self._home_alt_m)
        return [self._save()]

    def _location(self, command: Command) -> Location | None:
        """Read the position of a command; None if it is invalid."""
        lat_deg, lon_deg, height_m = command.location
        if command.frame not in GLOBAL_FRAMES or not is_on_earth(lat_deg, lon_deg):
            return None
        height_m = height_amsl_m(height_m, command.frame, self._home_alt_m)
        return Location(lat_deg, lon_deg, height_m)

    def _set_home(self, command: Command, now_us: int) -> Outcome:
        if whole(command.params[0]) == USE_CURRENT:
            state = self._telemetry.state
            if state is None or not has_position(state):
                return NOT_NOW, []
            location: Location | None = Location(state.lat_deg, state.lon_deg, state.alt_amsl_m)
        else:
            location = self._location(command)
        if location is None or not math.isfinite(location.alt_amsl_m):
            return DENIED, []
        announced = self._put_home(location, now_us)
        self._keep_home()
        self.mark.put(location)
        texts = self._explain("Home set by a ground station", now_us)
        return ACCEPTED, [*announced, *texts, self._save()]

    def _set_roi(self, command: Command, now_us: int) -> Outcome:
        """Mark a location, or clear the mark, by MAV_CMD_DO_SET_ROI and its later forms."""
        mode = ROI_MODES.get(command.number, whole(command.params[0]))
        location = self._location(command) if mode == mavlink.MAV_ROI_LOCATION else None
        if location is None and mode != mavlink.MAV_ROI_NONE:
            return DENIED, []
        return ACCEPTED, self.put_mark(location, now_us)

    def _set_mission_current(self, command: Command, _now_us: int) -> Outcome:
        answers = self.missions.set_current(whole(command.params[0]))
        return (DENIED, []) if answers is None else (ACCEPTED, answers)
