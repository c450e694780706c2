"""MAVLink messages to frames of one system, numbered in the order they are sent."""

import math
import struct
from typing import Any, Final

from pymavlink.dialects.v20 import common as mavlink

from gateway.records import Outgoing
from gateway.vehicle.telemetry.fields import FLOAT32_MAX

AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: clients look for a vehicle under no other component id."""

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
        self._mav: Any = mavlink.MAVLink(None, system_id, AUTOPILOT_COMPONENT)

    def encode(self, message: Any, client_id: int | None = None) -> Outgoing:
        """Build the MAVLink 2 frame of one message.

        Parameters
        ----------
        message : MAVLink_message
            Any message of the dialect. A number beyond its field is saturated, so that no
            measurement however wild can stop the telemetry.
        client_id : int, optional
            The one client it answers.

        Returns
        -------
        Outgoing
        """
        try:
            frame = message.pack(self._mav)
        except (struct.error, OverflowError):
            _saturate(message)
            frame = message.pack(self._mav)
        # pack() leaves the sequence number to its caller.
        self._mav.seq = (self._mav.seq + 1) % 256
        # Not message.id: HIGHRES_IMU and others have a field of that name.
        return Outgoing(frame, message.get_msgId(), client_id)


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
