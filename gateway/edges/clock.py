"""The gateway clock: the only place that asks the machine for the time."""

import time


class GatewayClock:
    """Microseconds since the daemon started, also those that the machine slept.

    The kernel's monotonic clock stands still while the machine sleeps: civil time would then seem
    to have been set, and what was recorded before would be moved by the length of the sleep.
    """

    def __init__(self) -> None:
        self._start_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def __call__(self) -> int:
        """Return the gateway time in µs."""
        return (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - self._start_ns) // 1000


def unix_time_us() -> int:
    """Return the machine's civil time in µs since 1970; it may jump when the machine learns it."""
    return time.time_ns() // 1000
