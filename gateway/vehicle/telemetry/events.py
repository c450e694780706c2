"""Events of the vehicle, announced as STATUSTEXT at a limited rate.

Theory of operation. Every topic ("link", "GPS fix", a flag of the estimator) has a state, and only
a change of state is announced. After that the topic is held for `HOLD_US`; changes in the meantime
are merged: at the end of the hold its state is announced if it differs from the last one
announced. A flapping topic thus costs at most one text in `HOLD_US`, and the last text is always
right. Single events that have no state go through `say`, at most `BUCKET` at once and one more
every `REFILL_US`.
"""

from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S

CRITICAL: Final = mavlink.MAV_SEVERITY_CRITICAL
WARNING: Final = mavlink.MAV_SEVERITY_WARNING
NOTICE: Final = mavlink.MAV_SEVERITY_NOTICE
INFO: Final = mavlink.MAV_SEVERITY_INFO

HOLD_US: Final = 5 * US_PER_S
BUCKET: Final = 10
REFILL_US: Final = US_PER_S // 2
TEXT_BYTES: Final = 50
"""Length of STATUSTEXT's text; longer texts go out in chunks."""
MAX_TEXT_BYTES: Final = 4 * TEXT_BYTES


@dataclass(frozen=True, slots=True)
class StatusText:
    """A text and its severity."""

    severity: int
    text: str


@dataclass(slots=True)
class _Topic:
    state: object
    announced: object
    text: StatusText
    held_until_us: int = 0


class Announcer:
    """Texts about changes of state, limited in rate.

    Parameters
    ----------
    bucket : int, optional
        Most single events at once.
    refill_us : int, optional
        Time after which one more may be announced.
    """

    def __init__(self, bucket: int = BUCKET, refill_us: int = REFILL_US) -> None:
        self._topics: dict[str, _Topic] = {}
        self._bucket = self._tokens = bucket
        self._refill_us = refill_us
        self._refilled_us = 0
        self._next_id = 0

    def track(
        self, topic: str, state: object, text: StatusText, now_us: int, *, initially: object = None
    ) -> list[Any]:
        """Note the present state of a topic, and announce it if it changed.

        Parameters
        ----------
        topic : str
            Name of the topic.
        state : object
            Any value; compared by equality.
        text : StatusText
            The text for this state.
        now_us : int
            Gateway clock.
        initially : object, optional
            The state in which a new topic begins, which is not announced.

        Returns
        -------
        list of MAVLink_message
        """
        known = self._topics.setdefault(topic, _Topic(initially, initially, text))
        known.state, known.text = state, text
        return self._announce(known, now_us)

    def say(self, text: StatusText, now_us: int) -> list[Any]:
        """Announce a single event, unless there were too many recently."""
        self._refill(now_us)
        if self._tokens == 0:
            return []
        self._tokens -= 1
        return chunks(text, self._number())

    def poll(self, now_us: int) -> list[Any]:
        """Return the states that changed while their topics were held."""
        changed = [topic for topic in self._topics.values() if topic.state != topic.announced]
        return [message for topic in changed for message in self._announce(topic, now_us)]

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to announce."""
        pending = (t.held_until_us for t in self._topics.values() if t.state != t.announced)
        return min(pending, default=None)

    def _announce(self, topic: _Topic, now_us: int) -> list[Any]:
        if topic.state == topic.announced or now_us < topic.held_until_us:
            return []
        topic.announced = topic.state
        topic.held_until_us = now_us + HOLD_US
        return chunks(topic.text, self._number())

    def _number(self) -> int:
        self._next_id = self._next_id % 0xFFFF + 1
        return self._next_id

    def _refill(self, now_us: int) -> None:
        fresh = (now_us - self._refilled_us) // self._refill_us
        if fresh > 0:
            self._tokens = min(self._bucket, self._tokens + fresh)
            self._refilled_us += fresh * self._refill_us


def chunks(text: StatusText, number: int = 1) -> list[Any]:
    """Encode a text as one STATUSTEXT, or as several chunks.

    Parameters
    ----------
    text : StatusText
        ASCII; cut at `MAX_TEXT_BYTES`.
    number : int, optional
        Id of a long text, different from the one before, 1 to 65535.

    Returns
    -------
    list of MAVLink_message
    """
    data = text.text.encode("ascii", "replace")[:MAX_TEXT_BYTES]
    if len(data) <= TEXT_BYTES:
        # Id 0 means a text of one chunk.
        return [mavlink.MAVLink_statustext_message(text.severity, data)]
    # A receiver takes a chunk that is not full for the last one.
    starts = range(0, len(data) + (len(data) % TEXT_BYTES == 0), TEXT_BYTES)
    return [
        mavlink.MAVLink_statustext_message(
            text.severity, data[start : start + TEXT_BYTES], number, chunk
        )
        for chunk, start in enumerate(starts)
    ]
