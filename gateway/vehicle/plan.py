"""Locations, items of missions, fences and rally points, and the plan stored over a restart.

Items are read, checked, and returned unchanged. The stored plan is one JSON text per aircraft; an
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
from gateway.units import DEG_PER_DEGE7, DEGE7_PER_DEG
from gateway.vehicle.encoding import INT32_MAX, whole

MAX_LAT_DEG: Final = 90.0
MAX_LON_DEG: Final = 180.0
MIN_ALT_M: Final = -1000.0
MAX_ALT_M: Final = 50_000.0
"""Valid heights above mean sea level, m: from below the Dead Sea to above every balloon."""

ABSOLUTE_FRAMES: Final = frozenset({mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT})
FLOAT_FRAMES: Final = {
    mavlink.MAV_FRAME_GLOBAL_INT: mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT,
}
"""The frames of MISSION_ITEM that correspond to those of integer coordinates."""
GLOBAL_FRAMES: Final = frozenset({*FLOAT_FRAMES, *FLOAT_FRAMES.values()})
RELATIVE_FRAMES: Final = GLOBAL_FRAMES - ABSOLUTE_FRAMES
"""Frames with heights above home; the unknown terrain is assumed to be as high as home."""
WANTED: Final = Geodesic.DISTANCE | Geodesic.AZIMUTH
HomeSource = Literal["none", "gps", "operator"]
LOCATED_FIXES = frozenset({GpsFixType.FIX_3D, GpsFixType.GNSS_AND_DEAD_RECKONING})
"""Fix types whose latitude, longitude and height all come from satellites."""
MISSION: Final[int] = mavlink.MAV_MISSION_TYPE_MISSION
FENCE: Final[int] = mavlink.MAV_MISSION_TYPE_FENCE
RALLY: Final[int] = mavlink.MAV_MISSION_TYPE_RALLY
MAX_ITEMS: Final = {MISSION: 1000, FENCE: 500, RALLY: 100}
"""Maximum items by type: more than a flight needs, with little memory for each aircraft."""
ACCEPTED: Final[int] = mavlink.MAV_MISSION_ACCEPTED
INVALID_X: Final = mavlink.MAV_MISSION_INVALID_PARAM5_X
INVALID_Y: Final = mavlink.MAV_MISSION_INVALID_PARAM6_Y
KINDS: Final = {MISSION: "mission", FENCE: "fence", RALLY: "rally"}
LOCAL_SCALE: Final = 1e4
"""Units per metre of x and y of MISSION_ITEM_INT in a local frame."""


def is_on_earth(lat_deg: float, lon_deg: float) -> bool:
    """Return whether a latitude and a longitude are valid."""
    return abs(lat_deg) <= MAX_LAT_DEG and abs(lon_deg) <= MAX_LON_DEG


def height_amsl_m(height_m: float, frame: int, home_alt_m: float) -> float:
    """Convert a height in a MAV_FRAME to one above mean sea level; NaN if it is unknown."""
    height = height_m + home_alt_m if frame in RELATIVE_FRAMES else height_m
    return height if math.isfinite(height) else math.nan


@dataclass(frozen=True, slots=True)
class Location:
    """A location on the earth."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float = math.nan
    """NaN if unknown."""

    def fault(self) -> str:
        """Describe an error of the coordinates or the height; empty if there is none."""
        if not abs(self.lat_deg) <= MAX_LAT_DEG:
            return f"latitude must be between -90 and 90, not {self.lat_deg}"
        if not abs(self.lon_deg) <= MAX_LON_DEG:
            return f"longitude must be between -180 and 180, not {self.lon_deg}"
        if self.alt_amsl_m < MIN_ALT_M or self.alt_amsl_m > MAX_ALT_M:
            bounds = f"{MIN_ALT_M:.0f} and {MAX_ALT_M:.0f} m"
            return f"height must be between {bounds}, not {self.alt_amsl_m}"
        return ""


@dataclass(frozen=True, slots=True)
class Home:
    """The location that heights and distances refer to."""

    location: Location
    set_time_us: int
    source: HomeSource = "gps"


class HomeParameters(Settings, frozen=True):
    """Home as ground stations show and set it among the parameters; all zero without a home."""

    source: Annotated[
        HomeSource,
        setting(
            "Source of home: none yet, the GPS, or an operator. Set 2 to keep a home of the GPS as "
            "the operator's; set 0 to clear home and let the GPS measure it again."
        ),
    ] = "none"
    lat_deg: Annotated[
        float,
        setting(
            "Latitude of home. Without a home, one is set once latitude, longitude and height "
            "have all been set.",
            "deg",
            ge=-90.0,
            le=90.0,
        ),
    ] = 0.0
    lon_deg: Annotated[float, setting("Longitude of home.", "deg", ge=-180.0, le=180.0)] = 0.0
    alt_m: Annotated[
        float, setting("Height of home above mean sea level.", "m", ge=MIN_ALT_M, le=MAX_ALT_M)
    ] = 0.0


def is_3d(fix: GpsFix) -> bool:
    """Return whether the receiver reports a three-dimensional fix."""
    return fix.fix_ok and fix.fix_type in LOCATED_FIXES


def is_good_enough(fix: GpsFix, accuracy_m: float, satellites: int) -> bool:
    """Return whether a fix may set home; an unknown accuracy is accepted."""
    # Some receivers report latitude 0, longitude 0 as valid before the first fix.
    somewhere = (fix.lat_dege7, fix.lon_dege7) != (0, 0) and math.isfinite(fix.alt_amsl_m)
    accurate = fix.satellites >= satellites and not fix.h_acc_m > accuracy_m
    return is_3d(fix) and somewhere and accurate


def location_of(fix: GpsFix) -> Location:
    """Return the location of a fix."""
    return Location(fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7, fix.alt_amsl_m)


def distance_and_bearing(here: Location, there: Location) -> tuple[float, float]:
    """Return the distance along the ellipsoid in m, and the bearing at `here` in rad, -pi to pi."""
    found = Geodesic.WGS84.Inverse(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg, WANTED)
    return (found["s12"], math.radians(found["azi1"]))


def _commands(*names: str) -> frozenset[int]:
    return frozenset(getattr(mavlink, f"MAV_CMD_{name}") for name in names)


FENCE_COMMANDS: Final = _commands(
    *("NAV_FENCE_RETURN_POINT", "NAV_FENCE_CIRCLE_INCLUSION", "NAV_FENCE_CIRCLE_EXCLUSION"),
    *("NAV_FENCE_POLYGON_VERTEX_INCLUSION", "NAV_FENCE_POLYGON_VERTEX_EXCLUSION"),
)
RALLY_COMMANDS: Final = _commands("NAV_RALLY_POINT")
LOCATED_COMMANDS: Final = (
    FENCE_COMMANDS
    | RALLY_COMMANDS
    | _commands(
        *("NAV_WAYPOINT", "NAV_SPLINE_WAYPOINT", "NAV_LOITER_UNLIM", "NAV_LOITER_TURNS"),
        *("NAV_LOITER_TIME", "NAV_LOITER_TO_ALT", "NAV_LAND", "NAV_TAKEOFF", "NAV_VTOL_TAKEOFF"),
        *("NAV_VTOL_LAND", "DO_SET_ROI_LOCATION", "DO_SET_ROI", "DO_LAND_START"),
    )
)
"""Commands whose parameters 5 to 7 are a location, if their frame is a global one."""


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

    @property
    def numbers(self) -> tuple[float, ...]:
        """The seven parameters of the command; a latitude and a longitude in degrees."""
        scale = _scale(self.frame)
        return (*self.params, self.x / scale, self.y / scale, self.z)

    def location(self, home_alt_m: float) -> Location | None:
        """Return its position, or None if it has none; 0, 0 means "here" to autopilots."""
        located = self.command in LOCATED_COMMANDS and self.frame in GLOBAL_FRAMES
        if not located or (self.x, self.y) == (0, 0):
            return None
        height = height_amsl_m(self.z, self.frame, home_alt_m)
        return Location(self.x / DEGE7_PER_DEG, self.y / DEGE7_PER_DEG, height)


def read_item(message: Any) -> Item:
    """Read an unchecked item from MISSION_ITEM_INT, or MISSION_ITEM with its floats in degrees."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        scale = _scale(message.frame)
        x, y = (whole(value * scale, -INT32_MAX, INT32_MAX, INT32_MAX) for value in (x, y))
    params = (message.param1, message.param2, message.param3, message.param4)
    frame, command, autocontinue = message.frame, message.command, message.autocontinue
    return Item(frame, command, autocontinue, params, x, y, message.z)


def write_item(
    item: Item,
    sequence: int,
    kind: int,
    target: tuple[int, int],
    is_current: bool,
    as_floats: bool = False,
) -> Any:
    """Encode an item as MISSION_ITEM_INT, or the older MISSION_ITEM with floats in degrees."""
    fields = (item.command, int(is_current), item.autocontinue, *item.params)
    if not as_floats:
        return mavlink.MAVLink_mission_item_int_message(
            *target, sequence, item.frame, *fields, item.x, item.y, item.z, kind
        )
    scale = _scale(item.frame)
    frame = FLOAT_FRAMES.get(item.frame, item.frame)
    return mavlink.MAVLink_mission_item_message(
        *target, sequence, frame, *fields, item.x / scale, item.y / scale, item.z, kind
    )


def _scale(frame: int) -> float:
    """Return the unit of integer coordinates in a frame, per degree or metre."""
    if frame in GLOBAL_FRAMES:
        return DEGE7_PER_DEG
    return 1.0 if frame == mavlink.MAV_FRAME_MISSION else LOCAL_SCALE


def check_item(item: Item, kind: int) -> int:
    """Return the MAV_MISSION_RESULT for an item of an upload; any command may be in a mission."""
    known = {FENCE: FENCE_COMMANDS, RALLY: RALLY_COMMANDS}.get(kind, mavlink.enums["MAV_CMD"])
    located = item.command in LOCATED_COMMANDS
    faults = (
        (item.command not in known, mavlink.MAV_MISSION_UNSUPPORTED),
        (located and item.frame not in GLOBAL_FRAMES, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (located and not is_on_earth(item.x / DEGE7_PER_DEG, 0.0), INVALID_X),
        (located and not is_on_earth(0.0, item.y / DEGE7_PER_DEG), INVALID_Y),
        (located and math.isinf(item.z), mavlink.MAV_MISSION_INVALID_PARAM7),
    )
    return next((result for is_wrong, result in faults if is_wrong), ACCEPTED)


class StoredPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Missions, mark and home of one vehicle, as stored over a restart."""

    version: Literal[1] = 1
    home: Location | None = None
    """Home that an operator has set; one that the GPS measured is not stored."""
    mark: Location | None = None
    mark_of: int | None = None
    """MAV_MISSION_TYPE of the items that the mark follows; None if it was set on its own."""
    current: int = 0
    """Index of the current mission item."""
    mission: tuple[Item, ...] = ()
    fence: tuple[Item, ...] = ()
    rally: tuple[Item, ...] = ()


def encode_plan(plan: StoredPlan) -> str:
    """Encode a plan as a text that `decode_plan` reads back equal."""
    return json.dumps(msgspec.to_builtins(plan), indent=1) + "\n"


def decode_plan(text: str) -> StoredPlan:
    """Read a text of `encode_plan`.

    ValueError names the first fault, which may be a value that no ground station could have stored.
    """
    try:
        plan = msgspec.convert(json.loads(text), StoredPlan)
    except RecursionError as error:
        raise ValueError(str(error)) from error
    for fault in _faults(plan):
        raise ValueError(fault)
    return plan


def _faults(plan: StoredPlan) -> Iterator[str]:
    for name, location in (("home", plan.home), ("mark", plan.mark)):
        if location is not None and (fault := location.fault()):
            yield f"{name}: {fault}"
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
