"""MAVLink messages to frames of one system, numbered in the order they are sent."""

import math
import struct
from typing import Any, Final

from fastcrc.crc16 import mcrf4xx

from gateway.records import Outgoing
from gateway.vehicle.telemetry.fields import FLOAT32_MAX

AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: clients look for a vehicle under no other component id."""

_START: Final = b"\xfd"
_HEAD: Final = struct.Struct("<BBBBBBHB")
"""Length, two flag bytes, sequence, system, component, message id in three bytes."""
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


class Encoder:
    """Frames of one system id; one sequence for all its messages."""

    def __init__(self, system_id: int) -> None:
        """Start the sequence."""
        self.system_id = system_id
        self._sequence = 0

    def encode(self, message: Any, client_id: int | None = None) -> Outgoing:
        """Build the MAVLink 2 frame of one message.

        Parameters
        ----------
        message : MAVLink_message
            Any message of the dialect. A number beyond its field's range is saturated, so that no
            measurement can stop the telemetry.
        client_id : int, optional
            The one client it answers.

        Returns
        -------
        Outgoing
        """
        # Not message.id: HIGHRES_IMU and others have a field of that name.
        message_id = message.get_msgId()
        # pymavlink packs the payload; header and checksum would take it six times as long as here.
        message._pack = self._frame  # noqa: SLF001
        try:
            frame = message.pack(message_id)
        except (struct.error, OverflowError):
            _saturate(message)
            frame = message.pack(message_id)
        self._sequence = (self._sequence + 1) % 256
        return Outgoing(frame, message_id, client_id)

    def _frame(
        self, message_id: int, crc_extra: int, payload: bytes, *, force_mavlink1: bool
    ) -> bytes:
        """Put header and checksum around a payload; `force_mavlink1` is pymavlink's own."""
        del force_mavlink1
        body = payload.rstrip(b"\0") or payload[:1]
        content = _HEAD.pack(
            len(body),
            0,
            0,
            self._sequence,
            self.system_id,
            AUTOPILOT_COMPONENT,
            message_id & 0xFFFF,
            message_id >> 16,
        )
        content += body
        crc = mcrf4xx(content + crc_extra.to_bytes())
        return _START + content + crc.to_bytes(2, "little")


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
