"""The newest sensor frames of an aircraft, to be fused again."""

from collections import Counter, deque
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import message_id_of

SPAN_US: Final = 180 * US_PER_S
MAX_FRAMES: Final = 40_000
"""Maximum frames: three minutes at 200 a second; less at a higher rate."""

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
"""Frames with the time at which each was received, µs on the panel's clock."""


class SampleMemory:
    """Sensor frames of one aircraft."""

    def __init__(self) -> None:
        self.frames: deque[tuple[int, bytes]] = deque(maxlen=MAX_FRAMES)
        """The oldest first, with the time at which each was received."""

    def add(self, message: Any, now_us: int) -> None:
        """Store a message, if it is a sensor's."""
        if message.get_msgId() not in SENSOR_MESSAGES:
            return
        self.frames.append((now_us, bytes(message.get_msgbuf())))
        while self.frames[0][0] < now_us - SPAN_US:
            self.frames.popleft()

    def collected(self, span_s: float, rate_hz: float) -> float:
        """Return the collected share of a span up to the newest sample at a rate, at most 1."""
        newest_us = self.frames[-1][0] if self.frames else 0
        counts, first_us = Counter[int](), dict[int, int]()
        for time_us, frame in reversed(self.frames):
            if newest_us - time_us > (span_s + 1.0) * US_PER_S:
                break
            kind = message_id_of(frame)
            counts[kind] += 1
            first_us[kind] = time_us
        shares = (
            min(count / (span_s * rate_hz), (newest_us - first_us[kind]) / US_PER_S / span_s)
            for kind, count in counts.items()
        )
        return min(1.0, max(shares, default=0.0))
