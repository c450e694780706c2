"""Moments of a recording as text: `1:20`, `80`, `+10`, `2026-06-11T14:25:30Z`."""

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from gateway.units import US_PER_S

MAX_TEXT: Final = 40
USE: Final = "use 80, 1:20 or 2026-06-11T14:25:30Z"
FIRST_US: Final = 0
LAST_US: Final = 253_402_300_799 * US_PER_S
"""Latest time that other programs read, the end of 9999."""
_CLOCK: Final = re.compile(r"([+-]?)(?:(\d+):)?(?:(\d+):)?(\d+(?:\.\d*)?|\.\d+)\s*s?")


@dataclass(frozen=True, slots=True)
class Moment:
    """A moment of a recording; exactly one of the two is set."""

    offset_s: float | None = None
    """Time from the start, or from the present position if `relative`."""
    relative: bool = False
    time_us: int | None = None
    """Civil time in µs since 1970."""


def parse_moment(text: str) -> Moment:
    """Parse a moment; raises ValueError for any other form."""
    if len(text) > MAX_TEXT:
        raise ValueError(f"invalid time of {len(text)} letters; {USE}")
    if match := _CLOCK.fullmatch(text.strip()):
        sign, first, second, seconds = match.groups()
        hours, minutes = (first, second) if second is not None else ("0", first or "0")
        offset_s = int(hours or 0) * 3600 + int(minutes) * 60 + float(seconds)
        return Moment(-offset_s if sign == "-" else offset_s, relative=bool(sign))
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError as error:
        raise ValueError(f"invalid time {text!r}; {USE}") from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return Moment(time_us=round(moment.timestamp() * US_PER_S))


def civil_time(unix_us: float) -> datetime | None:
    """Return a time in µs since 1970 as UTC; None outside of the years that a calendar can show."""
    try:
        return datetime.fromtimestamp(unix_us / US_PER_S, UTC)
    except (ValueError, OverflowError, OSError):
        return None


def time_us_of(moment: Moment, first_us: int) -> int:
    """Convert a moment to the recording's time, given that of its start."""
    if moment.time_us is not None:
        return moment.time_us
    return first_us + round((moment.offset_s or 0.0) * US_PER_S)


def iso_time(unix_us: int) -> str:
    """Write a time as ISO 8601; a time outside of the calendar as the nearest end."""
    seconds, fraction_us = divmod(min(max(unix_us, FIRST_US), LAST_US), US_PER_S)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction_us // 1000:03d}Z"
