"""The schedule of each message: at its own interval, on the clock of the samples that trigger it.

Theory of operation. A message about the attitude is most useful when its sample arrives, so no
timer sends it: every sample is offered to its stream, and the stream uses the samples nearest to a
grid of its own interval. Three effects could disturb that:

- *Drift.* The grid advances by the interval, not from the sample that was sent, so 50 Hz out of
  60 Hz samples stays 50 Hz.
- *Beating.* With samples at nearly a multiple of the rate, the grid would slide across the samples
  and occasionally skip or double one. The grid is therefore corrected by a sixteenth of the
  difference to each sample that is sent. If the sample rate is within 3 % of a multiple, the grid
  locks, and every n-th sample is sent; otherwise the corrections cancel out over a period.
- *Bursts.* After a gap, or if samples arrive more slowly than the interval, the missed points of
  the grid are skipped, so a sample is sent at most once.

Messages that no sample triggers (such as HEARTBEAT) use the same grid by `tick`.

Many intervals are multiples of each other, so messages whose grids begin at the same time are
always due together, and sending them delays the event loop. `begin` gives them different starting
times, which a gap does not change.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from gateway.records import BaroSample, GpsFix, ImuSample, NavState
from gateway.units import US_PER_S

OFF: Final = -1
"""Interval of a message that is not sent, as in MESSAGE_INTERVAL."""

LEAN: Final = 16
"""Divisor of the correction: locks within 3 % of a multiple, averages jitter over 16 samples."""
PACE_WEIGHT: Final = 8
MAX_PERIOD_US: Final = US_PER_S
"""A longer gap does not count as an interval of samples."""


def interval_us(rate_hz: float) -> int:
    """Convert a rate to an interval; a rate of 0 to `OFF`."""
    return round(US_PER_S / rate_hz) if rate_hz > 0.0 else OFF


class Pace:
    """Average interval of the last samples."""

    def __init__(self) -> None:
        self._last_us: int | None = None
        self._period_us = 0

    def update(self, time_us: int) -> int:
        """Add the time of a sample; return the present period in us, 0 at the first sample."""
        period_us = self._period_us
        if self._last_us is not None and 0 < (gap_us := time_us - self._last_us) <= MAX_PERIOD_US:
            period_us = period_us or gap_us
            self._period_us = period_us = period_us + (gap_us - period_us) // PACE_WEIGHT
        self._last_us = time_us
        return period_us


class Stream:
    """One message's schedule."""

    def __init__(self, interval: int) -> None:
        self.interval_us = interval
        self.due_us: int | None = None
        """When the message is due next; None while it is off or has not started."""
        self._pace = Pace()

    def begin(self, time_us: int) -> None:
        """Start the grid at a time."""
        if self.interval_us != OFF:
            self.due_us = time_us

    def change(self, interval: int) -> None:
        """Set a new interval, counted from the next sample."""
        self.interval_us = interval
        self.due_us = None

    def offer(self, time_us: int) -> bool:
        """Return whether the sample of this time is to be sent."""
        return self.offer_paced(time_us, self._pace.update(time_us))

    def offer_paced(self, time_us: int, period_us: int) -> bool:
        """Do the same with the known period of samples that several streams share."""
        interval_us = self.interval_us
        if interval_us == OFF:
            return False
        due_us = time_us if self.due_us is None else self.due_us
        late = time_us - due_us
        if late < -(period_us // 2):
            return False
        if late > interval_us:
            self.due_us = due_us + late // interval_us * interval_us + interval_us
        else:
            self.due_us = due_us + interval_us + late // LEAN
        return True

    def tick(self, now_us: int) -> bool:
        """Return whether a message that no sample triggers is due."""
        if self.interval_us == OFF:
            return False
        due_us = now_us if self.due_us is None else self.due_us
        if now_us < due_us:
            return False
        missed = (now_us - due_us) // self.interval_us if now_us > due_us + self.interval_us else 0
        self.due_us = due_us + (missed + 1) * self.interval_us
        return True


class NewestRecords:
    """The newest records of one aircraft, each None until the first is received."""

    state: NavState | None = None
    sample: ImuSample | None = None
    baro: BaroSample | None = None
    fix: GpsFix | None = None


@dataclass(frozen=True, slots=True)
class AddedMessage:
    """One message, its rate, and the function that builds it."""

    message_id: int
    rate_hz: float
    build: Callable[[NewestRecords], Any]
    """Returns a pymavlink message, or None if there is nothing to send."""


ADDED_MESSAGES: Final[dict[int, AddedMessage]] = {}


def add_message(
    message_id: int, rate_hz: float, build: Callable[[NewestRecords], Any]
) -> AddedMessage:
    """Add a message to every vehicle created from now on.

    Parameters
    ----------
    message_id : int
        Id in the `common` dialect, so that recordings and routers support it.
    rate_hz : float
        Rate of the message; a client may request another one, as for any message.
    build : callable
        Builds it from the newest records.

    Returns
    -------
    AddedMessage

    Raises
    ------
    ValueError
        If the rate is not positive, or the message was added before.
    """
    if not rate_hz > 0.0:
        raise ValueError(f"rate of message {message_id} is {rate_hz} Hz; it must be positive")
    if message_id in ADDED_MESSAGES:
        raise ValueError(f"message {message_id} is added twice")
    added = ADDED_MESSAGES[message_id] = AddedMessage(message_id, rate_hz, build)
    return added
