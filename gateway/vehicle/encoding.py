"""Messages to MAVLink 2 frames: field values, messages that pymavlink lacks, and the encoder.

A MAVLink integer field often reserves its greatest value for "unknown". The functions for fields
take the value to send in that case, and saturate one below it, so that a too large value is never
read as unknown.

Two messages of the standard and one of its development dialect are missing in pymavlink. Clients
request them nevertheless; PROTOCOL_VERSION decides whether QGroundControl uses MAVLink 2. Each has
the layout of the generator: larger fields first, and a CRC seeded by the definition.
"""

import math
import struct
from operator import itemgetter
from typing import Any, ClassVar, Final

import msgspec
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as mavlink

from gateway import __version__
from gateway.records import EVERYBODY, START_V2, MavFrame, Outgoing

INT16_MAX: Final = 2**15 - 1
INT32_MAX: Final = 2**31 - 1
UINT8_MAX: Final = 2**8 - 1
UINT16_MAX: Final = 2**16 - 1
UINT32_MAX: Final = 2**32 - 1
FLOAT32_MAX: Final = 3.402_823_4e38
MAVLINK_MSG_ID_PROTOCOL_VERSION: Final = 300
MAVLINK_MSG_ID_COMPONENT_METADATA: Final = 397
MAVLINK_MSG_ID_CONTROL_STATUS: Final = 512
_Base: Any = mavlink.MAVLink_message
AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: clients look for a vehicle under no other component id."""
_pack_head: Final = struct.Struct("<BBBBB5s").pack
"""Head of a frame: start, length, two flag bytes, sequence, and the key (system, component and
message)."""
_KEY: Final = struct.Struct("<BBHB")
_INTEGER_LIMITS: Final = {
    "int8_t": (-(2**7), 2**7 - 1),
    "int16_t": (-(2**15), 2**15 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "int64_t": (-(2**63), 2**63 - 1),
    "uint8_t": (0, 2**8 - 1),
    "uint16_t": (0, 2**16 - 1),
    "uint32_t": (0, 2**32 - 1),
    "uint64_t": (0, 2**64 - 1),
}
CAPABILITIES: Final = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)
MODE_NAME: Final = "Tracking"
MAX_MODE_NAME: Final = 34
AUTOPILOTS: Final[dict[str, int]] = {
    "generic": mavlink.MAV_AUTOPILOT_GENERIC,
    "ardupilotmega": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    "px4": mavlink.MAV_AUTOPILOT_PX4,
}
"""MAV_AUTOPILOT by the setting `autopilot`."""
CUSTOM_MODES: Final[dict[int, int]] = {
    mavlink.MAV_AUTOPILOT_GENERIC: 0,
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: 0,
    mavlink.MAV_AUTOPILOT_PX4: 1 << 16,
}
"""Mode in which a pilot flies manually: MANUAL or STABILIZE of ArduPilot, main mode 1 of PX4."""
UID_PREFIX: Final = int.from_bytes(b"mavgate")


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


class _Extra(_Base):  # type: ignore[misc]
    """A message packed from its fields in wire order."""

    id: ClassVar[int]
    msgname: ClassVar[str]
    crc_extra: ClassVar[int]
    unpacker: ClassVar[struct.Struct]
    fieldnames: ClassVar[list[str]] = []
    fieldtypes: ClassVar[list[str]] = []

    def __init__(self, *wire_values: Any) -> None:
        super().__init__(self.id, self.msgname)
        self.wire_values = wire_values

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """Build the frame; the ids of these messages do not fit MAVLink 1."""
        payload = self.unpacker.pack(*self.wire_values)
        frame: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1)
        return frame


class ProtocolVersion(_Extra):
    """PROTOCOL_VERSION: version, min_version, max_version, and two library hashes."""

    id = MAVLINK_MSG_ID_PROTOCOL_VERSION
    msgname = "PROTOCOL_VERSION"
    crc_extra = 217
    unpacker = struct.Struct("<HHH8s8s")


class ComponentMetadata(_Extra):
    """COMPONENT_METADATA: time_boot_ms, file_crc, uri."""

    id = MAVLINK_MSG_ID_COMPONENT_METADATA
    msgname = "COMPONENT_METADATA"
    crc_extra = 182
    unpacker = struct.Struct("<II100s")


class ControlStatus(_Extra):
    """CONTROL_STATUS: flags, gcs_main, gcs_secondary."""

    id = MAVLINK_MSG_ID_CONTROL_STATUS
    msgname = "CONTROL_STATUS"
    crc_extra = 21
    unpacker = struct.Struct("<BB10s")


class MessagePacker:
    """Packs one kind of message from its values, without pymavlink's message object.

    Building and packing that object takes three times as long. All fields of the message must be
    numbers or arrays of numbers.
    """

    __slots__ = ("crc_extra", "has_target", "message_id", "name", "pack", "types", "wire_order")

    def __init__(self, kind: Any) -> None:
        lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
        elements = [(name, n) for name in kind.fieldnames for n in range(lengths[name] or 1)]
        wire = [(name, n) for name in kind.ordered_fieldnames for n in range(lengths[name] or 1)]
        types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
        self.message_id: int = kind.id
        self.name: str = kind.msgname
        self.crc_extra: int = kind.crc_extra
        self.has_target = _has_target(kind)
        self.pack = kind.unpacker.pack
        self.wire_order = itemgetter(*(elements.index(element) for element in wire))
        self.types = [types[name] for name, _ in elements]

    def __call__(self, *values: float) -> "PackedMessage":
        """Make a message of its values in the order of the definition, arrays flattened."""
        return PackedMessage(self, values)


class PackedMessage(msgspec.Struct, frozen=True, gc=False):
    """The values of one message, not yet packed."""

    packer: MessagePacker
    values: tuple[float, ...]

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
            message_id, has_target = packer.message_id, packer.has_target
            frame = self._frame(message_id, packer.crc_extra, message.payload())
            return self._outgoing(frame, message_id, client_id, has_target)
        # Not message.id: HIGHRES_IMU and others have a field of that name.
        message_id = message.get_msgId()
        # pymavlink packs the payload; header and checksum would take it six times as long as here.
        message._pack = self._frame  # noqa: SLF001
        try:
            frame = message.pack(message_id)
        except (struct.error, OverflowError):
            _saturate(message)
            frame = message.pack(message_id)
        return self._outgoing(frame, message_id, client_id, _has_target(message))

    def _outgoing(
        self, frame: bytes, message_id: int, client_id: int | None, has_target: bool
    ) -> Outgoing:
        """Advance the sequence, and return the frame with its header for the hub."""
        header, sequence = None, self._sequence
        self._sequence = sequence + 1 & 0xFF
        if not has_target:
            key = self._keys[message_id]
            header = MavFrame(frame, key, message_id, self._origin, EVERYBODY, sequence, False)
        return Outgoing(frame, message_id, client_id, header)

    def _frame(
        self, message_id: int, crc_extra: int, payload: bytes, *, force_mavlink1: bool = False
    ) -> bytes:
        """Add header and checksum to a payload; `force_mavlink1` is a parameter of pymavlink."""
        del force_mavlink1
        body = payload.rstrip(b"\0") or payload[:1]
        key = self._keys.get(message_id) or self._make_key(message_id)
        content = _pack_head(START_V2, len(body), 0, 0, self._sequence, key) + body
        crc = mcrf4xx(content[1:] + crc_extra.to_bytes())
        return content + crc.to_bytes(2, "little")

    def _make_key(self, message_id: int) -> bytes:
        key = _KEY.pack(*self._origin, message_id & 0xFFFF, message_id >> 16)
        self._keys[message_id] = key
        return key


def _has_target(message: Any) -> bool:
    """Return whether a message may be addressed to a system."""
    return any(name.startswith("target") for name in message.fieldnames)


def _saturate(message: Any) -> None:
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        value = getattr(message, name)
        if isinstance(value, list | tuple):
            setattr(message, name, [_fit(item, kind) for item in value])
        elif isinstance(value, int | float):
            setattr(message, name, _fit(value, kind))


def _fit(value: float, kind: str) -> float:
    if kind in _INTEGER_LIMITS:
        low, high = _INTEGER_LIMITS[kind]
        return 0 if math.isnan(value) else int(max(low, min(high, value)))
    if math.isfinite(value) and kind == "float":
        return max(-FLOAT32_MAX, min(FLOAT32_MAX, value))
    return value


def software_version(version: str) -> int:
    """Pack major, minor and patch into the upper three bytes, and the type into the lowest one."""
    parts = [int(part) if part.isdigit() else 0 for part in version.split(".")[:3]]
    major, minor, patch = (*parts, 0, 0, 0)[:3]
    kind: int = mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
    return major << 24 | minor << 16 | patch << 8 | kind


def autopilot_version(system_id: int, firmware: int, autopilot: int) -> Any:
    """Encode AUTOPILOT_VERSION; the uid is different for each vehicle of one gateway.

    The version of the nodes' firmware is in the field of the operating system's version. All
    parameters are floats, so that they have the same bytes in both encodings of integers; clients
    of ArduPilot expect the C cast.
    """
    nothing = [0] * 8
    encoding = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    if autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        encoding = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    return mavlink.MAVLink_autopilot_version_message(
        capabilities=CAPABILITIES | encoding,
        flight_sw_version=software_version(__version__),
        middleware_sw_version=0,
        os_sw_version=firmware,
        board_version=0,
        flight_custom_version=nothing,
        middleware_custom_version=nothing,
        os_custom_version=nothing,
        vendor_id=0,
        product_id=0,
        uid=UID_PREFIX << 8 | system_id,
    )


def protocol_version() -> Any:
    """Encode PROTOCOL_VERSION: both versions are read, version 2 is sent."""
    return ProtocolVersion(200, 100, 200, b"", b"")


def available_modes(mode: tuple[int, str]) -> Any:
    """Encode AVAILABLE_MODES: the one mode that a tracker has, or that is reported."""
    return mavlink.MAVLink_available_modes_message(
        number_modes=1,
        mode_index=1,
        standard_mode=mavlink.MAV_STANDARD_MODE_NON_STANDARD,
        custom_mode=mode[0],
        properties=mavlink.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE,
        mode_name=mode[1].encode()[:MAX_MODE_NAME],
    )


def current_mode(mode: tuple[int, str]) -> Any:
    """Encode CURRENT_MODE."""
    return mavlink.MAVLink_current_mode_message(
        standard_mode=mavlink.MAV_STANDARD_MODE_NON_STANDARD,
        custom_mode=mode[0],
        intended_custom_mode=0,
    )
