"""Messages of the standard that pymavlink's dialects lack.

Clients request them all the same, and one of them, PROTOCOL_VERSION, decides whether
QGroundControl uses MAVLink 2. Each is laid out as the standard's generator does it: larger fields
first, and a CRC seeded by the definition.
"""

import struct
from typing import Any, ClassVar, Final

from pymavlink.dialects.v20 import all as mavlink

MAVLINK_MSG_ID_PROTOCOL_VERSION: Final = 300
MAVLINK_MSG_ID_COMPONENT_METADATA: Final = 397
MAVLINK_MSG_ID_CONTROL_STATUS: Final = 512

_Base: Any = mavlink.MAVLink_message


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
        """Build the frame; these ids do not fit MAVLink 1."""
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
