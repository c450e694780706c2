"""Items of missions, fences and rally points, and the plan that is kept over a restart.

Items are read, checked, and returned unchanged. The kept plan is one JSON text per aircraft; an
unknown number is written as NaN, as Python and most readers do.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Literal

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.location import (
    DEGE7,
    GLOBAL_FRAMES,
    Location,
    describe_location_fault,
    height_amsl_m,
    is_on_earth,
)

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

LOCATED_COMMANDS: Final = (
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
"""Commands whose parameters 5 to 7 are a location, if their frame is a global one."""

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

    def location(self, home_alt_m: float) -> Location | None:
        """Return its position, or None; 0, 0 means "here" to autopilots."""
        located = self.command in LOCATED_COMMANDS and self.frame in GLOBAL_FRAMES
        if not located or (self.x, self.y) == (0, 0):
            return None
        height = height_amsl_m(self.z, self.frame, home_alt_m)
        return Location(self.x / DEGE7, self.y / DEGE7, height)


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
    elif item.command in LOCATED_COMMANDS:
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


KINDS: Final = {MISSION: "mission", FENCE: "fence", RALLY: "rally"}


class StoredPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Missions, mark and home of one vehicle, as kept over a restart."""

    version: Literal[1] = 1
    home: Location | None = None
    """Where an operator set it; a home that the GPS measured is not kept."""
    mark: Location | None = None
    mark_of: int | None = None
    """MAV_MISSION_TYPE of the items that the mark follows; None if it was set by itself."""
    current: int = 0
    """Item of the mission."""
    mission: tuple[Item, ...] = ()
    fence: tuple[Item, ...] = ()
    rally: tuple[Item, ...] = ()


def encode_plan(plan: StoredPlan) -> str:
    """Encode a plan as a text that `decode_plan` reads back equal."""
    return json.dumps(msgspec.to_builtins(plan), indent=1) + "\n"


def decode_plan(text: str) -> StoredPlan:
    """Read a plan.

    Parameters
    ----------
    text : str
        JSON of `encode_plan`.

    Returns
    -------
    StoredPlan

    Raises
    ------
    ValueError
        If it is not such a text, or contains values that no ground station could have stored; the
        error names the first.
    """
    try:
        plan = msgspec.convert(json.loads(text), StoredPlan)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ValueError(str(error)) from error
    fault = next(_faults(plan), None)
    if fault is not None:
        raise ValueError(fault)
    return plan


def _faults(plan: StoredPlan) -> Iterator[str]:
    for name, location in (("home", plan.home), ("mark", plan.mark)):
        if location is not None and not is_on_earth(location.lat_deg, location.lon_deg):
            yield f"{name}: {describe_location_fault(location)}"
    if plan.home is not None and not math.isfinite(plan.home.alt_amsl_m):
        yield "home: the height is not a number"
    for kind, name in KINDS.items():
        items = getattr(plan, name)
        if len(items) > MAX_ITEMS[kind]:
            yield f"{name}: more than {MAX_ITEMS[kind]} items"
        for number, item in enumerate(items):
            if check_item(item, kind) != ACCEPTED:
                yield f"{name}: item {number} cannot be stored"
    if plan.current not in range(max(1, len(plan.mission))):
        yield f"current: no item {plan.current}"
