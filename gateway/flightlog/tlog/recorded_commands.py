"""Recorded frames that are commands to a vehicle, and must not reach a live one.

A recording holds both directions of a link. Messages of a vehicle are played; those of ground
stations, and any others that command a vehicle or feed its navigation, could arm, steer or mislead
a real vehicle with the same id on the link that it is played to.
"""

from collections.abc import Set
from typing import Final

import numpy as np

from gateway.flightlog.tlog.tlog import Batch
from gateway.flightlog.tlog.tlog_scan import IntArray
from gateway.wire.mavlink_messages import MESSAGE_IDS, TARGET_OFFSETS
from gateway.wire.mavlink_splitter import message_id_of, origin_of, target_of

FIRST_GROUND_STATION: Final = 250
"""System ids from here on are by custom ground stations, which keep their id."""
AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1."""

_REPORTS: Final = {
    MESSAGE_IDS[name]
    for name in (
        "COMMAND_ACK", "MISSION_ACK", "PARAM_ERROR", "MOUNT_STATUS", "CAMERA_STATUS",
        "CAMERA_FEEDBACK", "GIMBAL_REPORT", "GIMBAL_TORQUE_CMD_REPORT",
        "GIMBAL_DEVICE_ATTITUDE_STATUS", "OPEN_DRONE_ID_BASIC_ID", "OPEN_DRONE_ID_LOCATION",
        "OPEN_DRONE_ID_AUTHENTICATION", "OPEN_DRONE_ID_SELF_ID", "OPEN_DRONE_ID_SYSTEM",
        "OPEN_DRONE_ID_OPERATOR_ID", "OPEN_DRONE_ID_MESSAGE_PACK",
    )
}  # fmt: skip
"""Messages with a target that request nothing of it."""
_ASKING: Final = frozenset(TARGET_OFFSETS.keys() - _REPORTS)
_FEEDING: Final = frozenset(
    MESSAGE_IDS[name]
    for name in (
        "GPS_RTCM_DATA", "GPS_INPUT", "HIL_CONTROLS", "HIL_RC_INPUTS_RAW", "HIL_SENSOR",
        "HIL_GPS", "HIL_OPTICAL_FLOW", "HIL_ACTUATOR_CONTROLS", "HIL_STATE_QUATERNION",
        "GLOBAL_VISION_POSITION_ESTIMATE", "VISION_POSITION_ESTIMATE", "VISION_SPEED_ESTIMATE",
        "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY", "LANDING_TARGET",
        "OBSTACLE_DISTANCE", "OBSTACLE_DISTANCE_3D", "DISTANCE_SENSOR", "OPTICAL_FLOW",
        "OPTICAL_FLOW_RAD", "FOLLOW_TARGET", "TERRAIN_DATA",
    )
)  # fmt: skip
"""Inputs of an autopilot from other components; when it sends them itself they are telemetry."""
_LOOKED_AT: Final = np.array(sorted(_ASKING | _FEEDING))


def is_station(origin: int, stations: Set[int]) -> bool:
    """Return whether a sender (system << 8 | component) is a ground station.

    Parameters
    ----------
    origin : int
        The sender.
    stations : set of int
        Senders whose heartbeats say so.
    """
    return origin >> 8 >= FIRST_GROUND_STATION or origin in stations


def is_command(frame: bytes, stations: Set[int]) -> bool:
    """Return whether a frame is a request to a vehicle, or feeds its navigation."""
    message_id = message_id_of(frame)
    if message_id in _FEEDING:
        return origin_of(frame)[1] != AUTOPILOT
    if message_id not in _ASKING:
        return False
    target = target_of(frame)[0]
    return target < FIRST_GROUND_STATION and target not in {s >> 8 for s in stations}


def telemetry_of(batch: Batch, begin: int, stations: Set[int]) -> IntArray:
    """Find the records that are neither from a station nor requests to a vehicle.

    Parameters
    ----------
    batch : Batch
        Records of a tlog.
    begin : int
        First of them to look at.
    stations : set of int
        Senders whose heartbeats said that they are ground stations.

    Returns
    -------
    ndarray of int
        Their numbers in the batch.
    """
    origins = batch.origins[begin:]
    kept = (origins >> 8 < FIRST_GROUND_STATION) & ~np.isin(origins, list(stations))
    for i in np.flatnonzero(kept & np.isin(batch.message_ids[begin:], _LOOKED_AT)).tolist():
        kept[i] = not is_command(batch.frame(begin + i), stations)
    found: IntArray = np.flatnonzero(kept) + begin
    return found
