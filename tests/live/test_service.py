"""Notifications to systemd, real-time priority, and delays of the event loop."""

import asyncio
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.live.service import LEAST_DELAY_US, LoopLag, ServiceNotifier, set_realtime_priority

pytestmark = pytest.mark.io


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        sock.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.delenv("WATCHDOG_USEC", raising=False)
        yield sock


async def test_systemd_is_notified_of_every_state(systemd: socket.socket) -> None:
    notifier = ServiceNotifier()
    notifier.ready()
    notifier.reloading()
    notifier.stopping()
    notified = [systemd.recv(200).decode() for _ in range(3)]
    assert notified[0] == "READY=1"
    assert notified[1].startswith("RELOADING=1\nMONOTONIC_USEC=")
    assert notified[2] == "STOPPING=1"


async def test_watchdog_is_notified_at_twice_its_rate(
    systemd: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "20000")
    loop, delays, handles = asyncio.get_running_loop(), [], []
    call_later = loop.call_later

    def note(delay_s: float, *call: Any) -> asyncio.TimerHandle:
        delays.append(delay_s)
        handles.append(call_later(delay_s, *call))
        return handles[-1]

    monkeypatch.setattr(loop, "call_later", note)
    notifier = ServiceNotifier()
    notifier.ready()
    assert delays == [0.01]
    notified = [await asyncio.wait_for(loop.sock_recv(systemd, 200), 60) for _ in range(4)]
    assert notified == [b"READY=1"] + [b"WATCHDOG=1"] * 3
    notifier.stopping()
    assert handles[-1].cancelled()


async def test_watchdog_of_another_process_or_absent_systemd_is_not_notified(
    systemd: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "20000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid() + 1))
    for address in (os.environ["NOTIFY_SOCKET"], "", "/no/such/socket"):
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        ServiceNotifier().ready()
    assert systemd.recv(200) == b"READY=1"
    with pytest.raises(BlockingIOError):
        systemd.recv(200)


def test_realtime_priority_is_requested_and_a_refusal_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[tuple[int, int]] = []

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        if param.sched_priority > 50:
            raise PermissionError("not allowed")
        asked.append((policy, param.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    set_realtime_priority(1)
    set_realtime_priority(0)
    assert [(policy & ~os.SCHED_RESET_ON_FORK, level) for policy, level in asked] == [
        (os.SCHED_RR, 1),
        (os.SCHED_OTHER, 0),
    ]
    set_realtime_priority(99)
    assert "CAP_SYS_NICE" in caplog.text


REAL_TIME = """
import os, threading
from gateway.live.service import set_realtime_priority
policies = []
note = lambda: policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
set_realtime_priority(1)
note()
thread = threading.Thread(target=note)
thread.start()
thread.join()
set_realtime_priority(0)
note()
print(policies == [os.SCHED_RR, os.SCHED_OTHER, os.SCHED_OTHER])
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may have real-time priority")
def test_kernel_grants_realtime_priority_to_the_calling_thread_only() -> None:
    run = subprocess.run(
        [sys.executable, "-c", REAL_TIME], capture_output=True, text=True, check=True
    )
    if "not permitted" in run.stderr:
        pytest.skip("this machine forbids real-time priority")
    assert run.stdout == "True\n"


S = 1_000_000


TIMES: dict[str, list[tuple[int, int, int, bool]]] = {
    "short delays are normal": [
        (n * S // 10, 50_000 if n % 5 == 0 else 1_000, 0, False) for n in range(1000)
    ],
    "many delays that are hardly one are normal": [
        (n * S // 25, LEAST_DELAY_US - 1, 0, False) for n in range(1000)
    ],
    "stall at the start is normal": [(0, 0, 0, False), (2 * S, 2 * S, 2 * S, False)],
    "stall is reported until a minute without one": [
        (2 * S, 2 * S, 2 * S, False), (10 * S, 3 * S, 3 * S, True), (15 * S, S, S, True),
        *((n * S, 0, 0, n < 83) for n in range(17, 120)),
    ],
    "many short delays mean that the computer is too slow": [
        (n * S // 2, 300_000, 0, n >= 10) for n in range(100)
    ],
}  # fmt: skip
"""When a call was due, its delay, the stall that it shows, and whether the loop is slow then."""


@pytest.mark.parametrize("name", TIMES)
def test_stalls_and_many_delays_are_noticed(name: str) -> None:
    lag, longest_us = LoopLag(), 0
    for due_us, delay_us, stall_us, is_slow in TIMES[name]:
        lag.expect(due_us)
        assert (lag.update(due_us + delay_us), lag.is_slow) == (stall_us, is_slow), due_us
        longest_us = max(longest_us, delay_us if is_slow else 0)
    assert lag.longest_us == longest_us
