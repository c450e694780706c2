"""Classes of vehicles by MAV_TYPE."""

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
