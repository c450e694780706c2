"""The gateway clock; only this module reads the machine's clocks."""

import time


class GatewayClock:
    """Time in µs since the daemon started, including time in which the machine was suspended.

    The kernel's monotonic clock stops during suspension: civil time would then seem to have been
    set, and the recording so far would be shifted by the time of suspension.
    """

    def __init__(self) -> None:
        self._start_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def __call__(self) -> int:
        """Return the gateway time in µs."""
        return (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - self._start_ns) // 1000


def unix_time_us() -> int:
    """Return the machine's civil time in µs since 1970; it may jump when the clock is set."""
    return time.time_ns() // 1000
