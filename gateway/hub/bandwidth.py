"""Message intervals on a link whose bandwidth is known and too small for all telemetry.

The offered frames are counted by kind of message; when not all of them fit, each kind is thinned by
one factor that is found by bisection, divided by the kind's importance:

    rate = offered * min(1, factor * importance), at least `FLOOR_HZ`

Answers that a client waits for, heartbeats and texts are never thinned; their bytes are subtracted
from the bandwidth first. If even the floors do not fit they are all lowered alike, so that no
message stops. A radio reports in RADIO_STATUS how full its own buffer is, since the air carries
less than the serial line: the used share of the bandwidth decreases while the buffer fills and
increases again slowly. A link of a few bytes a second gets HIGH_LATENCY2 alone, which summarises
the state of a vehicle in 54 bytes.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as dialect

from gateway.units import US_PER_S

HIGH_LATENCY2: Final = dialect.MAVLINK_MSG_ID_HIGH_LATENCY2
SATELLITE_BUDGET: Final = 100
"""Bytes a second, below which a link is a satellite link."""
HIGH_LATENCY2_BYTES: Final = 54
NEVER_THINNED: Final = frozenset(
    {
        dialect.MAVLINK_MSG_ID_HEARTBEAT,
        dialect.MAVLINK_MSG_ID_COMMAND_ACK,
        dialect.MAVLINK_MSG_ID_STATUSTEXT,
        dialect.MAVLINK_MSG_ID_PARAM_VALUE,
    }
)
IMPORTANCE: Final[dict[int, float]] = {
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 4.0,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 4.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 4.0,
    dialect.MAVLINK_MSG_ID_BATTERY_STATUS: 4.0,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: 4.0,
    dialect.MAVLINK_MSG_ID_VFR_HUD: 2.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE: 2.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 2.0,
}
"""Importance of messages; that of others is 1. Position and health come first, then motion."""
FLOOR_HZ: Final = 0.5
LEAST_FLOOR_SHARE: Final = 0.1
"""Part of this rate that is sent even where answers use all of the bandwidth."""
LEAST_FLOW: Final = 1e-3
"""Bytes a second below which a kind of frame counts as ended."""
SMOOTHING: Final = 0.3
"""Weight of the newest second in the moving averages."""
FULL_PERCENT: Final = 20
LOW_PERCENT: Final = 50
FREE_PERCENT: Final = 90
"""Free percentages of a radio's buffer: below the first two the used share decreases by much or by
little, above the last it increases, as in autopilots."""
LEAST_SHARE: Final = 0.05
STEPS: Final = 20
"""Steps of the bisection, which give the factor to a millionth."""
Key = bytes
"""System, component and message of a frame, as in `MavFrame.key`."""


class Offered(NamedTuple):
    """Frames of one kind and their bytes: numbers, or rates a second."""

    message_id: int
    frames: float
    size: float


class Bandwidth:
    """Message intervals on one link of a known bandwidth."""

    def __init__(self, bytes_per_s: int) -> None:
        self.share = 1.0
        """Share of the bandwidth that the radio of the link accepts."""
        self.bytes_per_s = bytes_per_s
        self._offered: dict[Key, Offered] = {}
        """Smoothed rates."""
        self._answered = 0.0
        self._intervals_us: dict[Key, int] = {}

    def update_buffer(self, free_percent: int) -> None:
        """Adapt the used share to the free part of a radio's buffer."""
        if free_percent < FULL_PERCENT:
            self.share *= 0.7
        elif free_percent < LOW_PERCENT:
            self.share *= 0.9
        elif free_percent > FREE_PERCENT:
            self.share *= 1.1
        self.share = min(1.0, max(LEAST_SHARE, self.share))

    def interval_us(self, key: Key) -> int:
        """Return the least time between two frames of a kind; 0 if all of them fit."""
        return self._intervals_us.get(key, 0)

    def plan(self, offered: Mapping[Key, Offered], answered: int, elapsed_s: float) -> None:
        """Find new intervals from the frames offered by kind and the answers since the last one."""
        if elapsed_s <= 0:
            return
        smoothed = {}
        for key in self._offered.keys() | offered.keys():
            message_id, frames, size = offered.get(key) or (self._offered[key].message_id, 0, 0)
            now = Offered(message_id, frames / elapsed_s, size / elapsed_s)
            before = self._offered.get(key, now)
            rates = (
                old + SMOOTHING * (new - old) for old, new in zip(before[1:], now[1:], strict=True)
            )
            smoothed[key] = Offered(message_id, *rates)
        self._offered = {key: each for key, each in smoothed.items() if each.size > LEAST_FLOW}
        self._answered += SMOOTHING * (answered / elapsed_s - self._answered)
        self._intervals_us = self._thinned()

    def _thinned(self) -> dict[Key, int]:
        offered = self._offered
        fixed = sum(each.size for each in offered.values() if each.message_id in NEVER_THINNED)
        free = max(0.0, self.bytes_per_s * self.share - fixed - self._answered)
        kinds = {k: each for k, each in offered.items() if each.message_id not in NEVER_THINNED}
        least = {key: min(1.0, FLOOR_HZ / each.frames) for key, each in kinds.items()}
        floors = sum(least[key] * kinds[key].size for key in kinds)
        if floors > free:
            squeeze = max(free / floors, LEAST_FLOOR_SHARE)
            parts = {key: part * squeeze for key, part in least.items()}
        else:
            parts = _parts(kinds, least, free)
        return {
            key: round(US_PER_S / (part * kinds[key].frames))
            for key, part in parts.items()
            if part < 1.0
        }


def _parts(
    kinds: Mapping[Key, Offered], least: Mapping[Key, float], free: float
) -> dict[Key, float]:
    """Return the share of each kind to send, so that together they use `free` bytes a second."""

    def at(factor: float) -> dict[Key, float]:
        return {
            key: max(least[key], min(1.0, factor * IMPORTANCE.get(each.message_id, 1.0)))
            for key, each in kinds.items()
        }

    low, high = 0.0, 1.0
    if sum(each.size for each in kinds.values()) <= free:
        return at(high)
    for _ in range(STEPS):
        middle = (low + high) / 2
        used = sum(part * kinds[key].size for key, part in at(middle).items())
        low, high = (middle, high) if used <= free else (low, middle)
    return at(low)
