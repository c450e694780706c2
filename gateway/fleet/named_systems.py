"""Systems that a message names within itself, beside its sender and the one that it addresses.

Some commands have a system id among their parameters: whom to follow, whom a camera looks at. They
come as a command or as an item of a mission. One message of gimbals names who steers them.
"""

import struct
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import all as dialect

from gateway.wire.mavlink_messages import offset_of
from gateway.wire.mavlink_splitter import START_V2, message_id_of

Change = tuple[int, bytes]
"""Where in the payload, and what there."""

COMMANDS: Final = {
    dialect.MAV_CMD_DO_FOLLOW: (1,),
    dialect.MAV_CMD_DO_SET_ROI_SYSID: (1,),
    dialect.MAV_CMD_DO_GUIDED_MASTER: (1,),
    dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE: (1, 3),
    dialect.MAV_CMD_ARM_AUTHORIZATION_REQUEST: (1,),
}
"""Which parameters are system ids."""
CARRIERS: Final[tuple[Any, ...]] = (
    dialect.MAVLink_command_long_message,
    dialect.MAVLink_command_int_message,
    dialect.MAVLink_mission_item_message,
    dialect.MAVLink_mission_item_int_message,
)
COMMAND_OFFSETS: Final = {message.id: offset_of(message, "command") for message in CARRIERS}
PARAM_OFFSETS: Final = {
    message.id: [offset_of(message, f"param{number}") for number in range(1, 5)]
    for message in CARRIERS
}
GIMBALS: Final[Any] = dialect.MAVLink_gimbal_manager_status_message
FIELD_OFFSETS: Final = {
    GIMBALS.id: [
        offset_of(GIMBALS, field) for field in ("primary_control_sysid", "secondary_control_sysid")
    ]
}
NAMING: Final = COMMAND_OFFSETS.keys() | FIELD_OFFSETS.keys()
"""Messages that may name a system."""
LAST_ID: Final = 255


def changes_of_names(frame: bytes, rename: Callable[[int], int]) -> list[Change]:
    """Return what is to be changed in a payload when systems have other ids.

    Parameters
    ----------
    frame : bytes
        A complete frame.
    rename : callable
        Turns the id of a system into its other one.
    """
    message_id = message_id_of(frame)
    if message_id not in NAMING:
        return []
    head, size = 10 if frame[0] == START_V2 else 6, frame[1]
    payload = frame[head : head + size]
    if message_id in FIELD_OFFSETS:
        return _bytes_changed(payload, FIELD_OFFSETS[message_id], rename)
    at = COMMAND_OFFSETS[message_id]
    # What MAVLink 2 has cut off at the end are zeros.
    command = int.from_bytes(payload[at : at + 2], "little")
    found: list[Change] = []
    for number in COMMANDS.get(command, ()):
        offset = PARAM_OFFSETS[message_id][number - 1]
        (value,) = struct.unpack_from("<f", payload, offset)
        if 0 < value <= LAST_ID and (fresh := rename(int(value))) != value:
            found.append((offset, struct.pack("<f", fresh)))
    return found


def _bytes_changed(
    payload: bytes, offsets: list[int], rename: Callable[[int], int]
) -> list[Change]:
    named = ((at, payload[at]) for at in offsets if at < len(payload) and payload[at])
    return [(at, bytes((rename(was),))) for at, was in named if rename(was) != was]
