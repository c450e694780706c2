"""Commands to an aircraft as messages, and their results as text."""

from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import DEGE7_PER_DEG
from gateway.vehicle.plan import Location


def result_text(result: int) -> str:
    """Return the text of a MAV_RESULT."""
    known = mavlink.enums["MAV_RESULT"].get(result)
    if known is None:
        return f"result {result}"
    return str(known.name).removeprefix("MAV_RESULT_").lower().replace("_", " ")


def command_long(system_id: int, number: int, *params: float) -> Any:
    """Make a COMMAND_LONG for an autopilot; parameters that are not given are zero."""
    filled = (*map(float, params), *(0.0,) * (7 - len(params)))
    autopilot = mavlink.MAV_COMP_ID_AUTOPILOT1
    return mavlink.MAVLink_command_long_message(system_id, autopilot, number, 0, *filled)


def command_at(system_id: int, number: int, at: Location) -> Any:
    """Make a COMMAND_INT with a location for an autopilot."""
    return mavlink.MAVLink_command_int_message(
        system_id,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        mavlink.MAV_FRAME_GLOBAL,
        number,
        *(0, 0, 0.0, 0.0, 0.0, 0.0),
        round(at.lat_deg * DEGE7_PER_DEG),
        round(at.lon_deg * DEGE7_PER_DEG),
        at.alt_amsl_m,
    )
