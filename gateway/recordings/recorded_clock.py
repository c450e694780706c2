"""The clocks of recorded MAVLink: which times are damaged, steps of a clock, dates, timestamps.

| clock          | rule                                                                         |
| -------------- | ---------------------------------------------------------------------------- |
| `is_damaged`   | a time that is not between those of its neighbours, by `ORDER_US`            |
| `is_step`      | consecutive times between which a clock was set; playback uses it, too       |
| `RestartClock` | the time of another program's log, whose clock may restart: it continues     |
| `DayClock`     | the same of times of day without a date: they continue after midnight        |
| `TimesSpan`    | duration and gaps of any recording, without jumps of its clock               |
| `Timeline`     | the time of a tlog without the steps of a clock that was set                 |
| `FrameClock`   | the time of a capture without time stamps, from the times in its messages    |
| `CivilClock`   | civil time of the running gateway: that of GPS, or else the machine's        |
| `sound_times`  | times of one topic that are near the median of those around them             |
| `logged_times` | times of a log's topics, within those of the topics with several values      |
| `LogClock`     | the time of an autopilot's log, whose clock may jump or restart              |
| `VehicleClock` | the time of a vehicle's samples in MAVLink, by its own clock                 |
| `civil_shift_us` | the difference of two recordings' clocks that are joined                     |
| `Stamper`      | the increasing timestamps of a file that is written                          |

A step of more than `DAY_US`, or back by more than `LATE_US`, is a change of a clock; in MAVLink, of
which two links reorder the frames, one back by more than `BACK_US`. Times from `FIRST_CIVIL_US` to
`LAST_CIVIL_US` are civil; earlier ones count from the start of a clock.

Ground stations consider a tlog corrupt if its times are in the future or do not increase. So the
offset from the gateway clock to civil time is constant while a file is open, and a clock jump
requires a new file.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import DEFINITIONS
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from gateway.wire.recorded_frames import Batch, IntArray, fields_of
from gateway.wire.timesync import GpsTime

Times = TypeVar("Times", int, NDArray[np.int64])
Item = TypeVar("Item")

DAY_S, HOUR_S = 86_400, 3600
DAY_US: Final = DAY_S * US_PER_S
"""Records further apart are of different days: the time between them is not counted."""
LATE_US: Final = US_PER_S
"""Maximum backward step of records that arrive late. It is also the maximum distance of the
messages of one loop of an autopilot, which are not quite in order."""
ORDER_US: Final = 2 * US_PER_S
"""A time before that of the previous record, or after that of the next, by more is damaged."""

GAP_US: Final = 2 * US_PER_S
"""Minimum pause that is a gap: every vehicle sends a heartbeat once a second."""
MAX_GAPS: Final = 1000
BACK_US: Final = 60 * US_PER_S
"""Maximum backward step from reordering of two links' frames; more means a clock change."""
FIRST_CIVIL_US: Final = 946_684_800 * US_PER_S
"""The year 2000; an earlier time counts from the start of a clock."""
MAX_JUMPS: Final = 1000
LINE_BPS: Final = 57_600
"""Bit rate assumed for captures without times, that of usual telemetry radios; 10 bits per byte."""
LAST_CIVIL_US: Final = 4_102_444_800 * US_PER_S
"""The year 2100; later times are not civil time."""
AROUND: Final = 5
"""Number of a topic's times around a time whose median it is compared with. The maximum difference
is `LATE_US`; at the ends of a topic it is `BACK_US`, as a gap makes it large there."""
AHEAD_US: Final = HOUR_S * US_PER_S
"""Maximum step of an autopilot's clock; a message further ahead has a damaged time as well."""
AGREEING: Final = 50
"""Consecutive messages with consistent deviating times that prove a jump of the clock."""
LEAST_AGREEING: Final = 3
"""The same at the end of the log, where no more messages follow."""
_UNITS_US: Final = {"time_boot_ms": 1000, "time_usec": 1, "time_unix_usec": 1}
"""Fields with the sender's time, and their unit in µs."""
_TIMES: Final = {
    message_id: names
    for message_id, kind in DEFINITIONS.items()
    if (names := [name for name in _UNITS_US if name in kind.fieldnames])
}
"""Names of the time fields, by message id, of all messages that have some."""
JUMP_US: Final = 2 * US_PER_S
"""Minimum error of the assumed civil time that requires a new file. The arrival of GPS time lags
by up to a second, and NTP slews smaller errors away."""
STEP_US: Final = 4
"""Minimum difference of two timestamps: readers use the low two bits as a link number."""
_LINK_BITS: Final = 3


def is_damaged(before_us: Times, time_us: Times, after_us: Times) -> bool | NDArray[np.bool_]:
    """Return whether a time is not between its neighbours, which are in order."""
    gap_us = after_us - before_us
    is_in_order = (gap_us >= -ORDER_US) & (gap_us <= DAY_US)
    is_outside = (time_us < before_us - ORDER_US) | (time_us > after_us + ORDER_US)
    return is_in_order & is_outside


def is_step(step_us: Times, back_us: int = LATE_US, ahead_us: int = DAY_US) -> Any:
    """Return whether the difference of consecutive times is a step of their clock."""
    return (step_us < -back_us) | (step_us > ahead_us)


def civil_shift_us(zero_us: int | None, first_zero_us: int | None) -> int | None:
    """Return the difference of two clocks by their civil times at zero; None if one is unknown.

    A difference of at most `JUMP_US` is an error of the civil times.
    """
    if zero_us is None or first_zero_us is None:
        return None
    shift_us = zero_us - first_zero_us
    return 0 if abs(shift_us) <= JUMP_US else shift_us


def is_civil(time_us: int | IntArray) -> bool | NDArray[np.bool_]:
    """Return whether a time is civil; others count from the start of a clock."""
    return (time_us > FIRST_CIVIL_US) & (time_us < LAST_CIVIL_US)


def sound_times(times_us: NDArray[Any]) -> tuple[NDArray[np.bool_], IntArray]:
    """Return which times are not damaged, and the order of these.

    A time is damaged if it is absent, or far from those around it: a topic is nearly in order.
    """
    time_us = times_us.astype(np.int64)
    sound = (time_us > 0) & (time_us < LAST_CIVIL_US)
    if len(time_us) >= AROUND:
        around = np.median(sliding_window_view(time_us, AROUND), axis=1)
        early_us = np.pad(around, AROUND // 2, mode="edge") - time_us
        far_us = np.full((2, len(time_us)), LATE_US)
        far_us[0, : AROUND // 2] = far_us[1, -(AROUND // 2) :] = BACK_US
        sound &= (early_us < far_us[0]) & (-early_us < far_us[1])
    return sound, np.flatnonzero(sound)[np.argsort(time_us[sound], kind="stable")]


def logged_times(topics_us: Sequence[NDArray[Any]]) -> list[IntArray]:
    """Return the times of a log's topics, of which some hold values older than the log.

    A logger begins with the newest value of each topic, whose time is that of its publication,
    maybe long ago or on another clock. So a time outside those of the topics with at least
    `AROUND` values is that of the begin.
    """
    times_us = [time_us.astype(np.int64) for time_us in topics_us]
    several = [t[sound_times(t)[1]] for t in times_us if len(t) >= AROUND]
    spans = [(int(t[0]), int(t[-1])) for t in several if len(t) and t[0] < t[-1]]
    if not spans:
        return times_us
    begin_us, end_us = min(first for first, _ in spans), max(last for _, last in spans)
    return [
        np.where((time_us < begin_us) | (time_us > end_us), begin_us, time_us)
        if len(time_us) < AROUND
        else time_us
        for time_us in times_us
    ]


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A step of a recording's clock that the timeline removes."""

    offset_us: int
    """Time of the step since the first record."""
    step_us: int


@dataclass(frozen=True, slots=True)
class Gap:
    """A gap in the data."""

    time_us: int
    """Start of the gap, in the recording's own time."""
    duration_s: float


class TimesSpan:
    """Sum up the duration of records; a clock jump of more than a day adds nothing."""

    def __init__(self) -> None:
        self.first_us: int | None = None
        self.last_us: int | None = None
        """Greatest time."""
        self.gaps: list[Gap] = []
        """The first `MAX_GAPS` between records."""
        self._before_us = self._begin_us = self._newest_us = self._last_us = 0
        """Length of the parts before the last clock jump; begin and greatest time since it."""

    @property
    def length_us(self) -> int:
        """Duration from the first record to the last, without clock jumps."""
        return self._before_us + self._newest_us - self._begin_us

    def add_all(self, times_us: IntArray) -> None:
        """Add the times of the next records."""
        if not len(times_us):
            return
        steps_us = np.diff(
            times_us, prepend=times_us[0] if self.first_us is None else self._last_us
        )
        for i in np.flatnonzero(steps_us > GAP_US)[: MAX_GAPS - len(self.gaps)].tolist():
            step_us = int(steps_us[i])
            self.gaps.append(Gap(int(times_us[i]) - step_us, step_us / US_PER_S))
        for part, times in enumerate(np.split(times_us, np.flatnonzero(is_step(steps_us, DAY_US)))):
            if part or self.first_us is None:
                self._before_us = self.length_us
                self._begin_us = self._newest_us = int(times[0])
            if len(times):
                self._newest_us = max(self._newest_us, int(times.max()))
                self.last_us = max(self.last_us or self._newest_us, self._newest_us)
            self.first_us = self._begin_us if self.first_us is None else self.first_us
        self._last_us = int(times_us[-1])


class RestartClock:
    """Shift times after each backward step of a clock, as at a restart, so that they increase."""

    def __init__(self) -> None:
        self.restarts = 0
        self._last_us, self._shift_us = -math.inf, 0.0

    def shifts_us(self, times_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shifts of the next times."""
        steps_us = np.diff(times_us, prepend=self._last_us)
        back_us = np.where(steps_us < -ORDER_US, -steps_us, 0.0)
        shifts_us = self._shift_us + np.cumsum(back_us)
        self.restarts += int(np.count_nonzero(back_us))
        self._last_us, self._shift_us = times_us[-1], shifts_us[-1]
        return shifts_us


class DayClock:
    """Continue times of day after midnight."""

    def __init__(self) -> None:
        self.day_s = 0
        """Time from the first midnight to the newest one."""
        self._newest_s = 0.0

    def update(self, of_day_s: float) -> None:
        """Process the next time of day."""
        is_early, was_late = of_day_s < HOUR_S, self._newest_s >= DAY_S - HOUR_S
        self.day_s += DAY_S * (is_early and was_late)
        self._newest_s = of_day_s


class Timeline:
    """A continuous time for a tlog whose clock was set while it was written.

    A step of the clock between two records by more than a day, or back by more than a minute, is
    a jump, and is removed from the time. The date is that of the first section between jumps whose
    clock had a possible civil date; without one, that of the first section.
    """

    def __init__(self) -> None:
        self.jumps: list[ClockJump] = []
        self._begins: list[int] = []
        self._shifts_us: list[int] = []
        self._first_us = 0
        self._last_us: int | None = None
        self._date_shift_us: int | None = None

    def add(self, batch: Batch) -> None:
        """Add the recorded times of the next batch of the file."""
        if not len(batch):
            return
        times_us = batch.time_us
        if self._last_us is None:
            self._first_us = int(times_us[0])
            self._begin(batch, 0, 0)
            self._last_us = self._first_us
        steps_us = np.diff(times_us, prepend=self._last_us)
        for record in np.flatnonzero(is_step(steps_us, BACK_US)).tolist():
            if len(self.jumps) == MAX_JUMPS:
                break
            step_us, shift_us = int(steps_us[record]), self._shifts_us[-1]
            now_us = int(times_us[record]) - step_us + shift_us
            self.jumps.append(ClockJump(now_us - self._first_us, step_us))
            self._begin(batch, record, shift_us - step_us)
        self._last_us = int(times_us[-1])

    def _begin(self, batch: Batch, record: int, shift_us: int) -> None:
        self._begins.append(batch.offset + int(batch.starts[record]))
        self._shifts_us.append(shift_us)
        if self._date_shift_us is None and int(batch.time_us[record]) >= FIRST_CIVIL_US:
            self._date_shift_us = shift_us

    def apply(self, batch: Batch) -> Batch:
        """Return a batch of the same file with corrected times."""
        if not self.jumps or not len(batch):
            return batch
        shifts_us = np.array(self._shifts_us) - (self._date_shift_us or 0)
        at = np.searchsorted(self._begins, batch.starts + batch.offset, side="right") - 1
        corrected: IntArray = batch.time_us + shifts_us[np.maximum(at, 0)]
        return replace(batch, time_us=corrected)


class LogClock(Generic[Item]):
    """Map autopilot times to times from 0: damaged times are discarded, clock jumps followed."""

    def __init__(self) -> None:
        self.dropped = 0
        """Messages with an impossible time."""
        self.leaps = 0
        """Number of jumps of the autopilot's clock forward by more than `AHEAD_US`."""
        self.restarts = 0
        """Number of restarts of the autopilot's clock."""
        self.zero_us: int | None = None
        """Autopilot time at zero of the records' clock."""
        self._newest_us = 0
        self._held: list[tuple[int, Item]] = []
        """Items with consistent times that deviate from the times before them."""

    def feed(self, own_us: int | None, item: Item) -> list[tuple[int, Item]]:
        """Process an item with its time on the autopilot's clock; return the items that are timed.

        An item without a time gets that of the one before.
        """
        if own_us is None:
            return [(self._newest_us, item)]
        if self.zero_us is None:
            self.zero_us = own_us
        if not is_step(own_us - self.zero_us - self._newest_us, ahead_us=AHEAD_US):
            self._drop_held()
            return [self._timed(own_us, item)]
        if self._held and abs(own_us - self._held[-1][0]) > LATE_US:
            self._drop_held()
        self._held.append((own_us, item))
        return self._follow() if len(self._held) == AGREEING else []

    def flush(self) -> list[tuple[int, Item]]:
        """Return the items that are still held at the end of the log."""
        held = self._follow() if len(self._held) >= LEAST_AGREEING else []
        self._drop_held()
        return held

    def _timed(self, own_us: int, item: Item) -> tuple[int, Item]:
        """Return an item with its time on the records' clock, which never decreases."""
        self._newest_us = max(self._newest_us, own_us - (self.zero_us or 0))
        return self._newest_us, item

    def _drop_held(self) -> None:
        self.dropped += len(self._held)
        self._held.clear()

    def _follow(self) -> list[tuple[int, Item]]:
        """Follow the clock to the times of the held items."""
        held, self._held = self._held, []
        step_us = held[0][0] - (self.zero_us or 0) - self._newest_us
        self.leaps += step_us > 0
        self.restarts += step_us < 0
        # After a restart, times continue from the last one.
        self.zero_us = (self.zero_us or 0) + min(step_us, 0)
        return [self._timed(*one) for one in held]


class VehicleClock:
    """Times of the samples, fixes and states of a vehicle, counted from its first message.

    The IMU keeps its own time whatever times the other messages contain: those may be from another
    clock, for example a GPS receiver's. Time never decreases within a kind of message.
    """

    def __init__(self) -> None:
        self.unix_us_at_zero: int | None = None
        """Civil time at zero, from the recorded times."""
        self._zero_us = 0
        """The vehicle's own time at zero."""
        self._newest_us: defaultdict[int | None, int] = defaultdict(int)
        """Newest time by the kind of message; None is the IMU."""
        self._sampled_us = 0
        """Recorded time of the newest IMU sample; before the first one, of the first message."""

    def time_us(self, kind: int | None, own_us: int, recorded_us: int) -> int:
        """Return the time of a message; an `own_us` of 0 means none."""
        newest_us = self._newest_us
        if self.unix_us_at_zero is None:
            self.unix_us_at_zero = self._sampled_us = recorded_us
            self._zero_us = own_us or recorded_us
        elapsed_us = (own_us or recorded_us) - self._zero_us
        if is_step(elapsed_us - newest_us[None], 0, US_PER_S):
            # Another clock than the IMU's, or a restart: use the recorded time, but only the time
            # since the newest sample, since the two clocks drift.
            elapsed_us = (
                recorded_us - self.unix_us_at_zero
                if kind is None
                else newest_us[None] + max(recorded_us - self._sampled_us, 0)
            )
        newest_us[kind] = max(newest_us[kind], elapsed_us)
        if kind is None:
            self._sampled_us = recorded_us
        return newest_us[kind]


class CivilClock:
    """The best estimate of civil time: from GPS if available, else from the machine's clock."""

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._from_gps = False
        self._gps = GpsTime()

    @property
    def offset_us(self) -> int | None:
        """Civil time at gateway time zero, µs since 1970; None before any time is known."""
        return self._offset_us

    def update_machine(self, unix_us: int, now_us: int) -> None:
        """Process the machine's civil time, which is used until GPS time is known."""
        if not self._from_gps:
            self._offset_us = unix_us - now_us

    def update_gps(self, vehicle_id: int, utc_us: int, time_us: int) -> None:
        """Process the time of an aircraft's fix and its time of arrival.

        If the machine's time agrees within `JUMP_US`, it is kept, as it is more precise.
        """
        offset_us = self._gps.update(vehicle_id, utc_us, time_us)
        if offset_us is None:
            return
        if self._offset_us is None or abs(offset_us - self._offset_us) > JUMP_US:
            self._offset_us = offset_us
            self._from_gps = True


class Stamper:
    """Timestamps of one file, which increase and have a constant offset to the gateway clock."""

    def __init__(self, offset_us: int) -> None:
        self.offset_us = offset_us
        self._last_us = 0

    def stamp(self, now_us: int) -> int:
        """Return the civil time of a moment, greater than all timestamps before."""
        wanted_us = max(now_us + self.offset_us, 0) & ~_LINK_BITS
        self._last_us = max(wanted_us, self._last_us + STEP_US)
        return self._last_us

    def stamp_several(self, now_us: int, count: int) -> int:
        """Return the first timestamp of `count` frames of one moment, `STEP_US` apart."""
        first_us = self.stamp(now_us)
        self._last_us += STEP_US * (count - 1)
        return first_us

    def has_jumped(self, clock: CivilClock) -> bool:
        """Return whether the clock now has a time that differs too much from this file's."""
        offset_us = clock.offset_us
        return offset_us is not None and abs(offset_us - self.offset_us) > JUMP_US


class FrameClock:
    """Times of frames, counted from the first one, derived from times in their messages."""

    def __init__(self, *, by_size: bool = False) -> None:
        self._by_size = by_size
        self.civil_us_at_zero: int | None = None
        """Civil time of the first frame; None until a message contains civil time."""
        self.is_timed = False
        """Whether any message contained a time."""
        self._now_us = 0
        self._line_us = 0.0
        self._bases_us: dict[tuple[int | str, ...], tuple[int, int]] = {}
        """Time at zero of the sender's clock, and its newest time, by sender and field."""

    def time_us(self, frame: bytes) -> int:
        """Return the time of the next frame."""
        self._line_us += len(frame) * 10 * US_PER_S / LINE_BPS
        message_id = message_id_of(frame)
        if names := _TIMES.get(message_id):
            fields = fields_of(frame)
            for name in names:
                if own_us := fields[name] * _UNITS_US[name]:
                    self._update(own_us, (*origin_of(frame), message_id, name))
        return round(self._line_us) if self._by_size else self._now_us

    def _update(self, own_us: int, key: tuple[int | str, ...]) -> None:
        if is_civil(own_us) and self.civil_us_at_zero is None:
            self.civil_us_at_zero = own_us - self._now_us
        self.is_timed = True
        base_us, newest_us = self._bases_us.get(key, (self._now_us - own_us, own_us))
        if is_step(own_us - newest_us):
            base_us = self._now_us - own_us
        self._now_us = max(self._now_us, base_us + own_us)
        self._bases_us[key] = (base_us, own_us)
