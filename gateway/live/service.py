"""The process of a gateway: its event loop, the scheduler's priority, notifications to systemd.

The notification protocol is one datagram of text to a socket that the environment names; see
sd_notify(3). Without that variable nothing happens.
"""

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Coroutine
from typing import Any, Final

from gateway.units import US_PER_S

log = logging.getLogger(__name__)

NS_PER_US: Final = 1_000


class ServiceNotifier:
    """Notify systemd that we are ready, alive, reloading or stopping."""

    def __init__(self) -> None:
        self._place = os.environ.get("NOTIFY_SOCKET", "")
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

    def status(self, text: str) -> None:
        """Show one line in `systemctl status`."""
        self._send(f"STATUS={text}")

    def stopping(self) -> None:
        """Report that the service is stopping."""
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
        if not self._place:
            return
        # A leading @ stands for the zero byte of an abstract socket.
        place = "\0" + self._place[1:] if self._place.startswith("@") else self._place
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
                sock.setblocking(False)
                sock.sendto(text.encode(), place)
        except OSError as error:
            log.debug("systemd does not listen: %s", error)


def run_event_loop(main: Coroutine[Any, Any, None], kind: str) -> None:
    """Run a coroutine on an event loop of `hub.event_loop`, on asyncio's if uvloop is missing."""
    make: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
    if kind == "uvloop":
        try:
            import uvloop
        except ModuleNotFoundError:
            log.warning("uvloop is not installed (pip install 'mavgate[fast]'): using asyncio")
        else:
            make = uvloop.new_event_loop
    with asyncio.Runner(loop_factory=make) as runner:
        runner.run(main)


def set_realtime_priority(priority: int) -> None:
    """Request the round-robin real-time scheduler, for this thread and none that it starts.

    On a busy machine this keeps the worst latency below a millisecond, which niceness does not.
    The threads that write to the disk do not get it.

    Parameters
    ----------
    priority : int
        1 to 99, and 1 is already above everything ordinary; 0 goes back to the usual scheduler.
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
    try:
        return int(os.environ.get("WATCHDOG_USEC", "0")) / US_PER_S / 2
    except ValueError:
        return 0.0
