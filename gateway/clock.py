"""The gateway clock: the only place that reads the machine's clocks."""

import time


class GatewayClock:
    """Microseconds since the daemon started, suspended time included.

    The kernel's monotonic clock stops while the machine is suspended: civil time would then seem
    to have been set, and the earlier recording would be shifted by that time.
    """

    def __init__(self) -> None:
        self._start_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def __call__(self) -> int:
        """Return the gateway time in µs."""
        return (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - self._start_ns) // 1000


def unix_time_us() -> int:
    """Return the machine's civil time in µs since 1970; it may jump when the clock is set."""
    return time.time_ns() // 1000
