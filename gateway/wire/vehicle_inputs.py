"""Messages that act on a vehicle: requests that address it, and inputs that name no vehicle.

A message without a target field is an input if an autopilot of public source, or its specification,
uses it for more than a display: as a position or an obstacle, as a request, as the state of its
radio, or as traffic to avoid. Messages of companions are such inputs too, though the autopilot
itself sends some of them as telemetry. A message that is unknown here may act as well.
"""

from typing import Final

from gateway.wire.mavlink_messages import MESSAGE_NAMES, TARGET_OFFSETS, ids_of

REPORTS: Final = ids_of(
    "COMMAND_ACK", "MISSION_ACK", "PARAM_ERROR", "MOUNT_STATUS", "CAMERA_STATUS",
    "CAMERA_FEEDBACK", "GIMBAL_REPORT", "GIMBAL_TORQUE_CMD_REPORT",
    "GIMBAL_DEVICE_ATTITUDE_STATUS", "OPEN_DRONE_ID_BASIC_ID", "OPEN_DRONE_ID_LOCATION",
    "OPEN_DRONE_ID_AUTHENTICATION", "OPEN_DRONE_ID_SELF_ID", "OPEN_DRONE_ID_SYSTEM",
    "OPEN_DRONE_ID_OPERATOR_ID", "OPEN_DRONE_ID_MESSAGE_PACK",
)  # fmt: skip
"""Messages with a target that are not requests."""
REQUESTS: Final = TARGET_OFFSETS.keys() - REPORTS
UNADDRESSED_INPUTS: Final = ids_of(
    # Position, motion and surroundings.
    "GPS_INPUT", "GPS_RTCM_DATA", "GLOBAL_VISION_POSITION_ESTIMATE", "VISION_POSITION_ESTIMATE",
    "VISION_SPEED_ESTIMATE", "VISION_POSITION_DELTA", "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP",
    "ODOMETRY", "OPTICAL_FLOW", "OPTICAL_FLOW_RAD", "DISTANCE_SENSOR", "OBSTACLE_DISTANCE",
    "OBSTACLE_DISTANCE_3D", "LANDING_TARGET", "TERRAIN_DATA", "TERRAIN_CHECK",
    # Simulated sensors and controls.
    "HIL_STATE", "HIL_STATE_QUATERNION", "HIL_CONTROLS", "HIL_ACTUATOR_CONTROLS",
    "HIL_RC_INPUTS_RAW", "HIL_SENSOR", "HIL_GPS", "HIL_OPTICAL_FLOW",
    # Control, and paths to fly.
    "MANUAL_SETPOINT", "RC_CHANNELS", "CUBEPILOT_RAW_RC", "FOLLOW_TARGET",
    "TRAJECTORY_REPRESENTATION_WAYPOINTS", "TRAJECTORY_REPRESENTATION_BEZIER",
    # Traffic to avoid, and the transponder.
    "ADSB_VEHICLE", "AIS_VESSEL", "COLLISION", "UTM_GLOBAL_POSITION", "ICAROUS_KINEMATIC_BANDS",
    "ICAROUS_HEARTBEAT", "OPEN_DRONE_ID_ARM_STATUS", "UAVIONIX_ADSB_OUT_CFG",
    "UAVIONIX_ADSB_OUT_DYNAMIC", "UAVIONIX_ADSB_OUT_CFG_REGISTRATION",
    "UAVIONIX_ADSB_OUT_CFG_FLIGHTID", "UAVIONIX_ADSB_OUT_CONTROL", "UAVIONIX_ADSB_GET",
    "UAVIONIX_ADSB_TRANSCEIVER_HEALTH_REPORT",
    # Ports, keys, and transfers.
    "SERIAL_CONTROL", "AUTH_KEY", "AIRLINK_AUTH", "WIFI_CONFIG_AP", "RESOURCE_REQUEST",
    "DATA_TRANSMISSION_HANDSHAKE",
    # State of the radio, by which an autopilot adapts its rates.
    "RADIO_STATUS", "RADIO", "MLRS_RADIO_LINK_FLOW_CONTROL",
)  # fmt: skip
"""Messages that act on each vehicle that receives them."""


def acts(message_id: int) -> bool:
    """Return whether a message that names no system may act on a vehicle that receives it."""
    if message_id in TARGET_OFFSETS:
        return message_id in REQUESTS
    return message_id in UNADDRESSED_INPUTS or message_id not in MESSAGE_NAMES
