"""Names of the flight modes of ArduPilot and PX4."""

from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.vehicle_types import CLASSES

PX4_MODES: Final = {
    1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED",
}  # fmt: skip
PX4_AUTO_MODES: Final = {
    1: "READY", 2: "TAKEOFF", 3: "LOITER", 4: "MISSION", 5: "RTL", 6: "LAND", 8: "FOLLOW",
    9: "PRECLAND",
}  # fmt: skip
ARDUPILOT_MODES: Final = {
    "plane": "PLANE_MODE", "vtol": "PLANE_MODE", "copter": "COPTER_MODE", "rover": "ROVER_MODE",
    "boat": "ROVER_MODE", "sub": "SUB_MODE", "tracker": "TRACKER_MODE",
}  # fmt: skip
"""Enumeration of the modes by class of vehicle; those of others are not known."""


def mode_name(autopilot: int, mav_type: int, number: int) -> str:
    """Return the custom mode of a vehicle in the words of its autopilot; empty if unknown."""
    if autopilot == mavlink.MAV_AUTOPILOT_PX4:
        return PX4_AUTO_MODES.get(number >> 24, "") or PX4_MODES.get(number >> 16 & 0xFF, "")
    if autopilot != mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        return ""
    words = ARDUPILOT_MODES.get(CLASSES.get(mav_type, ""), "")
    entry = mavlink.enums[words].get(number) if words else None
    return "" if entry is None else str(entry.name).removeprefix(f"{words}_")
