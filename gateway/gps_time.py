"""GPS time and UTC.

GPS time has no leap seconds, so it is ahead of UTC by those inserted since its epoch. Leap seconds
are announced half a year in advance, in Bulletin C of the IERS.
"""

from bisect import bisect_right
from datetime import UTC, datetime
from typing import Final

from gateway.units import US_PER_S

GPS_EPOCH_UNIX_US: Final = 315_964_800 * US_PER_S
"""6 January 1980, the epoch of GPS time."""
WEEK_US: Final = 604_800 * US_PER_S
FIRST_YEAR: Final = 2024
"""An earlier date is wrong: the receiver has missed a rollover of the GPS week number (every 1024
weeks), or reports the date of its firmware until it has received that of the satellites."""


def _unix_us(year: int, month: int, day: int = 1) -> int:
    return round(datetime(year, month, day, tzinfo=UTC).timestamp()) * US_PER_S


_LEAPS_US: Final = [
    _unix_us(year, month)
    for year, month in (
        *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7)),
        *((1993, 7), (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7)),
        *((2015, 7), (2017, 1)),
    )
]
"""Civil time at the end of each leap second."""
LEAPS_KNOWN_UNTIL_US: Final = _unix_us(2027, 6, 28)
"""Time up to which no further leap second was announced."""


def unix_us_of_gps(gps_us: int) -> int:
    """Convert the time since the GPS epoch to the time since 1970 in UTC, both in µs."""
    count = bisect_right(
        range(len(_LEAPS_US)),
        gps_us + GPS_EPOCH_UNIX_US,
        key=lambda k: _LEAPS_US[k] + (k + 1) * US_PER_S,
    )
    return gps_us + GPS_EPOCH_UNIX_US - count * US_PER_S


def gps_us_of_unix(unix_us: int) -> int:
    """Convert the time since 1970 in UTC to the time since the GPS epoch, both in µs."""
    return unix_us - GPS_EPOCH_UNIX_US + bisect_right(_LEAPS_US, unix_us) * US_PER_S
