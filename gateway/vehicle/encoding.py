"""Messages to MAVLink 2 frames: field values, messages that pymavlink lacks, and the encoder.

A MAVLink integer field often reserves its greatest value for "unknown". The functions for fields
take the value to send in that case, and saturate one below it, so that a too large value is never
read as unknown.
"""

import math
import struct
from operator import itemgetter
from typing import Any, Final

import msgspec
from fastcrc.crc16 import mcrf4xx

from gateway.records import EVERYBODY, START_V2, MavFrame, Outgoing
from gateway.wire.mavlink_messages import INTEGER_LIMITS, TARGET_OFFSETS

INT16_MAX: Final = 2**15 - 1
INT32_MAX: Final = 2**31 - 1
UINT8_MAX: Final = 2**8 - 1
UINT16_MAX: Final = 2**16 - 1
UINT32_MAX: Final = 2**32 - 1
FLOAT32_MAX: Final = 3.402_823_4e38
AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: clients look for a vehicle under no other component id."""
_pack_head: Final = struct.Struct("<BBBBB5s").pack
"""Head of a frame: start, length, two flag bytes, sequence, and the key (system, component and
message)."""
_KEY: Final = struct.Struct("<BBHB")


def whole(value: float, low: int, high: int, unknown: int) -> int:
    """Round to an integer field from `low` to `high`; NaN is sent as `unknown`."""
    if math.isnan(value):
        return unknown
    if value <= low:
        return low
    if value >= high:
        return high
    return round(value)


def uint8(value: float, unknown: int = UINT8_MAX) -> int:
    """Fit an unsigned byte whose 255 may mean unknown."""
    return whole(value, 0, UINT8_MAX - (unknown == UINT8_MAX), unknown)


def uint16(value: float, unknown: int = UINT16_MAX) -> int:
    """Fit an unsigned 16-bit field whose 65535 may mean unknown."""
    return whole(value, 0, UINT16_MAX - (unknown == UINT16_MAX), unknown)


def int16(value: float) -> int:
    """Fit a signed 16-bit field, which has no value for unknown; it gets 0."""
    return whole(value, -INT16_MAX - 1, INT16_MAX, 0)


def int32(value: float) -> int:
    """Fit a signed 32-bit field, which has no value for unknown; it gets 0."""
    return whole(value, -INT32_MAX - 1, INT32_MAX, 0)


def uint32(value: float) -> int:
    """Fit an unsigned 32-bit field; as an extension field its 0 means unknown."""
    return whole(value, 0, UINT32_MAX, 0)


def compass_cdeg(angle_rad: float) -> int:
    """Convert an angle from north to 0 to 35999 hundredths of a degree, 65535 if unknown."""
    if not math.isfinite(angle_rad):
        return UINT16_MAX
    return round(math.degrees(angle_rad) * 100.0) % 36000


def compass_deg(angle_rad: float) -> int:
    """Convert a known angle from north to 0 to 359 whole degrees."""
    return round(math.degrees(angle_rad)) % 360


class MessagePacker:
    """Packs one kind of message from its values, without pymavlink's message object.

    Building and packing that object takes three times as long. A text is `bytes`.
    """

    __slots__ = ("crc_extra", "message_id", "name", "pack", "types", "wire_order")

    def __init__(self, kind: Any) -> None:
        types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
        lengths = {
            name: 1 if types[name] == "char" else length or 1
            for name, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True)
        }
        elements = [(name, n) for name in kind.fieldnames for n in range(lengths[name])]
        wire = [(name, n) for name in kind.ordered_fieldnames for n in range(lengths[name])]
        self.message_id: int = kind.id
        self.name: str = kind.msgname
        self.crc_extra: int = kind.crc_extra
        self.pack = kind.unpacker.pack
        self.wire_order = itemgetter(*(elements.index(element) for element in wire))
        self.types = [types[name] for name, _ in elements]

    def __call__(self, *values: Any) -> "PackedMessage":
        """Make a message of its values in the order of the definition, arrays flattened."""
        return PackedMessage(self, values)


class PackedMessage(msgspec.Struct, frozen=True, gc=False):
    """The values of one message, not yet packed."""

    packer: MessagePacker
    values: tuple[Any, ...]

    def get_type(self) -> str:
        """Return the message's name, as pymavlink's messages do."""
        return self.packer.name

    def payload(self) -> bytes:
        """Pack the values; one beyond its field's range is saturated."""
        packer = self.packer
        try:
            packed: bytes = packer.pack(*packer.wire_order(self.values))
        except (struct.error, OverflowError):
            fitted = tuple(map(_fit, self.values, packer.types))
            packed = packer.pack(*packer.wire_order(fitted))
        return packed


class Encoder:
    """Frames of one component; one sequence for all its messages."""

    def __init__(self, system_id: int, component_id: int = AUTOPILOT_COMPONENT) -> None:
        """Start the sequence."""
        self.system_id = system_id
        self._origin = (system_id, component_id)
        self._keys: dict[int, bytes] = {}
        """System, component and message as in a frame, by message id."""
        self._sequence = 0

    def encode(self, message: Any, client_id: int | None = None) -> Outgoing:
        """Build the MAVLink 2 frame of one message, for the client that it answers, or for all.

        A number beyond its field's range is saturated, so that no measurement can stop the
        telemetry.
        """
        if isinstance(message, PackedMessage):
            packer = message.packer
            message_id = packer.message_id
            frame = self._frame(message_id, packer.crc_extra, message.payload())
        else:
            # Not message.id: HIGHRES_IMU and others have a field of that name.
            message_id = message.get_msgId()
            # pymavlink packs the payload; header and checksum would take it six times as long.
            message._pack = self._frame  # noqa: SLF001
            try:
                frame = message.pack(message_id)
            except (struct.error, OverflowError):
                _saturate(message)
                frame = message.pack(message_id)
        header, sequence = None, self._sequence
        self._sequence = sequence + 1 & 0xFF
        if message_id not in TARGET_OFFSETS:
            key = self._keys[message_id]
            header = MavFrame(frame, key, message_id, self._origin, EVERYBODY, sequence, False)
        return Outgoing(frame, message_id, client_id, header)

    def _frame(
        self, message_id: int, crc_extra: int, payload: bytes, *, force_mavlink1: bool = False
    ) -> bytes:
        """Add header and checksum to a payload; `force_mavlink1` is a parameter of pymavlink."""
        del force_mavlink1
        body = payload.rstrip(b"\0") or payload[:1]
        key = self._keys.get(message_id)
        if key is None:
            key = _KEY.pack(*self._origin, message_id & 0xFFFF, message_id >> 16)
            self._keys[message_id] = key
        content = _pack_head(START_V2, len(body), 0, 0, self._sequence, key) + body
        crc = mcrf4xx(content[1:] + crc_extra.to_bytes())
        return content + crc.to_bytes(2, "little")


def _saturate(message: Any) -> None:
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        value = getattr(message, name)
        if isinstance(value, list | tuple):
            setattr(message, name, [_fit(item, kind) for item in value])
        elif isinstance(value, int | float):
            setattr(message, name, _fit(value, kind))


def _fit(value: float, kind: str) -> float:
    if kind in INTEGER_LIMITS:
        low, high = INTEGER_LIMITS[kind]
        return 0 if math.isnan(value) else int(max(low, min(high, value)))
    if math.isfinite(value) and kind == "float":
        return max(-FLOAT32_MAX, min(FLOAT32_MAX, value))
    return value
