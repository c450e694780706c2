"""Locations, items of missions, fences and rally points, and the plan kept over a restart.

Items are read, checked, and returned unchanged. The kept plan is one JSON text per aircraft; an
unknown number is written as NaN, as Python and most readers do.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import msgspec
from geographiclib.geodesic import Geodesic
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import GpsFix, GpsFixType
from gateway.settings import Settings, setting

DEGE7: Final = 1e7
MAX_LAT_DEG: Final = 90.0
MAX_LON_DEG: Final = 180.0

ABSOLUTE_FRAMES: Final = frozenset({mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT})
RELATIVE_FRAMES: Final = frozenset(
    {
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT,
        mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT,
    }
)
"""Heights above home; the terrain, which is not known here, is taken to be as high as home."""
GLOBAL_FRAMES: Final = ABSOLUTE_FRAMES | RELATIVE_FRAMES


def is_on_earth(lat_deg: float, lon_deg: float) -> bool:
    """Return whether a latitude and a longitude are valid."""
    return abs(lat_deg) <= MAX_LAT_DEG and abs(lon_deg) <= MAX_LON_DEG


def describe_location_fault(location: "Location") -> str:
    """Return what is wrong with the coordinates of a location that is not on earth."""
    if not abs(location.lat_deg) <= MAX_LAT_DEG:
        return f"latitude must be between -90 and 90, not {location.lat_deg}"
    return f"longitude must be between -180 and 180, not {location.lon_deg}"


def height_amsl_m(height_m: float, frame: int, home_alt_m: float) -> float:
    """Convert a height in a MAV_FRAME to one above mean sea level.

    Parameters
    ----------
    height_m : float
        Height as sent; NaN if the client does not specify it.
    frame : int
        A MAV_FRAME of `GLOBAL_FRAMES`.
    home_alt_m : float
        Height of home above mean sea level, NaN while there is none.

    Returns
    -------
    float
        NaN if it cannot be known.
    """
    relative = frame in RELATIVE_FRAMES
    height = height_m + home_alt_m if relative else height_m
    return height if math.isfinite(height) else math.nan


WANTED: Final = Geodesic.DISTANCE | Geodesic.AZIMUTH

HomeSource = Literal["none", "gps", "operator"]


@dataclass(frozen=True, slots=True)
class Location:
    """A location on the earth."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True, slots=True)
class Home:
    """The location that heights and distances refer to."""

    location: Location
    set_time_us: int
    source: HomeSource = "gps"


class HomeParameters(Settings, frozen=True):
    """Home as ground stations see and set it among the parameters; all zero while there is none."""

    source: Annotated[
        HomeSource,
        setting(
            "Who set home: none yet, the GPS, or an operator. Set 2 to keep a home of the GPS as "
            "the operator's; set 0 to clear home and let the GPS measure it again."
        ),
    ] = "none"
    lat_deg: Annotated[
        float,
        setting(
            "Latitude of home. While there is no home, one begins when latitude, longitude and "
            "height have all been set.",
            "deg",
            ge=-90.0,
            le=90.0,
        ),
    ] = 0.0
    lon_deg: Annotated[float, setting("Longitude of home.", "deg", ge=-180.0, le=180.0)] = 0.0
    alt_m: Annotated[
        float, setting("Height of home above mean sea level.", "m", ge=-1000.0, le=50000.0)
    ] = 0.0


LOCATED_FIXES = frozenset({GpsFixType.FIX_3D, GpsFixType.GNSS_AND_DEAD_RECKONING})
"""Fix types whose latitude, longitude and height all come from satellites."""


def is_3d(fix: GpsFix) -> bool:
    """Return whether the receiver reports a three-dimensional fix."""
    return fix.fix_ok and fix.fix_type in LOCATED_FIXES


def is_good_enough(fix: GpsFix, accuracy_m: float, satellites: int) -> bool:
    """Return whether a fix may set home; an accuracy that is not known does not forbid it."""
    # Some receivers report latitude 0, longitude 0 as valid before the first fix.
    somewhere = (fix.lat_dege7, fix.lon_dege7) != (0, 0) and math.isfinite(fix.alt_amsl_m)
    accurate = fix.satellites >= satellites and not fix.h_acc_m > accuracy_m
    return is_3d(fix) and somewhere and accurate


def location_of(fix: GpsFix) -> Location:
    """Return the location of a fix."""
    return Location(fix.lat_dege7 * 1e-7, fix.lon_dege7 * 1e-7, fix.alt_amsl_m)


def distance_and_bearing(here: Location, there: Location) -> tuple[float, float]:
    """Measure distance and bearing between two locations.

    Returns
    -------
    tuple of 2 floats
        Distance along the ellipsoid in metres, and bearing at `here` in rad from north, -pi to pi.
    """
    found = Geodesic.WGS84.Inverse(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg, WANTED)
    return (found["s12"], math.radians(found["azi1"]))


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
    """Read an unchecked item from MISSION_ITEM_INT, or MISSION_ITEM with its floats in degrees."""
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
    """Return the MAV_MISSION_RESULT for an item of an upload; any command may be in a mission."""
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
