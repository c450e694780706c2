"""A process that ends with the one that started it, by a signal, or with its terminal."""

import asyncio
import os
import select
import signal
import subprocess
import sys

import pytest

from gateway.live.terminal import on_end_signals

pytestmark = pytest.mark.io

CHILD = """
import asyncio
from gateway.live.terminal import on_parent_gone

async def main():
    gone = asyncio.Event()
    on_parent_gone(gone.set)
    print("ready", flush=True)
    await gone.wait()

asyncio.run(main())
"""
PARENT = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], stdin=subprocess.PIPE)
print(child.pid, flush=True)
child.wait()
"""


def test_a_parent_that_is_killed_takes_its_child_along() -> None:
    words = [sys.executable, "-c", PARENT, CHILD]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        first, second = sorted(parent.stdout.readline().strip() for _ in range(2))
        assert second == "ready"
        child = os.pidfd_open(int(first))
        try:
            assert not select.select([child], [], [], 0)[0]
            parent.send_signal(signal.SIGKILL)
            assert select.select([child], [], [], 120)[0]
        finally:
            os.close(child)


@pytest.mark.parametrize("is_ignored", [False, True])
async def test_the_end_of_the_terminal_stays_ignored_where_it_is(is_ignored: bool) -> None:
    """As `nohup` has it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if is_ignored else signal.SIG_DFL)
    calls: list[bool] = []
    on_end_signals(lambda: calls.append(True))
    try:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        while not calls:
            await asyncio.sleep(0)
        assert len(calls) == (1 if is_ignored else 2)
    finally:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().remove_signal_handler(number)
        signal.signal(signal.SIGHUP, before)
