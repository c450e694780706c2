"""Conversion of node clocks to the gateway clock: offset and drift from the least delayed packets.

Theory of operation. A packet stamped `t` by a remote clock arrives at `t + offset + delay` on the
local one, where the delay is never negative but has bursts (retries, buffers, USB polling). The
difference `arrival - t` is therefore above the line `offset + skew * t`, or on it for a packet
without a queue: the line is the lower envelope of all points. As in [1]_, it is found as the edge
of the lower convex hull over the window's middle, which is the supporting line with the least sum
of distances to the points.

| event                                                  | action                                 |
| ------------------------------------------------------ | -------------------------------------- |
| time agrees with the arrival, even after wraps         | unwraps it, adds the point             |
| time is late, or early, by less than RESTART_JUMP_US   | the same: a queue, not a restart       |
| time is late by more, but continues the last one       | the same, for DRAIN_US at most: the    |
|                                                        | local computer was suspended, and      |
|                                                        | reads the content of its buffers       |
| time is late for longer, but continues the last one    | its clock was halted: starts again     |
| time disagrees by more                                 | the remote restarted: starts again     |
| packet seems to arrive before it was sent              | waits for a second one that agrees     |

References
----------
.. [1] S. B. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew from network delay
   measurements", INFOCOM 1999.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from operator import attrgetter
from statistics import median_low
from typing import Final

import msgspec

WRAP_US: Final = 1 << 32
HALF_WRAP_US: Final = WRAP_US // 2
WRAP_MASK: Final = WRAP_US - 1
BUCKET_US: Final = 250_000
"""Length of a bucket, of which only the least delayed packet is kept: so the cost of a window does
not depend on the rate."""
MAX_BUCKETS: Final = 120
"""Buckets of a window, 30 s: long enough to average quantisation, short enough to follow a warming
resonator."""
MIN_SKEW_SPAN_US: Final = 2_000_000
"""Shortest span for a fit of the drift: in a shorter one, a burst of retries would look like it."""
MAX_SKEW: Final = 0.01
"""Maximum drift: ceramic resonators drift by up to 0.5 %; more may be a growing queue."""
MAX_RC_SKEW: Final = 0.1
"""Maximum drift of a processor on its internal RC oscillator, because its fuses are wrong."""
LONGEST_QUEUE_US: Final = 500_000
"""A larger change of the offset is not due to a queue."""
RESTART_JUMP_US: Final = 1_500_000
"""More than the delay of any queue, less than a restart of a microcontroller with its sensors."""
MAX_STALL_US: Final = 60_000_000
"""Maximum time for which the local computer may be suspended while the remote clock runs."""
DRAIN_US: Final = 3_000_000
"""Time in which the buffers are read; packets that are still so late are those of a remote whose
clock was halted, or which restarted and is beyond its last time again."""
AHEAD_US: Final = 50_000
"""More than the error of the line between two packets. Either the line was fitted to a queue, and
the next packets agree with this one, or its time is wrong and must not move the line."""
RECENT: Final = 15
"""Number of newest fixes of each aircraft that are used: some seconds."""
ENOUGH: Final = 3
"""Number of fixes before an aircraft is used: the first may have the time of the last flight."""


_remote_us: Final = attrgetter("remote_us")


class _Point(msgspec.Struct, frozen=True, gc=False):
    remote_us: int
    delta_us: int


class ClockTracker:
    """Track one remote 32-bit microsecond clock from pairs of (its time, arrival)."""

    def __init__(self) -> None:
        self.restarts = 0
        self.runs = 0
        """Number of lines begun: the start, restarts, and resumptions of a halted clock."""
        self._reset()

    def _reset(self) -> None:
        self.runs += 1
        self._last_us = self._last_arrival_us = 0
        """The newest remote time, unwrapped, and its arrival."""
        self._buckets: list[_Point] = []
        self._hull: list[_Point] = []
        """Lower hull of all buckets but the newest, which may still get a less delayed packet."""
        self._line = self._least_delayed = _Point(0, 0)
        self._bucket_end_us = 0
        """End of the newest bucket on the remote clock."""
        self._skew = 0.0
        self._suspect_us: int | None = None
        self._late_since_us: int | None = None

    @property
    def skew_ppm(self) -> float:
        """Relative speed of the remote clock, in parts per million; positive if it is fast."""
        return (1.0 / (1.0 + self._skew) - 1.0) * 1e6

    def observe(self, remote_u32: int, arrival_us: int) -> int:
        """Return the time of a packet on the local clock, µs; never later than its arrival.

        `remote_u32` is the remote clock's time in µs, modulo 2**32, `arrival_us` is on the local
        clock.
        """
        last_us, line, soonest, skew = self._last_us, self._line, self._least_delayed, self._skew
        remote_us = last_us + (remote_u32 - last_us & WRAP_MASK)
        local_us = remote_us + round(line.delta_us + skew * (remote_us - line.remote_us))
        if (
            # The usual case, kept fast: this runs twice for each payload.
            last_us < remote_us < self._bucket_end_us
            and -AHEAD_US <= arrival_us - local_us <= RESTART_JUMP_US
            and arrival_us - remote_us >= soonest.delta_us + skew * (remote_us - soonest.remote_us)
        ):
            self._suspect_us = self._late_since_us = None
            self._last_us, self._last_arrival_us = remote_us, arrival_us
            return local_us if local_us < arrival_us else arrival_us
        return self._observe_unusual(remote_u32, arrival_us)

    def _observe_unusual(self, remote_u32: int, arrival_us: int) -> int:
        """Do the same for a packet that may restart the clock, or move the line."""
        remote_us = self._unwrap(remote_u32, arrival_us)
        local_us = self._to_local(remote_us) if self._buckets else arrival_us
        late_us = arrival_us - local_us
        if -AHEAD_US <= late_us <= RESTART_JUMP_US:
            self._suspect_us = self._late_since_us = None
        elif late_us > RESTART_JUMP_US:
            self._suspect_us = None
            # Times that have been too late for longer than buffers explain.
            self._late_since_us = self._late_since_us or arrival_us
            if arrival_us - self._late_since_us > DRAIN_US:
                self._reset()
                remote_us, local_us = remote_u32, arrival_us
        elif self._is_unconfirmed(arrival_us - remote_us):
            return arrival_us
        if not self._buckets or remote_us > self._last_us:
            self._last_us, self._last_arrival_us = remote_us, arrival_us
        if self._is_least_delayed(remote_us, arrival_us - remote_us):
            self._add(_Point(remote_us, arrival_us - remote_us))
            local_us = self._to_local(remote_us)
        return min(local_us, arrival_us)

    def _is_unconfirmed(self, delta_us: int) -> bool:
        """Return whether a packet is far too early, and no other has confirmed its offset yet."""
        before_us, self._suspect_us = self._suspect_us, None
        if before_us is not None and abs(before_us - delta_us) <= AHEAD_US:
            return False
        self._suspect_us = delta_us
        return True

    def _unwrap(self, remote_u32: int, arrival_us: int) -> int:
        if self._buckets:
            elapsed_us = arrival_us - self._last_arrival_us
            expected_us = self._last_us + elapsed_us
            error_us = (remote_u32 - expected_us + HALF_WRAP_US) % WRAP_US - HALF_WRAP_US
            remote_us = expected_us + error_us
            slack_us = RESTART_JUMP_US + MAX_SKEW * elapsed_us
            if -slack_us <= error_us <= slack_us or self._is_next(remote_us, arrival_us, slack_us):
                return remote_us
            self._reset()
            self.restarts += 1
        return remote_u32

    def _is_next(self, remote_us: int, arrival_us: int, slack_us: float) -> bool:
        """Return whether a time continues the last one on the known line, though read late."""
        late_us = arrival_us - self._to_local(remote_us)
        return remote_us > self._last_us and -slack_us <= late_us <= MAX_STALL_US

    def _is_least_delayed(self, remote_us: int, delta_us: int) -> bool:
        """Return whether a point is the least delayed of its bucket so far, drift removed."""
        if not self._buckets or remote_us >= self._bucket_end_us:
            return True
        soonest = self._least_delayed
        if remote_us < self._bucket_end_us - BUCKET_US:
            return False
        # If the clock is fast, each packet would seem less delayed than the one before.
        return delta_us < soonest.delta_us + self._skew * (remote_us - soonest.remote_us)

    def _add(self, point: _Point) -> None:
        """Add the least delayed point of its bucket, and fit the line again."""
        buckets, hull = self._buckets, self._hull
        if buckets and point.remote_us < self._bucket_end_us:
            buckets.pop()
        elif buckets:
            _extend_hull(hull, buckets[-1])
        buckets.append(point)
        if len(buckets) > MAX_BUCKETS:
            del buckets[0]
            # Later points of the hull stay in it; those up to its second point may enter it.
            until = bisect_right(buckets, hull[1].remote_us, key=_remote_us)
            begun: list[_Point] = []
            for each in buckets[:until]:
                _extend_hull(begun, each)
            hull[:2] = begun
        self._least_delayed = point
        self._bucket_end_us = (point.remote_us // BUCKET_US + 1) * BUCKET_US
        self._fit(buckets[0], point)

    def _fit(self, first: _Point, last: _Point) -> None:
        if last.remote_us - first.remote_us < MIN_SKEW_SPAN_US:
            self._line = min(self._buckets, key=lambda p: p.delta_us)
            self._skew = 0.0
            return
        hull = self._hull.copy()
        _extend_hull(hull, last)
        middle_us = (first.remote_us + last.remote_us) // 2
        right = max(1, bisect_left(hull, middle_us, key=_remote_us))
        a, b = hull[right - 1], hull[right]
        skew = (b.delta_us - a.delta_us) / (b.remote_us - a.remote_us)
        moved_us = abs(last.delta_us - first.delta_us)
        most = MAX_RC_SKEW if moved_us > LONGEST_QUEUE_US else MAX_SKEW
        self._skew = max(-most, min(most, skew))
        self._line = a

    def _to_local(self, remote_us: int) -> int:
        line = self._line
        return remote_us + round(line.delta_us + self._skew * (remote_us - line.remote_us))


def _extend_hull(hull: list[_Point], point: _Point) -> None:
    """Add a later point to a lower convex hull (Andrew's monotone chain)."""
    while len(hull) >= 2 and _turn(hull[-2], hull[-1], point) <= 0:
        hull.pop()
    hull.append(point)


def _turn(a: _Point, b: _Point, c: _Point) -> int:
    return (b.remote_us - a.remote_us) * (c.delta_us - a.delta_us) - (b.delta_us - a.delta_us) * (
        c.remote_us - a.remote_us
    )


class GpsTime:
    """Offset of the gateway clock to civil time: the median of the aircraft's medians."""

    def __init__(self) -> None:
        self._offsets_us: dict[int, deque[int]] = {}

    def update(self, vehicle_id: int, utc_us: int, time_us: int) -> int | None:
        """Process the UTC of a fix and its arrival on the gateway clock.

        The arrival is used as the time of the fix, which is late by the latency, never early.
        Returns UTC at the zero of the gateway clock; None if there are too few fixes.
        """
        offsets_us = self._offsets_us.setdefault(vehicle_id, deque(maxlen=RECENT))
        offsets_us.append(utc_us - time_us)
        medians = [median_low(each) for each in self._offsets_us.values() if len(each) >= ENOUGH]
        return median_low(medians) if medians else None
