"""A process that ends with the one that started it."""

import os
import select
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.io

CHILD = """
import asyncio
from gateway.edges.operator.attachment import on_parent_gone

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
