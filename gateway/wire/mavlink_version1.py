"""MAVLink 2 frames for programs and devices that know only MAVLink 1.

Message ids above 255 do not exist in MAVLink 1. Extension fields are cut off: they were added after
the message was defined, so the checksum seed covers only the fields before them, which shows where
they begin. Signatures do not exist either.

References
----------
.. [1] https://mavlink.io/en/guide/serialization.html
"""

import struct
from functools import cache
from typing import Any, Final

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_splitter import (
    OVERHEAD_V2,
    PAYLOAD_V2,
    START_V1,
    START_V2,
    message_id_of,
)

MAX_ID: Final = 255
WIDEST: Final = 8
"""Bytes of the widest type of a field."""


def to_mavlink1(frame: bytes) -> bytes | None:
    """Encode a frame as MAVLink 1.

    Parameters
    ----------
    frame : bytes
        A whole frame of either version.

    Returns
    -------
    bytes or None
        None if MAVLink 1 cannot carry the message, or its definition is not known.
    """
    if frame[0] != START_V2:
        return frame
    message_id = message_id_of(frame)
    size = base_size(message_id)
    if size is None:
        return None
    length = min(frame[1], len(frame) - OVERHEAD_V2)
    payload = frame[PAYLOAD_V2 : PAYLOAD_V2 + min(length, size)].ljust(size, b"\0")
    content = bytes((size, frame[4], frame[5], frame[6], message_id)) + payload
    crc = mcrf4xx(content + CRC_EXTRA[message_id])
    return bytes((START_V1,)) + content + crc.to_bytes(2, "little")


@cache
def base_size(message_id: int) -> int | None:
    """Return the size of a message without its extensions; None if MAVLink 1 lacks it."""
    message: Any = dialect.mavlink_map.get(message_id)
    if message is None or message_id > MAX_ID:
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
