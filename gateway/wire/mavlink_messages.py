"""Properties of each MAVLink message that a router needs: checksum seed, target, name.

The widest dialect serves here, since frames of any vehicle pass through; messages that it lacks are
forwarded unchecked.
"""

import struct
from functools import cache
from typing import Any, Final

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

MISSING: Final = {
    300: ("PROTOCOL_VERSION", 217),
    397: ("COMPONENT_METADATA", 182),
    512: ("CONTROL_STATUS", 21),
}
"""Name and checksum seed of messages that the dialects lack and a vehicle of the gateway sends."""

NO_TARGET: Final = -1
MAX_ID_V1: Final = 255
"""Messages with greater ids do not exist in MAVLink 1."""
WIDEST: Final = 8
"""Bytes of the widest type of a field."""


def offset_of(message: Any, field: str) -> int:
    """Find where a field begins in the payload, or `NO_TARGET`."""
    offset = 0
    for name, code, length in zip(
        message.ordered_fieldnames, message.native_format[1:], message.array_lengths, strict=True
    ):
        if name == field:
            return offset
        offset += struct.calcsize("<" + chr(code)) * max(1, length)
    return NO_TARGET


CRC_EXTRA: Final[dict[int, bytes]] = {
    message_id: bytes((message.crc_extra,)) for message_id, message in dialect.mavlink_map.items()
} | {message_id: bytes((extra,)) for message_id, (_, extra) in MISSING.items()}
"""The byte that closes each message's checksum, as the checksum function wants it."""

TARGET_OFFSETS: Final[dict[int, tuple[int, int]]] = {
    message_id: (system, offset_of(message, "target_component"))
    for message_id, message in dialect.mavlink_map.items()
    if (system := offset_of(message, "target_system")) != NO_TARGET
} | {
    dialect.MAVLINK_MSG_ID_MANUAL_CONTROL: (
        offset_of(dialect.MAVLink_manual_control_message, "target"),
        NO_TARGET,
    )
}
"""Payload offsets of target system and target component (`NO_TARGET` if it has none)."""

MESSAGE_NAMES: Final[dict[int, str]] = {
    message_id: message.msgname for message_id, message in dialect.mavlink_map.items()
} | {message_id: name for message_id, (name, _) in MISSING.items()}

MESSAGE_IDS: Final[dict[str, int]] = {name: number for number, name in MESSAGE_NAMES.items()}


@cache
def base_size(message_id: int) -> int | None:
    """Return the size of a message without its extensions; None if MAVLink 1 lacks it.

    Extension fields were added after the message was defined, so the checksum seed covers only the
    fields before them, which shows where they begin.
    """
    message: Any = dialect.mavlink_map.get(message_id)
    if message is None or message_id > MAX_ID_V1:
        return None
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    seed = mcrf4xx(f"{message.msgname} ".encode())
    size, found = 0, None
    last = WIDEST
    for name, code, length in zip(
        message.ordered_fieldnames, message.native_format[1:], message.array_lengths, strict=True
    ):
        width = struct.calcsize(f"<{chr(code)}")
        if width > last:
            # The fields of the first definition are in descending order of their width.
            break
        last = width
        seed = mcrf4xx(f"{types[name]} {name} ".encode(), seed)
        seed = mcrf4xx(bytes((length,)), seed) if length else seed
        size += width * max(1, length)
        if (seed & 0xFF) ^ (seed >> 8) == message.crc_extra:
            found = size
    return found
