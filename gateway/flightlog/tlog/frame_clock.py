"""Times for a MAVLink capture without time stamps, from the messages themselves.

Each message with `time_boot_ms` or `time_usec` moves the time on by as much as that field has grown
since the last message of the same kind and sender; other messages have the time of the one before.
SYSTEM_TIME, or any `time_usec` since 1970, gives the date. Where no message holds a time, frames
are spaced as a serial line of `LINE_BPS` would send them.
"""

from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.flightlog.damaged_times import DAY_US
from gateway.flightlog.summary import payload_of
from gateway.flightlog.tlog.payload_columns import layout_of
from gateway.flightlog.tlog.tlog import FIRST_CIVIL_US
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import message_id_of, origin_of

LINE_BPS: Final = 57_600
"""The usual telemetry radio; ten bits a byte."""
LAST_CIVIL_US: Final = 4_102_444_800 * US_PER_S
"""The year 2100."""
_FIELDS: Final = {"time_boot_ms": 1000, "time_usec": 1, "time_unix_usec": 1}
"""Fields with the sender's time, and their unit in us."""


def _time_fields(kind: Any) -> list[tuple[int, int, int]]:
    """Return offset, size and unit in us of each time in a message's payload."""
    fields: Any = layout_of(kind).fields or {}
    return [
        (int(fields[name][1]), int(fields[name][0].itemsize), unit_us)
        for name, unit_us in _FIELDS.items()
        if name in fields
    ]


_TIMES: Final = {
    message_id: found
    for message_id, kind in mavlink.mavlink_map.items()
    if (found := _time_fields(kind))
}
"""By message id."""


class FrameClock:
    """The time of each frame, counted from the first one.

    Parameters
    ----------
    by_size : bool
        Space frames by their size: no message holds a time.
    """

    def __init__(self, *, by_size: bool = False) -> None:
        self._by_size = by_size
        self.civil_us_at_zero: int | None = None
        """Civil time of the first frame; None until a message gives it."""
        self.is_timed = False
        """Whether any message held a time."""
        self._now_us = 0
        self._line_us = 0.0
        self._bases_us: dict[tuple[int, ...], tuple[int, int]] = {}
        """Of each kind and sender: time at its own zero, and its newest own time."""

    def time_us(self, frame: bytes) -> int:
        """Return the time of the next frame."""
        self._line_us += len(frame) * 10 * US_PER_S / LINE_BPS
        message_id = message_id_of(frame)
        for offset, size, unit_us in _TIMES.get(message_id, ()):
            payload = payload_of(frame, offset + size)
            own_us = int.from_bytes(payload[offset:], "little") * unit_us
            if own_us:
                self._take(own_us, (*origin_of(frame), message_id, offset))
        return round(self._line_us) if self._by_size else self._now_us

    def _take(self, own_us: int, key: tuple[int, ...]) -> None:
        is_civil = FIRST_CIVIL_US < own_us < LAST_CIVIL_US
        if is_civil and self.civil_us_at_zero is None:
            self.civil_us_at_zero = own_us - self._now_us
        self.is_timed = True
        base_us, newest_us = self._bases_us.get(key, (self._now_us - own_us, own_us))
        if not -US_PER_S <= own_us - newest_us <= DAY_US:
            base_us = self._now_us - own_us
        self._now_us = max(self._now_us, base_us + own_us)
        self._bases_us[key] = (base_us, own_us)
