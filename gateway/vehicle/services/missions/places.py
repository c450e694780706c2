"""Home, missions and the marked location, as ground stations set them and as they are kept."""

import math
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import NAN, GpsFix
from gateway.settings import Settings
from gateway.vehicle.actions import Answer, Reply, SavePlaces
from gateway.vehicle.client_place import GLOBAL_FRAMES, height_amsl_m, is_on_earth
from gateway.vehicle.home import Place, distance_and_bearing, is_3d, place_of
from gateway.vehicle.mark import Mark
from gateway.vehicle.services.commands import (
    ACCEPTED,
    DENIED,
    NOT_NOW,
    Command,
    CommandService,
    Outcome,
    whole,
)
from gateway.vehicle.services.home_service import HomeService
from gateway.vehicle.services.missions.mission import MissionService
from gateway.vehicle.services.missions.mission_items import FENCE, MISSION, RALLY
from gateway.vehicle.stored import KINDS, StoredPlaces
from gateway.vehicle.telemetry.events import INFO, StatusText
from gateway.vehicle.telemetry.messages import has_position
from gateway.vehicle.telemetry.telemetry import Telemetry

Say = Callable[[StatusText, int], list[Any]]

USE_CURRENT: Final = 1
"""First parameter of MAV_CMD_DO_SET_HOME."""


class PlaceService:
    """Set home, set and clear the mark, and store them and the missions.

    Parameters
    ----------
    vehicle_id : int
        Id in the radio payloads.
    telemetry : Telemetry
        Knows where the vehicle is, and sends home and the way to the mark.
    say : callable
        Announces an event to all.
    stored : StoredPlaces
        The places kept from the last run.
    """

    def __init__(
        self, vehicle_id: int, telemetry: Telemetry, say: Say, stored: StoredPlaces
    ) -> None:
        self._vehicle_id = vehicle_id
        self.mark = Mark()
        self.mark.place, self.mark.of = stored.mark, stored.mark_of
        self.home = HomeService(telemetry)
        if stored.home is not None:
            self.home.restore(stored.home)
        self._home_untold = stored.home is not None
        self.missions = MissionService(self._on_items, self._explain)
        self.missions.items = {kind: getattr(stored, name) for kind, name in KINDS.items()}
        self.missions.current = stored.current
        self._telemetry = telemetry
        self._say = say
        telemetry.add(
            mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT,
            lambda _: self.mark.nav_controller_output(telemetry.state),
        )
        telemetry.add(
            mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, lambda _: self.missions.mission_current()
        )

    def register(self, commands: CommandService) -> None:
        """Register the commands that are carried out here."""
        commands.register(mavlink.MAV_CMD_DO_SET_HOME, self._set_home)
        commands.register(mavlink.MAV_CMD_DO_SET_ROI, self._set_roi)
        commands.register(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, self._set_roi_location)
        commands.register(mavlink.MAV_CMD_DO_SET_ROI_NONE, self._clear_roi)
        commands.register(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, self._set_mission_current)

    def on_fix(self, fix: GpsFix, now_us: int) -> list[Answer]:
        """Announce once how far a kept home is: it may be that of another field."""
        home = self.home.kept
        if home is None or not self._home_untold or not is_3d(fix):
            return []
        self._home_untold = False
        distance_m, _ = distance_and_bearing(place_of(fix), home)
        text = f"Stored home is used, {distance_m:.0f} m from here"
        return self._explain(text, now_us)

    def put_mark(self, place: Place | None, now_us: int) -> list[Answer]:
        """Mark a place, or none, and announce it."""
        self.mark.put(place)
        text = "Mark cleared"
        if place is not None:
            text = f"Marked {place.lat_deg:.6f}, {place.lon_deg:.6f}"
        return [self._save(), *self._explain(text, now_us)]

    def change(self, settings: Settings, key: str, now_us: int) -> list[Answer]:
        """Apply the change of a parameter of home; ValueError refuses it."""
        return self.home.change(settings, key, now_us)

    def store(self) -> list[Answer]:
        """Keep the home that was set by parameters."""
        self.home.keep()
        return [self._save()]

    def _save(self) -> SavePlaces:
        items = self.missions.items
        stored = StoredPlaces(
            home=self.home.kept,
            mark=self.mark.place,
            mark_of=self.mark.of,
            current=self.missions.current,
            mission=items[MISSION],
            fence=items[FENCE],
            rally=items[RALLY],
        )
        return SavePlaces(self._vehicle_id, stored)

    @property
    def _home_alt_m(self) -> float:
        home = self._telemetry.home
        return home.place.alt_amsl_m if home else NAN

    def _explain(self, text: str, now_us: int) -> list[Answer]:
        return [Reply(message) for message in self._say(StatusText(INFO, text), now_us)]

    def _on_items(self, kind: int, _now_us: int) -> list[Answer]:
        if kind != FENCE:
            first = self.missions.current if kind == MISSION else 0
            self.mark.follow(kind, self.missions.items[kind][first:], self._home_alt_m)
        return [self._save()]

    def _place(self, command: Command) -> Place | None:
        """Read the position of a command; None if it is invalid."""
        if command.frame not in GLOBAL_FRAMES:
            return None
        if not is_on_earth(command.lat_deg, command.lon_deg):
            return None
        height = height_amsl_m(command.height_m, command.frame, self._home_alt_m)
        return Place(command.lat_deg, command.lon_deg, height)

    def _set_home(self, command: Command, now_us: int) -> Outcome:
        if whole(command.params[0]) == USE_CURRENT:
            state = self._telemetry.state
            if state is None or not has_position(state):
                return NOT_NOW, []
            place: Place | None = Place(state.lat_deg, state.lon_deg, state.alt_amsl_m)
        else:
            place = self._place(command)
        if place is None or not math.isfinite(place.alt_amsl_m):
            return DENIED, []
        announced = self.home.put(place, now_us)
        self.home.keep()
        self.mark.put(place)
        said = self._explain("Home set by a ground station", now_us)
        return ACCEPTED, [*announced, *said, self._save()]

    def _set_roi(self, command: Command, now_us: int) -> Outcome:
        mode = whole(command.params[0])
        if mode == mavlink.MAV_ROI_NONE:
            return self._clear_roi(command, now_us)
        if mode != mavlink.MAV_ROI_LOCATION:
            return DENIED, []
        return self._set_roi_location(command, now_us)

    def _set_roi_location(self, command: Command, now_us: int) -> Outcome:
        place = self._place(command)
        return (DENIED, []) if place is None else (ACCEPTED, self.put_mark(place, now_us))

    def _clear_roi(self, _command: Command, now_us: int) -> Outcome:
        return ACCEPTED, self.put_mark(None, now_us)

    def _set_mission_current(self, command: Command, now_us: int) -> Outcome:
        answers = self.missions.set_current(whole(command.params[0]), now_us)
        return (DENIED, []) if answers is None else (ACCEPTED, answers)
