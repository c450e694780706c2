"""The process of a gateway: event loop, real-time priority, notifications to systemd.

The notification protocol is one datagram of text to a socket that the environment names; see
sd_notify(3). Without that variable nothing happens.

`LoopLag` detects that the event loop does not get the processor time it needs: the daemon's timer
measures how late it is called. A single long delay, or many short ones, mean that the computer is
too slow or was suspended: samples are then lost here, which must not count as a fault of the nodes
or the radio.
"""

import asyncio
import logging
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Final

from gateway.extras import how_to_add
from gateway.units import NS_PER_US, US_PER_S

log = logging.getLogger(__name__)
STALL_US: Final = 500_000
"""Shortest delay that loses samples: the kernel buffers about 0.4 s of them."""
SPAN_US: Final = 10 * US_PER_S
MAX_SHARE: Final = 0.3
"""Share of the span above which the sum of delays means that the loop is too slow."""
WARM_UP_US: Final = 5 * US_PER_S
"""Delays at the start do not count: loading machine code takes 0.25 s on a PC, and several times
that on a small board."""
RECOVERED_US: Final = 60 * US_PER_S
MAX_DELAYS: Final = 1000
"""Maximum delays in a span; the timer fires at most every millisecond, but only delays are kept."""
LEAST_DELAY_US: Final = 20_000
NEVER_US: Final = 1 << 62


class ServiceNotifier:
    """Notify systemd that the service is ready, alive, reloading or stopping."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        self._interval_s = _watchdog_interval_s()
        self._timer: asyncio.TimerHandle | None = None

    def ready(self) -> None:
        """Report that the service works, and from now on that it is alive; needs a running loop."""
        self._send("READY=1")
        if self._interval_s:
            self._beat()

    def reloading(self) -> None:
        """Report that settings are being read again; `ready` ends it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // NS_PER_US}")

    def stopping(self) -> None:
        """Report to systemd an end on purpose, and send no more keepalives."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._send("STOPPING=1")

    def _beat(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._send("WATCHDOG=1")
        self._timer = asyncio.get_running_loop().call_later(self._interval_s, self._beat)

    def _send(self, text: str) -> None:
        if not self._address:
            return
        # A leading @ means the zero byte of an abstract socket.
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
                sock.setblocking(False)
                sock.sendto(text.encode(), address)
        except OSError as error:
            log.debug("systemd does not listen: %s", error)


def run_event_loop(main: Coroutine[Any, Any, None], kind: str) -> None:
    """Run a coroutine on an event loop of `hub.event_loop`, on asyncio's if uvloop is missing."""
    make: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
    if kind == "uvloop":
        try:
            import uvloop
        except ModuleNotFoundError:
            log.warning("%s; using asyncio", how_to_add("hub.event_loop = uvloop", "fast"))
        else:
            make = uvloop.new_event_loop
    with asyncio.Runner(loop_factory=make) as runner:
        runner.run(main)


def set_realtime_priority(priority: int) -> None:
    """Request the round-robin real-time scheduler for this thread only.

    On a busy machine this keeps the worst latency below a millisecond, which niceness does not.
    Threads that it starts, such as those that write to the disk, keep the usual scheduler. Of the
    priorities 1 to 99, 1 is already above all ordinary threads; 0 restores the usual scheduler.
    """
    policy = os.SCHED_RR if priority else os.SCHED_OTHER
    try:
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        log.warning("no real-time priority: %s; needs CAP_SYS_NICE or LimitRTPRIO", error)


def _watchdog_interval_s() -> float:
    """Return half of systemd's watchdog time; 0 without a watchdog."""
    owner = os.environ.get("WATCHDOG_PID", "")
    if owner and owner != str(os.getpid()):
        return 0.0
    return int(os.environ.get("WATCHDOG_USEC", "0")) / US_PER_S / 2


class LoopLag:
    """The delays of one event loop."""

    def __init__(self) -> None:
        self.is_slow = False
        self.longest_us = 0
        """The longest delay since the state changed to slow."""
        self._delays: deque[tuple[int, int]] = deque(maxlen=MAX_DELAYS)
        self._slow_us = 0
        self.stalled_after_us = NEVER_US
        """After this time, a timer that has not been called yet is late by a stall."""
        self._due_us: int | None = None
        self._begin_us: int | None = None

    def expect(self, due_us: int) -> None:
        """Set when the timer is to be called next."""
        self._due_us = due_us
        self.stalled_after_us = due_us + STALL_US

    def update(self, now_us: int) -> int:
        """Add one call of a timer; return the duration of a stall that has just ended, or 0."""
        self.stalled_after_us = NEVER_US
        if self._begin_us is None:
            self._begin_us = now_us
        delay_us = 0 if self._due_us is None else now_us - self._due_us
        self._due_us = None
        if delay_us >= LEAST_DELAY_US:
            self._delays.append((now_us, delay_us))
        while self._delays and self._delays[0][0] <= now_us - SPAN_US:
            self._delays.popleft()
        total_us = sum(delay for _, delay in self._delays)
        stalled_us = delay_us if delay_us >= STALL_US else 0
        is_warm = now_us - self._begin_us >= WARM_UP_US
        if is_warm and (stalled_us or total_us > MAX_SHARE * SPAN_US):
            self.longest_us = max(delay_us, self.longest_us if self.is_slow else 0)
            self.is_slow, self._slow_us = True, now_us
        elif now_us - self._slow_us > RECOVERED_US:
            self.is_slow = False
        return stalled_us
