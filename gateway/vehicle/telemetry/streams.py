"""When each message is due: at its own interval, on the clock of the samples that carry it.

Theory of operation. A message about the attitude is most useful when its sample arrives, so no
timer sends it: every sample is offered to its stream, and the stream takes the samples nearest to
a grid of its own interval. Three effects could disturb that:

- *Drift.* The grid advances by the interval, not from the sample that was sent, so 50 Hz out of
  60 Hz samples stays 50 Hz.
- *Beating.* With samples at nearly a multiple of the rate, the grid would slide across the samples
  and now and then skip or double one. The grid therefore leans a sixteenth of the way towards
  each sample it takes. Where the sample rate is within 3 % of a multiple the grid locks on, and
  every n-th sample is sent; elsewhere the pulls cancel out over a period.
- *Bursts.* After a gap, or where samples come slower than the interval, the moments that were
  missed are left out, so a sample is sent once at most.

Messages that no sample carries (HEARTBEAT and the like) run on the same grid by `tick`.

Many intervals are multiples of each other, so messages whose grids begin at the same moment are
due together, again and again, and the loop that sends them does nothing else meanwhile. `begin`
sets them apart, and a gap leaves them so.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from gateway.records import BaroSample, GpsFix, ImuSample, NavState
from gateway.units import US_PER_S

OFF: Final = -1
"""Interval of a message that is not sent, as in MESSAGE_INTERVAL."""

LEAN: Final = 16
"""A sixteenth: locks within 3 % of a multiple, and averages jitter over 16 samples."""
PACE_WEIGHT: Final = 8
MAX_PERIOD_US: Final = US_PER_S
"""A longer gap says nothing about the pace of the samples."""


def interval_us(rate_hz: float) -> int:
    """Convert a rate to an interval; a rate of 0 to `OFF`."""
    return round(US_PER_S / rate_hz) if rate_hz > 0.0 else OFF


class Pace:
    """How far apart samples come, on average over the last few."""

    def __init__(self) -> None:
        self._last_us: int | None = None
        self._period_us = 0

    def update(self, time_us: int) -> int:
        """Use the time of a sample; return the present period in us; 0 at the first."""
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
        """Do the same where several streams are carried by the same samples, of a known pace."""
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
        """Return whether a message that no sample carries is due."""
        if self.interval_us == OFF:
            return False
        due_us = now_us if self.due_us is None else self.due_us
        if now_us < due_us:
            return False
        missed = (now_us - due_us) // self.interval_us if now_us > due_us + self.interval_us else 0
        self.due_us = due_us + (missed + 1) * self.interval_us
        return True


@dataclass(frozen=True, slots=True)
class NewestRecords:
    """The newest records of one aircraft, each None until the first has come."""

    state: NavState | None
    sample: ImuSample | None
    baro: BaroSample | None
    fix: GpsFix | None


@dataclass(frozen=True, slots=True)
class AddedMessage:
    """One message, its rate, and the function that builds it."""

    message_id: int
    rate_hz: float
    build: Callable[[NewestRecords], Any]
    """Returns a message of pymavlink, or None while there is nothing to send."""


ADDED_MESSAGES: Final[dict[int, AddedMessage]] = {}


def add_message(
    message_id: int, rate_hz: float, build: Callable[[NewestRecords], Any]
) -> AddedMessage:
    """Add a message to every vehicle created from now on.

    Parameters
    ----------
    message_id : int
        Of the `common` dialect, so that recordings and routers know it.
    rate_hz : float
        How often it is sent; a client may request another rate, as for any message.
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
