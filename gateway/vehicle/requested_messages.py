"""Requests of single messages: MAV_CMD_REQUEST_MESSAGE and the older commands.

Where a vehicle has several messages of one type, a request selects among them by further
parameters. The descriptions of MAVLink's messages define which field they select by:

| message                                      | parameters from the second on      | all |
| -------------------------------------------- | ---------------------------------- | --- |
| AVAILABLE_MODES                              | index                              | 0   |
| STORAGE_INFORMATION                          | storage                            | 0   |
| VIDEO_STREAM_INFORMATION and …_STATUS, CAMERA_THERMAL_RANGE | stream, camera      | 0   |
| other messages of a camera                   | camera that an autopilot drives    | 0   |
| CAMERA_IMAGE_CAPTURED                        | first and last number              | -1  |
| MISSION_CHECKSUM                             | type of plan                       |     |
| MESSAGE_INTERVAL                             | message                            |     |
| others with a field that numbers an instance | that number                        | 0   |
"""

import math
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.mavlink_messages import PROTOCOL_VERSION

REQUEST_MESSAGE: Final = mavlink.MAV_CMD_REQUEST_MESSAGE
CAPTURED: Final = mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED
ALL_IMAGES: Final = -1
_INDEXED: Final = {
    mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION,
    mavlink.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE: CAPTURED,
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: (
        mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
    ),
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS,
}
"""Older commands whose first parameter selects among the messages."""
SHORTHANDS: Final = _INDEXED | {
    mavlink.MAV_CMD_GET_HOME_POSITION: mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: PROTOCOL_VERSION.id,
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION,
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS,
    mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS,
    mavlink.MAV_CMD_REQUEST_FLIGHT_INFORMATION: mavlink.MAVLINK_MSG_ID_FLIGHT_INFORMATION,
}
"""Older commands for single messages."""

_CAMERA: Final = "camera_device_id"
_FIELDS: Final = {
    "AVAILABLE_MODES": ("mode_index",),
    "GIMBAL_DEVICE_INFORMATION": ("gimbal_device_id",),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": ("gimbal_device_id",),
    "RAW_RPM": ("index",),
    "CAMERA_IMAGE_CAPTURED": ("image_index",),
    "MISSION_CHECKSUM": ("mission_type",),
    "MESSAGE_INTERVAL": ("message_id",),
}
"""Fields with such a number that the dialect does not mark as one of an instance."""
_EXACT: Final = (
    mavlink.MAVLINK_MSG_ID_MISSION_CHECKSUM, mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL,
)  # fmt: skip
"""Messages of which no value selects all."""


DISTINGUISHED_BY: Final[dict[int, tuple[str, ...]]] = {
    message_id: fields for message_id, kind in mavlink.mavlink_map.items()
    if (fields := (
        *_FIELDS.get(kind.msgname, (kind.instance_field,) if kind.instance_field else ()),
        *((_CAMERA,) if _CAMERA in kind.fieldnames else ()),
    ))
}  # fmt: skip
"""Fields that distinguish messages of one type and sender, by message id."""


class MessageRequest(NamedTuple):
    """A request for a message."""

    message_id: int
    selectors: tuple[float, ...] = ()
    """Values that select among the messages of this type; those that are left out are 0."""

    def selects(self, message: Any) -> bool:
        """Return whether a message of the requested type is selected; a missing field is 0."""
        first, second, *_ = [*map(whole, self.selectors), 0, 0]
        if self.message_id == CAPTURED:
            number, last = message.image_index, second or first
            is_within = first <= number and (number <= last or last == ALL_IMAGES)
            return first == ALL_IMAGES or is_within
        fields = DISTINGUISHED_BY.get(self.message_id, ())
        return all(
            getattr(message, field, 0) == wanted
            for field, wanted in zip(fields, (first, second), strict=False)
            if wanted or self.message_id in _EXACT
        )


def whole(value: float) -> int:
    """Read an integer parameter; NaN is 0."""
    return round(value) if math.isfinite(value) else 0


def read_request(number: int, params: tuple[float, ...]) -> MessageRequest | None:
    """Read a command with its parameters; None if it does not request a message."""
    if number == REQUEST_MESSAGE:
        return MessageRequest(whole(params[0]), params[1:3])
    message_id = SHORTHANDS.get(number)
    if message_id is None:
        return None
    return MessageRequest(message_id, params[:1] if number in _INDEXED else ())
