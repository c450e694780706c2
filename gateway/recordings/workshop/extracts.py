"""Parameters and plans of a recorded vehicle, as files of ground stations.

| ending       | content                               | read by                               |
| ------------ | ------------------------------------- | ------------------------------------- |
| `.param`     | `NAME,value`                          | Mission Planner, MAVProxy, pymavlink  |
| `.params`    | vehicle, component, name, value, type | QGroundControl                        |
| `.waypoints` | `QGC WPL 110`                         | Mission Planner, MAVProxy, pymavlink  |
| `.plan`      | JSON: mission, fence and rally points | QGroundControl                        |
"""

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.answers.log_answers import (
    AUTOPILOT_VERSION_ID,
    HOME_POSITION_ID,
    LogAnswers,
    VehicleAnswers,
)
from gateway.vehicle.plan import FENCE, MISSION, RALLY, Item, read_item
from gateway.vehicle.services.parameters import INTEGER_CODES, decode_value
from gateway.vehicle_state.positions import Position, named_position
from gateway.vehicle_state.senders import RecordedSender
from gateway.wire.recorded_frames import fields_of

END_US: Final = 1 << 62
UNKNOWN_INTS: Final = ((1 << 31) - 1, -(1 << 31))
"""Unknown coordinates of MISSION_ITEM_INT: that of the specification, and a converted NaN."""
_NOT_IN_NAMES: Final = re.compile(r"[^\x21-\x7e]|[,#]|^[=+@-]")
POLYGONS: Final = {
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION: False,
}
CIRCLES: Final = {
    mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION: False,
}
CRUISE_MPS, HOVER_MPS = 15, 5
"""Speeds in m/s that a plan requires and a recording lacks: QGroundControl's values."""


@dataclass(frozen=True, slots=True)
class RecordedParameter:
    """A parameter as it was last recorded."""

    name: str
    value: float
    kind: int
    """MAV_PARAM_TYPE."""


def parameter_text(value: float) -> str:
    """Return a value with the fewest digits that yield the same single-precision float."""
    if float(value).is_integer() and abs(value) < 1 << 53:
        return str(int(value))
    return str(np.float32(value))


class RecordedPlan:
    """The parameters and plans of one vehicle at the end of a recording."""

    def __init__(self, log: LogAnswers, sender: RecordedSender) -> None:
        self.system_id = sender.origin >> 8
        self.component_id = sender.origin & 0xFF
        self.heartbeat = sender.heartbeat or (0, 0)
        self._answers = VehicleAnswers(log, self.system_id, self.system_id, lambda: END_US)

    def parameters(self) -> list[RecordedParameter]:
        """Return the parameters by name."""
        is_bytewise, found = self._is_bytewise(), []
        for name, frame in sorted(self._answers.parameters().items()):
            fields = fields_of(frame)
            value, kind = float(fields["param_value"]), fields["param_type"]
            if is_bytewise and kind in INTEGER_CODES:
                value = decode_value(value, kind)
            found.append(RecordedParameter(name, value, kind))
        return found

    def items(self, kind: int) -> list[Item]:
        """Return the items of a mission, fence, or rally points; empty if not recorded."""
        read: Any = mavlink.MAVLink(None)
        frames = self._answers.mission(kind) or ()
        return [read_item(read.decode(bytearray(frame))) for frame in frames]

    def home(self) -> Position | None:
        """Return the home position."""
        fields = self.fields(HOME_POSITION_ID)
        return None if fields is None else named_position(fields)

    def fields(self, message_id: int) -> dict[str, Any] | None:
        """Return the fields of the newest message of one type; None if it was not recorded."""
        frames = self._answers.frames(message_id)
        return fields_of(frames[0]) if frames else None

    def _is_bytewise(self) -> bool:
        """Return whether integers are sent as their bytes instead of converted to float."""
        if (version := self.fields(AUTOPILOT_VERSION_ID)) is not None:
            able = version["capabilities"]
            return bool(able & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE)
        return bool(self.heartbeat[1] == mavlink.MAV_AUTOPILOT_PX4)


def _file_name(name: str) -> str:
    """Return a parameter's name with the characters escaped that a file of them cannot hold."""
    return _NOT_IN_NAMES.sub(lambda found: f"\\x{ord(found[0]):02x}", name)


def param_file(parameters: Iterable[RecordedParameter]) -> Iterator[str]:
    """Write parameters in the format of Mission Planner and MAVProxy."""
    for parameter in parameters:
        yield f"{_file_name(parameter.name)},{parameter_text(parameter.value)}\n"


def qgc_params(parameters: Iterable[RecordedParameter], plan: RecordedPlan) -> Iterator[str]:
    """Write parameters in the format of QGroundControl."""
    yield f"# Onboard parameters for Vehicle {plan.system_id}\n#\n"
    yield "# Vehicle-Id Component-Id Name Value Type\n"
    for each in parameters:
        cells = (
            plan.system_id,
            plan.component_id,
            _file_name(each.name),
            parameter_text(each.value),
            each.kind,
        )
        yield "\t".join(map(str, cells)) + "\n"


def waypoints(items: Sequence[Item]) -> Iterator[str]:
    """Write items as a list of waypoints, with 0 for an unknown number."""
    yield "QGC WPL 110\n"
    for number, item in enumerate(items):
        numbers = (f"{value or 0.0:.8f}" for value in _numbers(item))
        head = (number, int(number == 0), item.frame, item.command)
        yield "\t".join([*map(str, head), *numbers, str(item.autocontinue)]) + "\n"


def qgc_plan(plan: RecordedPlan) -> str:
    """Write mission, fence and rally points as a QGroundControl plan."""
    items, at = plan.items(MISSION), plan.home()
    home: list[float | None] = [None, None, None]
    if at is not None:
        home = [_known(value) for value in (at.lat_deg, at.lon_deg, at.alt_amsl_m)]
    is_ardupilot = plan.heartbeat[1] == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    if is_ardupilot and items:
        # ArduPilot's first item is home; without one it is 0, 0.
        home = _numbers(items[0])[4:] if any(items[0].numbers[4:6]) else home
        items = items[1:]
    mission = {
        "version": 2,
        "firmwareType": plan.heartbeat[1],
        "vehicleType": plan.heartbeat[0],
        "cruiseSpeed": CRUISE_MPS,
        "hoverSpeed": HOVER_MPS,
        "plannedHomePosition": home,
        "items": [_simple_item(item, number) for number, item in enumerate(items, 1)],
    }
    rally = [_numbers(item)[4:] for item in plan.items(RALLY)]
    content = {
        "fileType": "Plan", "version": 1, "groundStation": "mavgate", "mission": mission,
        "geoFence": {"version": 2, **_fence(plan.items(FENCE))},
        "rallyPoints": {"version": 2, "points": rally},
    }  # fmt: skip
    return json.dumps(content, indent=4, allow_nan=False) + "\n"


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _numbers(item: Item) -> list[float | None]:
    """Return the seven parameters of an item; None for those that are unknown."""
    *params, x, y, z = map(_known, item.numbers)
    at = (None if raw in UNKNOWN_INTS else value for raw, value in ((item.x, x), (item.y, y)))
    return [*params, *at, z]


def _simple_item(item: Item, number: int) -> Mapping[str, Any]:
    return {
        "type": "SimpleItem", "doJumpId": number, "command": item.command, "frame": item.frame,
        "autoContinue": bool(item.autocontinue), "params": _numbers(item),
    }  # fmt: skip


def _fence(items: Sequence[Item]) -> dict[str, Any]:
    polygons: list[dict[str, Any]] = []
    circles: list[dict[str, Any]] = []
    found: dict[str, Any] = {"polygons": polygons, "circles": circles}
    left = 0
    for item in items:
        params = _numbers(item)
        first, at = params[0], params[4:6]
        if item.command in POLYGONS:
            if not left:
                left, inclusion = int(first or 0), POLYGONS[item.command]
                polygons.append({"version": 1, "inclusion": inclusion, "polygon": []})
            polygons[-1]["polygon"].append(at)
            left = max(left - 1, 0)
        elif item.command in CIRCLES:
            circle = {"center": at, "radius": first}
            circles.append({"version": 1, "inclusion": CIRCLES[item.command], "circle": circle})
        elif item.command == mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT:
            found["breachReturn"] = params[4:]
    return found
