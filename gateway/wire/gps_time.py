"""Civil time from the GPS receivers of all aircraft, robust against a single wrong one."""

from collections import deque
from statistics import median_low
from typing import Final

RECENT: Final = 15
"""Number of newest fixes used of each aircraft: some seconds."""
ENOUGH: Final = 3
"""Number of fixes before an aircraft is used: the first may hold the time of the last flight."""


class GpsTime:
    """Offset of the gateway clock to civil time: the median of the aircraft's medians."""

    def __init__(self) -> None:
        self._offsets_us: dict[int, deque[int]] = {}

    def update(self, vehicle_id: int, utc_us: int, time_us: int) -> int | None:
        """Note the time of a fix.

        The arrival is used as the time of the fix: late by the latency, so never in the future.

        Parameters
        ----------
        vehicle_id : int
            Whose fix it is.
        utc_us : int
            Time of the fix in µs since 1970.
        time_us : int
            Its arrival on the gateway clock.

        Returns
        -------
        int or None
            Civil time of gateway time zero in µs since 1970; None while there are too few fixes.
        """
        offsets_us = self._offsets_us.setdefault(vehicle_id, deque(maxlen=RECENT))
        offsets_us.append(utc_us - time_us)
        medians = [median_low(each) for each in self._offsets_us.values() if len(each) >= ENOUGH]
        return median_low(medians) if medians else None
