"""Identity and capabilities of the vehicle, which a ground station requests when it connects."""

from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway import __version__
from gateway.vehicle.encoding import ProtocolVersion

CAPABILITIES: Final = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)

MODE_NAME: Final = b"Tracking"

AUTOPILOTS: Final[dict[str, int]] = {
    "generic": mavlink.MAV_AUTOPILOT_GENERIC,
    "ardupilotmega": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    "px4": mavlink.MAV_AUTOPILOT_PX4,
}
"""By the setting `autopilot`."""
CUSTOM_MODES: Final[dict[int, int]] = {
    mavlink.MAV_AUTOPILOT_GENERIC: 0,
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: 0,
    mavlink.MAV_AUTOPILOT_PX4: 1 << 16,
}
"""The mode in which a pilot flies by hand: MANUAL or STABILIZE of ArduPilot, main mode 1 of PX4."""

UID_PREFIX: Final = int.from_bytes(b"mavgate")


def software_version(version: str) -> int:
    """Pack major, minor and patch into the upper three bytes, and the type into the lowest."""
    parts = [int(part) if part.isdigit() else 0 for part in version.split(".")[:3]]
    major, minor, patch = (*parts, 0, 0, 0)[:3]
    kind: int = mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
    return major << 24 | minor << 16 | patch << 8 | kind


def autopilot_version(system_id: int, firmware: int, autopilot: int) -> Any:
    """Encode AUTOPILOT_VERSION; the uid is different for each vehicle of one gateway.

    The version of the nodes' firmware is in the field of the operating system's version. All
    parameters are floats, so that they have the same bytes in both encodings of integers; clients
    of ArduPilot expect the C cast.
    """
    nothing = [0] * 8
    encoding = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    if autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        encoding = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    return mavlink.MAVLink_autopilot_version_message(
        capabilities=CAPABILITIES | encoding,
        flight_sw_version=software_version(__version__),
        middleware_sw_version=0,
        os_sw_version=firmware,
        board_version=0,
        flight_custom_version=nothing,
        middleware_custom_version=nothing,
        os_custom_version=nothing,
        vendor_id=0,
        product_id=0,
        uid=UID_PREFIX << 8 | system_id,
    )


def protocol_version() -> Any:
    """Encode PROTOCOL_VERSION: both versions are read, version 2 is sent."""
    return ProtocolVersion(200, 100, 200, b"", b"")


def available_modes(autopilot: int) -> Any:
    """Encode AVAILABLE_MODES: the one mode that a tracker has."""
    return mavlink.MAVLink_available_modes_message(
        number_modes=1,
        mode_index=1,
        standard_mode=mavlink.MAV_STANDARD_MODE_NON_STANDARD,
        custom_mode=CUSTOM_MODES[autopilot],
        properties=mavlink.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE,
        mode_name=MODE_NAME,
    )


def current_mode(autopilot: int) -> Any:
    """Encode CURRENT_MODE."""
    return mavlink.MAVLink_current_mode_message(
        standard_mode=mavlink.MAV_STANDARD_MODE_NON_STANDARD,
        custom_mode=CUSTOM_MODES[autopilot],
        intended_custom_mode=0,
    )
