"""Classes of vehicles by MAV_TYPE, and the names of the flight modes of ArduPilot and PX4."""

from typing import Final

from pymavlink.dialects.v20 import all as mavlink

CLASSES: Final[dict[int, str]] = {
    **dict.fromkeys((mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_TYPE_FLAPPING_WING), "plane"),
    **dict.fromkeys(range(19, 26), "vtol"),  # MAV_TYPE_VTOL_…, some with newer names.
    **dict.fromkeys(
        (
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER,
            mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_TYPE_OCTOROTOR, mavlink.MAV_TYPE_TRICOPTER,
            mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR,
        ),
        "copter",
    ),
    mavlink.MAV_TYPE_GROUND_ROVER: "rover",
    mavlink.MAV_TYPE_SURFACE_BOAT: "boat",
    mavlink.MAV_TYPE_SUBMARINE: "sub",
    mavlink.MAV_TYPE_ANTENNA_TRACKER: "tracker",
    mavlink.MAV_TYPE_AIRSHIP: "balloon",
    mavlink.MAV_TYPE_FREE_BALLOON: "balloon",
}  # fmt: skip
"""Class by MAV_TYPE; of the others, the program decides."""
SURFACE: Final = frozenset({"rover", "boat", "sub", "tracker"})
"""Classes that never fly."""
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
