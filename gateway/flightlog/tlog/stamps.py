"""Civil time for recordings, on a machine whose clock may be wrong until GPS gives the time.

A ground station considers a tlog corrupt if its times lie in the future or do not grow. So the
offset from the gateway clock to civil time stays fixed as long as a file is open, and a jump needs
a new file.
"""

from typing import Final

from gateway.units import US_PER_S
from gateway.wire.gps_time import GpsTime

JUMP_US: Final = 2 * US_PER_S
"""Larger differences between the known time and the true one are worth a new file. GPS arrival
lags by up to a second, and NTP slews smaller errors away."""
STEP_US: Final = 4
"""Least distance of two stamps: readers take the low two bits for a link's number."""
_LINK_BITS: Final = 3


class CivilClock:
    """The best estimate of civil time: GPS if available, else the machine's clock."""

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._from_gps = False
        self._gps = GpsTime()

    @property
    def offset_us(self) -> int | None:
        """Civil time of gateway time zero in µs since 1970; None before the first time is known."""
        return self._offset_us

    def hear_machine(self, unix_us: int, now_us: int) -> None:
        """Note the machine's civil time; it counts until GPS time is known."""
        if not self._from_gps:
            self._offset_us = unix_us - now_us

    def hear_gps(self, vehicle_id: int, utc_us: int, time_us: int) -> None:
        """Note the time of an aircraft's fix and when it arrived.

        A machine that agrees within `JUMP_US` keeps its own, finer time.
        """
        offset_us = self._gps.hear(vehicle_id, utc_us, time_us)
        if offset_us is None:
            return
        if self._offset_us is None or abs(offset_us - self._offset_us) > JUMP_US:
            self._offset_us = offset_us
            self._from_gps = True


class Stamper:
    """The time stamps of one file: they grow, and follow one fixed offset.

    Parameters
    ----------
    offset_us : int
        Civil time of gateway time zero.
    """

    def __init__(self, offset_us: int) -> None:
        self.offset_us = offset_us
        self._last_us = 0

    def stamp(self, now_us: int) -> int:
        """Return the civil time of a moment, later than every stamp before.

        Parameters
        ----------
        now_us : int
            Gateway clock.

        Returns
        -------
        int
            µs since 1970, a multiple of `STEP_US`.
        """
        wanted_us = max(now_us + self.offset_us, 0) & ~_LINK_BITS
        self._last_us = max(wanted_us, self._last_us + STEP_US)
        return self._last_us

    def has_jumped(self, clock: CivilClock) -> bool:
        """Return whether the clock now knows a time that differs too much for this file."""
        offset_us = clock.offset_us
        return offset_us is not None and abs(offset_us - self.offset_us) > JUMP_US
