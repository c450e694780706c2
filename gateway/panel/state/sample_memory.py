"""The sensor frames of the last minutes for the estimators, by aircraft."""

from collections import deque
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S

SPAN_US: Final = 180 * US_PER_S
MAX_FRAMES: Final = 40_000
"""Three minutes at 200 a second; less at a higher rate."""

SENSOR_MESSAGES: Final = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    }
)

TimedFrames = list[tuple[int, bytes]]
"""When each came, in µs on the panel's clock, and the frame."""


class SampleMemory:
    """Sensor frames of each aircraft."""

    def __init__(self) -> None:
        self._frames: dict[int, deque[tuple[int, bytes]]] = {}

    def take(self, system_id: int, message: Any, now_us: int) -> None:
        """Store a message, if it is a sensor's."""
        if message.get_msgId() not in SENSOR_MESSAGES:
            return
        frames = self._frames.setdefault(system_id, deque(maxlen=MAX_FRAMES))
        frames.append((now_us, bytes(message.get_msgbuf())))
        while frames[0][0] < now_us - SPAN_US:
            frames.popleft()

    def forget(self, system_id: int) -> None:
        """Delete the frames of an aircraft."""
        self._frames.pop(system_id, None)

    def frames(self, system_id: int) -> TimedFrames:
        """Return the frames of an aircraft, the oldest first."""
        return list(self._frames.get(system_id, ()))
