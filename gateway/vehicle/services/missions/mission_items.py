"""Items of missions, fences and rally points: read, checked, and returned unchanged."""

import math
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.client_place import DEGE7, GLOBAL_FRAMES, height_amsl_m, is_on_earth
from gateway.vehicle.home import Place

MISSION: Final[int] = mavlink.MAV_MISSION_TYPE_MISSION
FENCE: Final[int] = mavlink.MAV_MISSION_TYPE_FENCE
RALLY: Final[int] = mavlink.MAV_MISSION_TYPE_RALLY

MAX_ITEMS: Final = {MISSION: 1000, FENCE: 500, RALLY: 100}
"""More than a flight needs, with little memory for each aircraft."""

FENCE_COMMANDS: Final = frozenset(
    {
        mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT,
        mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
        mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION,
        mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION,
    }
)
RALLY_COMMANDS: Final = frozenset({mavlink.MAV_CMD_NAV_RALLY_POINT})

PLACED_COMMANDS: Final = (
    frozenset(
        {
            mavlink.MAV_CMD_NAV_WAYPOINT,
            mavlink.MAV_CMD_NAV_LOITER_UNLIM,
            mavlink.MAV_CMD_NAV_LOITER_TURNS,
            mavlink.MAV_CMD_NAV_LOITER_TIME,
            mavlink.MAV_CMD_NAV_LOITER_TO_ALT,
            mavlink.MAV_CMD_NAV_LAND,
            mavlink.MAV_CMD_NAV_TAKEOFF,
            mavlink.MAV_CMD_NAV_VTOL_TAKEOFF,
            mavlink.MAV_CMD_NAV_VTOL_LAND,
            mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
            mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
            mavlink.MAV_CMD_DO_SET_ROI,
            mavlink.MAV_CMD_DO_LAND_START,
        }
    )
    | FENCE_COMMANDS
    | RALLY_COMMANDS
)
"""Commands whose parameters 5 to 7 are a place, if their frame is a global one."""

ACCEPTED: Final[int] = mavlink.MAV_MISSION_ACCEPTED

FLOAT_FRAMES: Final = {
    mavlink.MAV_FRAME_GLOBAL_INT: mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT,
}
"""The frames of MISSION_ITEM that correspond to those of integer coordinates."""


@dataclass(frozen=True, slots=True)
class Item:
    """One item, with its coordinates as the integers of MISSION_ITEM_INT."""

    frame: int
    command: int
    autocontinue: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float

    def place(self, home_alt_m: float) -> Place | None:
        """Return its position, or None; 0, 0 means "here" to autopilots."""
        placed = self.command in PLACED_COMMANDS and self.frame in GLOBAL_FRAMES
        if not placed or (self.x, self.y) == (0, 0):
            return None
        height = height_amsl_m(self.z, self.frame, home_alt_m)
        return Place(self.x / DEGE7, self.y / DEGE7, height)


def read_item(message: Any) -> Item:
    """Read an item from MISSION_ITEM_INT or MISSION_ITEM.

    Parameters
    ----------
    message : MAVLink_message
        The older MISSION_ITEM has floats in degrees.

    Returns
    -------
    Item
        Unchecked. A float beyond the integer range becomes a value that every check refuses.
    """
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        scale = DEGE7 if message.frame in GLOBAL_FRAMES else 1.0
        x, y = (_integer(value * scale) for value in (x, y))
    return Item(
        message.frame,
        message.command,
        message.autocontinue,
        (message.param1, message.param2, message.param3, message.param4),
        x,
        y,
        message.z,
    )


def write_item(item: Item, sequence: int, kind: int, target: tuple[int, int], current: bool) -> Any:
    """Encode an item as MISSION_ITEM_INT."""
    return mavlink.MAVLink_mission_item_int_message(
        *target,
        sequence,
        item.frame,
        item.command,
        int(current),
        item.autocontinue,
        *item.params,
        item.x,
        item.y,
        item.z,
        kind,
    )


def write_float_item(
    item: Item, sequence: int, kind: int, target: tuple[int, int], current: bool
) -> Any:
    """Encode an item as the older MISSION_ITEM, whose coordinates are floats in degrees."""
    scale = DEGE7 if item.frame in GLOBAL_FRAMES else 1.0
    return mavlink.MAVLink_mission_item_message(
        *target,
        sequence,
        FLOAT_FRAMES.get(item.frame, item.frame),
        item.command,
        int(current),
        item.autocontinue,
        *item.params,
        item.x / scale,
        item.y / scale,
        item.z,
        kind,
    )


def check_item(item: Item, kind: int) -> int:
    """Check an item of an upload.

    Parameters
    ----------
    item : Item
    kind : int
        MAV_MISSION_TYPE of the upload.

    Returns
    -------
    int
        MAV_MISSION_RESULT; `MAV_MISSION_ACCEPTED` if it may be stored. Nothing here executes
        items, so any command of the standard may be in a mission.
    """
    known = {FENCE: FENCE_COMMANDS, RALLY: RALLY_COMMANDS}.get(kind, mavlink.enums["MAV_CMD"])
    result: int = ACCEPTED
    if item.command not in known:
        result = mavlink.MAV_MISSION_UNSUPPORTED
    elif item.command in PLACED_COMMANDS:
        if item.frame not in GLOBAL_FRAMES:
            result = mavlink.MAV_MISSION_UNSUPPORTED_FRAME
        elif not is_on_earth(item.x / DEGE7, 0.0):
            result = mavlink.MAV_MISSION_INVALID_PARAM5_X
        elif not is_on_earth(0.0, item.y / DEGE7):
            result = mavlink.MAV_MISSION_INVALID_PARAM6_Y
        elif math.isinf(item.z):
            result = mavlink.MAV_MISSION_INVALID_PARAM7
    return result


def _integer(value: float) -> int:
    limit = 2**31 - 1
    return round(max(-limit, min(limit, value))) if math.isfinite(value) else limit
