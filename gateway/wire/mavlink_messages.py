"""Properties of each MAVLink message that a router needs: checksum seed, target, name.

The widest dialect serves here, since frames of any vehicle pass through; messages that it lacks are
forwarded unchecked.
"""

import struct
from functools import cache
from typing import Any, Final

import numpy as np
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

_HASH: Final = "(8,)u1"
MISSING: Final[dict[int, tuple[str, int, list[tuple[str, str]]]]] = {
    300: (
        "PROTOCOL_VERSION",
        217,
        [
            *(("version", "<u2"), ("min_version", "<u2"), ("max_version", "<u2")),
            *(("spec_version_hash", _HASH), ("library_version_hash", _HASH)),
        ],
    ),
    397: (
        "COMPONENT_METADATA",
        182,
        [("time_boot_ms", "<u4"), ("file_crc", "<u4"), ("uri", "S100")],
    ),
    512: (
        "CONTROL_STATUS",
        21,
        [("flags", "u1"), ("gcs_main", "u1"), ("gcs_secondary", "(10,)u1")],
    ),
}
"""Name, checksum seed and fields of messages that the dialects lack and a vehicle of the gateway
sends."""

NO_TARGET: Final = -1
MAX_ID_V1: Final = 255
"""Messages with greater ids do not exist in MAVLink 1."""
WIDEST: Final = 8
"""Bytes of the widest type of a field."""


@cache
def layout_of(message_id: int) -> np.dtype[np.void]:
    """Return a message's fields as they lie in its payload."""
    if message_id in MISSING:
        return np.dtype(MISSING[message_id][2])
    kind = dialect.mavlink_map[message_id]
    fields = []
    for name, code, length in zip(
        kind.ordered_fieldnames, kind.native_format[1:], kind.array_lengths, strict=True
    ):
        if chr(code) == "c":
            fields.append((name, f"S{max(1, length)}"))
        else:
            fields.append((name, f"({length},)<{chr(code)}" if length else f"<{chr(code)}"))
    return np.dtype(fields)


def offset_of(message_id: int, field: str) -> int:
    """Find where a field begins in the payload, or `NO_TARGET`."""
    fields = layout_of(message_id).fields
    return fields[field][1] if fields is not None and field in fields else NO_TARGET


CRC_EXTRA: Final[dict[int, bytes]] = {
    message_id: bytes((message.crc_extra,)) for message_id, message in dialect.mavlink_map.items()
} | {message_id: bytes((extra,)) for message_id, (_, extra, _) in MISSING.items()}
"""The byte that closes each message's checksum, as the checksum function wants it."""

TARGET_OFFSETS: Final[dict[int, tuple[int, int]]] = {
    message_id: (offset_of(message_id, "target_system"), offset_of(message_id, "target_component"))
    for message_id, message in dialect.mavlink_map.items()
    if "target_system" in message.fieldnames
} | {
    dialect.MAVLINK_MSG_ID_MANUAL_CONTROL: (
        offset_of(dialect.MAVLINK_MSG_ID_MANUAL_CONTROL, "target"),
        NO_TARGET,
    )
}
"""Payload offsets of target system and target component (`NO_TARGET` if it has none)."""

MESSAGE_NAMES: Final[dict[int, str]] = {
    message_id: message.msgname for message_id, message in dialect.mavlink_map.items()
} | {message_id: name for message_id, (name, *_) in MISSING.items()}

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
