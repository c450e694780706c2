"""Names of the flight modes of ArduPilot and PX4."""

from typing import Final

from pymavlink.dialects.v20 import all as mavlink

PX4_MODES: Final = {
    1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED",
}  # fmt: skip
PX4_AUTO_MODES: Final = {
    1: "READY", 2: "TAKEOFF", 3: "LOITER", 4: "MISSION", 5: "RTL", 6: "LAND", 8: "FOLLOW",
    9: "PRECLAND",
}  # fmt: skip
ARDUPILOT_MODES: Final = {
    **dict.fromkeys((1, 16, *range(19, 26)), "PLANE_MODE"),
    **dict.fromkeys((2, 3, 4, 13, 14, 15, 29, 35), "COPTER_MODE"),
    **dict.fromkeys((10, 11), "ROVER_MODE"), 12: "SUB_MODE", 5: "TRACKER_MODE",
}  # fmt: skip
"""Enumeration of the modes by MAV_TYPE; those of other types are not known."""


def mode_name(autopilot: int, mav_type: int, number: int) -> str:
    """Return the custom mode of a vehicle in the words of its autopilot; empty if unknown."""
    if autopilot == mavlink.MAV_AUTOPILOT_PX4:
        return PX4_AUTO_MODES.get(number >> 24, "") or PX4_MODES.get(number >> 16 & 0xFF, "")
    if autopilot != mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        return ""
    words = ARDUPILOT_MODES.get(mav_type, "")
    entry = mavlink.enums[words].get(number) if words else None
    return "" if entry is None else str(entry.name).removeprefix(f"{words}_")
