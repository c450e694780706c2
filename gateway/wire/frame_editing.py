"""Edited frames: other values in the header or the payload, with the checksum computed again.

A signature covers the whole frame, so an edited frame loses its signature or is signed again. The
caller decides: without a decision a signed frame is not edited.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final

import numpy as np
from fastcrc.crc16 import mcrf4xx

from gateway.wire.mavlink_messages import CRC_EXTRA, MESSAGE_NAMES, layout_of
from gateway.wire.mavlink_splitter import (
    PAYLOAD_V1,
    PAYLOAD_V2,
    SEQUENCE_V1,
    SEQUENCE_V2,
    SIGNATURE_SIZE,
    SIGNED,
    START_V2,
    MavFrame,
    frame_of,
)

FLAGS: Final = 2
CRC_SIZE: Final = 2
NO_FIELDS: Final[Mapping[str, Any]] = {}

Sign = Callable[[bytes], bytes]
"""Returns the signature for the bytes of a frame before it, which end with the checksum."""


def edit_frame(
    frame: MavFrame,
    *,
    sequence: int | None = None,
    system: int | None = None,
    fields: Mapping[str, Any] = NO_FIELDS,
    sign: Sign | None = None,
    drop_signature: bool = False,
) -> MavFrame | None:
    """Return a frame of either version with other values.

    `fields` are those of the payload by name: a number, a text or bytes for an array of characters,
    and a number or a sequence for another array; extension fields are skipped in MAVLink 1. `sign`
    signs the edited frame, but for MAVLink 1, which has no signatures; without it a signed frame
    becomes an unsigned one by `drop_signature`.

    None if the frame cannot be edited: its message is unknown, so that its checksum cannot be
    computed, or it is signed and would keep a wrong signature. Raises ValueError if the message has
    no such field, or a value does not fit it.
    """
    message_id, data = frame.message_id, frame.data
    extra = CRC_EXTRA.get(message_id)
    if extra is None or (frame.signed and sign is None and not drop_signature):
        return None
    is_v2 = data[0] == START_V2
    content = bytearray(data[: -CRC_SIZE - SIGNATURE_SIZE * frame.signed])
    at = SEQUENCE_V2 if is_v2 else SEQUENCE_V1
    if sequence is not None:
        content[at] = sequence
    if system is not None:
        content[at + 1] = system
    if fields:
        _write(content, message_id, fields)
    if is_v2:
        content[FLAGS] = SIGNED if sign is not None else 0
    edited = bytes(content)
    edited += mcrf4xx(edited[1:] + extra).to_bytes(CRC_SIZE, "little")
    return frame_of(edited + sign(edited) if is_v2 and sign is not None else edited)


def renumbered(frame: MavFrame, sequence: int) -> MavFrame:
    """Return a frame with another sequence number; unchanged if signed or of an unknown message.

    The same as `edit_frame` in a third of the time: a client's filter renumbers most of our frames.
    """
    data, extra = frame.data, CRC_EXTRA.get(frame.message_id)
    if extra is None or frame.signed:
        return frame
    at = SEQUENCE_V2 if data[0] == START_V2 else SEQUENCE_V1
    content = data[1:at] + sequence.to_bytes() + data[at + 1 : -CRC_SIZE]
    data = data[:1] + content + mcrf4xx(content + extra).to_bytes(CRC_SIZE, "little")
    return MavFrame(data, frame.key, frame.message_id, frame.origin, frame.target, sequence, False)


def _write(content: bytearray, message_id: int, fields: Mapping[str, Any]) -> None:
    """Write fields into a frame without checksum; truncated zeros of version 2 are added again."""
    is_v2 = content[0] == START_V2
    begin, size = PAYLOAD_V2 if is_v2 else PAYLOAD_V1, len(content)
    for name, value in fields.items():
        offset, packed = _packed(message_id, name, value)
        end = begin + offset + len(packed)
        if end > len(content):
            if not is_v2:
                continue
            content.extend(bytes(end - len(content)))
        content[begin + offset : end] = packed
    while len(content) > size and not content[-1]:
        content.pop()
    content[1] = len(content) - begin


def _packed(message_id: int, name: str, value: Any) -> tuple[int, bytes]:
    """Return the offset of a field in the payload, and its value as bytes."""
    offset, kind, shape = _field(message_id, name)
    try:
        values = np.array(value, kind)
        packed = (np.broadcast_to(values, shape) if values.shape != shape else values).tobytes()
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{MESSAGE_NAMES[message_id]}.{name}: {value!r}: {error}") from None
    return offset, packed


@cache
def _field(message_id: int, name: str) -> tuple[int, np.dtype[Any], tuple[int, ...]]:
    layout = layout_of(message_id)
    if layout.fields is None or name not in layout.fields:
        raise ValueError(f"{MESSAGE_NAMES[message_id]} has no field {name}")
    kind, offset = layout.fields[name][:2]
    return offset, kind.base, kind.shape
