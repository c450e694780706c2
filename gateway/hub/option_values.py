"""Values of an endpoint's options: read and checked; the errors say what is allowed."""

from typing import Final

from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import MESSAGE_IDS

MAX_NAME: Final = 64
MAX_MESSAGE_ID: Final = (1 << 24) - 1
MIN_RATE_HZ: Final = 0.001

NO_MESSAGES: Final = -1
"""An interval that stops a message."""


def message_id_from(text: str) -> int:
    """Return a message id from its name or number.

    Raises
    ------
    ValueError
        If no message has that name.
    """
    if text.isdecimal():
        return number_from(text, "message id", 0, MAX_MESSAGE_ID)
    try:
        return MESSAGE_IDS[text.upper()]
    except KeyError:
        raise ValueError(f"no MAVLink message is called {text!r}") from None


def number_from(text: str, what: str, low: int, high: int) -> int:
    """Read a whole number within bounds; raises ValueError naming what it is."""
    # A number of thousands of digits is refused by Python itself, in words about Python.
    if not text.isascii() or not text.isdecimal() or len(text) > len(str(high)):
        raise ValueError(f"{what} {text!r} is not {low} to {high}")
    if not low <= int(text) <= high:
        raise ValueError(f"{what} {text} is not {low} to {high}")
    return int(text)


def name_from(text: str) -> str:
    """Read a name that tables and texts can show."""
    if not text.strip() or not text.isprintable():
        raise ValueError(f"name {text!r} cannot be shown")
    return text[:MAX_NAME]


def messages_from(text: str) -> frozenset[int]:
    """Read message names or numbers, separated by commas."""
    return frozenset(message_id_from(part) for part in text.split(",") if part)


def intervals_from(text: str) -> dict[int, int]:
    """Read `NAME:hertz`, separated by commas; return the least times between two frames in us."""
    intervals = {}
    for part in filter(None, text.split(",")):
        message, _, rate = part.partition(":")
        try:
            rate_hz = float(rate)
        except ValueError:
            raise ValueError(f"rate {part!r} is not NAME:hertz") from None
        if not (rate_hz == 0 or MIN_RATE_HZ <= rate_hz <= US_PER_S):
            raise ValueError(f"rate {part!r} is not 0, or {MIN_RATE_HZ} to {US_PER_S} Hz")
        interval = round(US_PER_S / rate_hz) if rate_hz else NO_MESSAGES
        intervals[message_id_from(message)] = interval
    return intervals


def yes_or_no(text: str | None) -> bool | None:
    """Read `yes` or `no`; None stays None."""
    if text is None:
        return None
    if text not in {"yes", "no"}:
        raise ValueError(f"trusted {text!r} is not yes or no")
    return text == "yes"
