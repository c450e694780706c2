"""The gateway clock: the only place that asks the machine for the time."""

import time


class GatewayClock:
    """Monotonic microseconds since the daemon started, and their place in civil time."""

    def __init__(self) -> None:
        self._start_ns = time.monotonic_ns()

    def __call__(self) -> int:
        """Return the gateway time in µs."""
        return (time.monotonic_ns() - self._start_ns) // 1000


def unix_time_us() -> int:
    """Return the machine's civil time in µs since 1970; it may jump when the machine learns it."""
    return time.time_ns() // 1000
