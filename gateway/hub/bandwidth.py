"""Message intervals on a link whose bandwidth is too small for all telemetry.

Theory of operation. A link has a bandwidth in bytes a second. The offered frames are counted by
kind of message; when not all of them fit, each kind is thinned by one factor that is found by
bisection, divided by the kind's importance:

    rate = offered * min(1, factor * importance), at least `FLOOR_HZ`

Answers that a client waits for, heartbeats and texts are never thinned; their bytes are subtracted
from the bandwidth first. If even the floors do not fit they are all lowered alike, so that no
message stops.

A radio reports in RADIO_STATUS how full its own buffer is, since the air carries less than the
serial line: the used share of the bandwidth decreases while the buffer fills and increases
again slowly.

A link of a few bytes a second gets HIGH_LATENCY2 alone, which carries a whole vehicle in 54 bytes.
"""

from collections.abc import Mapping
from typing import Final

from pymavlink.dialects.v20 import all as dialect

from gateway.units import US_PER_S

HIGH_LATENCY2: Final = dialect.MAVLINK_MSG_ID_HIGH_LATENCY2
RADIO_STATUS: Final = dialect.MAVLINK_MSG_ID_RADIO_STATUS
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
"""Others have 1: position and health come first, then motion."""
FLOOR_HZ: Final = 0.5
SMOOTHING: Final = 0.3
"""Weight of the newest second."""
FULL_PERCENT: Final = 20
LOW_PERCENT: Final = 50
FREE_PERCENT: Final = 90
"""Free part of a radio's buffer at which it is used less, a little less, and more again; as
autopilots do."""
LEAST_SHARE: Final = 0.05
STEPS: Final = 20
"""Of the bisection: the factor to a millionth."""

Key = bytes
"""System, component and message of a frame, as in `MavFrame.key`."""


class Bandwidth:
    """Message intervals on one link of a known bandwidth.

    Parameters
    ----------
    bytes_per_s : int
        Of everything sent.
    """

    def __init__(self, bytes_per_s: int) -> None:
        self.share = 1.0
        """Part of the bandwidth that the radio behind it accepts."""
        self.bytes_per_s = bytes_per_s
        self._offered: dict[Key, tuple[int, float, float]] = {}
        """Message id, and smoothed frames and bytes a second."""
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

    def plan(
        self, offered: Mapping[Key, tuple[int, int, int]], answered: int, elapsed_s: float
    ) -> None:
        """Find new intervals from what was offered by kind and answered since the last plan."""
        if elapsed_s <= 0:
            return
        for key in self._offered.keys() | offered.keys():
            message_id, frames, size = offered.get(key) or (self._offered[key][0], 0, 0)
            _, rate, flow = self._offered.get(key, (0, frames / elapsed_s, size / elapsed_s))
            rate += SMOOTHING * (frames / elapsed_s - rate)
            flow += SMOOTHING * (size / elapsed_s - flow)
            self._offered[key] = message_id, rate, flow
        self._offered = {key: each for key, each in self._offered.items() if each[2] > 1e-3}
        self._answered += SMOOTHING * (answered / elapsed_s - self._answered)
        self._intervals_us = self._thinned()

    def _thinned(self) -> dict[Key, int]:
        fixed = sum(flow for i, _, flow in self._offered.values() if i in NEVER_THINNED)
        room = max(0.0, self.bytes_per_s * self.share - fixed - self._answered)
        kinds = {key: each for key, each in self._offered.items() if each[0] not in NEVER_THINNED}
        least = {key: min(1.0, FLOOR_HZ / rate) for key, (_, rate, _) in kinds.items() if rate}
        floors = sum(least[key] * kinds[key][2] for key in least)
        if floors > room:
            # Half a heartbeat's worth even where the answers take it all.
            squeeze = max(room / floors, 0.1)
            parts = {key: part * squeeze for key, part in least.items()}
        else:
            parts = _parts(kinds, least, room)
        return {
            key: round(US_PER_S / (part * kinds[key][1]))
            for key, part in parts.items()
            if part < 1.0
        }


def _parts(
    kinds: Mapping[Key, tuple[int, float, float]], least: Mapping[Key, float], room: float
) -> dict[Key, float]:
    """Return which share of each kind is sent so that together they fill the room."""

    def at(factor: float) -> dict[Key, float]:
        return {
            key: max(least[key], min(1.0, factor * IMPORTANCE.get(kinds[key][0], 1.0)))
            for key in least
        }

    low, high = 0.0, 1.0
    if sum(kinds[key][2] for key in least) <= room:
        return at(high)
    for _ in range(STEPS):
        middle = (low + high) / 2
        used = sum(part * kinds[key][2] for key, part in at(middle).items())
        low, high = (middle, high) if used <= room else (low, middle)
    return at(low)
