"""Properties of each MAVLink message that a router needs: checksum seed, target, name.

The largest dialect is used, since frames of any vehicle pass through; messages that it lacks are
forwarded unchecked.
"""

import struct
from functools import cache
from typing import Any, Final

import numpy as np
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from gateway.records import MavFrame

_TYPES: Final = {"uint8_t": "B", "uint16_t": "H", "uint32_t": "I", "char": "c"}
INTEGER_LIMITS: Final = {
    f"{sign}int{bits}_t": (0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for sign in ("u", "")
    for bits in (8, 16, 32, 64)
}
"""Minimum and maximum value by type of a field."""
NO_TARGET: Final = -1
MAX_ID_V1: Final = 255
"""Largest message id of MAVLink 1."""
WIDEST: Final = 8
"""Size of the largest type of a field, bytes."""
US_PER_MS: Final = 1000
BOOT_TIME_BYTES: Final = 4


class MissingMessage:
    """The definition of a message that the dialects lack, with the attributes of pymavlink's.

    Fields are in the order of the payload: name, type, and length of an array or 0.
    """

    def __init__(
        self, number: int, name: str, crc_extra: int, *fields: tuple[str, str, int]
    ) -> None:
        names, types, lengths = zip(*fields, strict=True)
        self.id, self.msgname, self.crc_extra = number, name, crc_extra
        sizes = (f"{n}s" if one == "char" else f"{n or 1}{_TYPES[one]}" for _, one, n in fields)
        self.unpacker = struct.Struct("<" + "".join(sizes))
        self.fieldnames, self.ordered_fieldnames = list(names), list(names)
        self.fieldtypes, self.array_lengths = list(types), list(lengths)
        self.native_format = bytearray("<" + "".join(_TYPES[one] for one in types), "ascii")
        self.fieldunits_by_name: dict[str, str] = {}
        self.fieldenums_by_name: dict[str, str] = {}


PROTOCOL_VERSION: Final = MissingMessage(
    300, "PROTOCOL_VERSION", 217, ("version", "uint16_t", 0), ("min_version", "uint16_t", 0),
    ("max_version", "uint16_t", 0), ("spec_version_hash", "uint8_t", 8),
    ("library_version_hash", "uint8_t", 8),
)  # fmt: skip
COMPONENT_METADATA: Final = MissingMessage(
    397, "COMPONENT_METADATA", 182, ("time_boot_ms", "uint32_t", 0), ("file_crc", "uint32_t", 0),
    ("uri", "char", 100),
)  # fmt: skip
CONTROL_STATUS: Final = MissingMessage(
    512, "CONTROL_STATUS", 21, ("flags", "uint8_t", 0), ("gcs_main", "uint8_t", 0),
    ("gcs_secondary", "uint8_t", 10),
)  # fmt: skip
MISSING: Final = {kind.id: kind for kind in (PROTOCOL_VERSION, COMPONENT_METADATA, CONTROL_STATUS)}
"""Messages that vehicles of the gateway send and the dialects lack."""

DEFINITIONS: Final[dict[int, Any]] = {**dialect.mavlink_map, **MISSING}
"""All known messages by id: name and fields in the layout of pymavlink."""


@cache
def layout_of(message_id: int) -> np.dtype[np.void]:
    """Return the layout of a message's fields in its payload."""
    kind = DEFINITIONS[message_id]
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
    """Return the offset of a field in the payload, or `NO_TARGET`."""
    fields = layout_of(message_id).fields
    return fields[field][1] if fields is not None and field in fields else NO_TARGET


CRC_EXTRA: Final[dict[int, bytes]] = {
    message_id: bytes((message.crc_extra,)) for message_id, message in DEFINITIONS.items()
}
"""The last byte of each message's checksum input (CRC_EXTRA), as `bytes`."""

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
    message_id: message.msgname for message_id, message in DEFINITIONS.items()
}

MESSAGE_IDS: Final[dict[str, int]] = {name: number for number, name in MESSAGE_NAMES.items()}
HEARTBEAT_ID: Final = MESSAGE_IDS["HEARTBEAT"]


def ids_of(*names: str) -> frozenset[int]:
    """Return the ids of messages by their names."""
    return frozenset(MESSAGE_IDS[name] for name in names)


BOOT_TIME_OFFSETS: Final = {
    message_id: offset
    for message_id in MESSAGE_NAMES
    if (offset := offset_of(message_id, "time_boot_ms")) != NO_TARGET
}
"""Offsets of the field with the time since the start of the sender, in ms, by message."""


def boot_time_us(frame: MavFrame, now_us: int) -> int | None:
    """Compute when the sender of a frame started; None if the frame does not contain it."""
    offset = BOOT_TIME_OFFSETS.get(frame.message_id)
    if offset is None:
        return None
    time_ms = int.from_bytes(frame.payload[offset : offset + BOOT_TIME_BYTES], "little")
    # 0 means that the sender has no such time.
    return now_us - time_ms * US_PER_MS if time_ms else None


@cache
def base_size(message_id: int) -> int | None:
    """Return the size of a message without its extensions; None if MAVLink 1 lacks it.

    Extension fields were added after the message was defined, so the checksum seed covers only the
    fields before them, from which their begin is found.
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
