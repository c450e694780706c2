"""Forked processes: garbage of the parent, and the end of the parent."""

import gc
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress

import pytest

from gateway.analysis.processes import forked
from gateway.batch.executors import LocalProcesses

COLLECTED: list[str] = []


class Session:
    """Object in a cycle; a real destructor may need threads that a forked process lacks."""

    def __init__(self) -> None:
        self.itself = self

    def __del__(self) -> None:
        COLLECTED.append("a session of the parent")


def collect(_: int) -> list[str]:
    gc.collect()
    return COLLECTED


@pytest.fixture
def _left_over() -> Iterator[None]:
    """Leave garbage that the parent does not collect before the test ends."""
    gc.collect()
    gc.disable()
    COLLECTED.clear()
    Session()
    yield
    gc.enable()
    assert collect(0), "the parent collects it"


@pytest.mark.io
@pytest.mark.usefixtures("_left_over")
def test_processes_do_not_collect_garbage_of_their_parent() -> None:
    assert dict(LocalProcesses(1).run(collect, [0])) == {0: []}
    with forked(collect, 2) as run:
        assert dict(run([0, 1])) == {0: [], 1: []}


PARENT = """
import multiprocessing, time
from gateway.analysis.processes import begin_copy

def work(_, sender):
    while True:
        {doing}

receivers = [begin_copy(work, None) for _ in range(2)]
print(*(child.pid for child in multiprocessing.active_children()), flush=True)
time.sleep(3600.0)
"""


@pytest.mark.io
@pytest.mark.parametrize("doing", ["sender.send(bytes(100_000))", "time.sleep(0.1)"])
def test_copies_end_when_their_parent_is_killed(doing: str) -> None:
    """Copies that send, and those that do not: a compiler sends nothing for half a minute."""
    program = PARENT.format(doing=doing)
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        children = [os.pidfd_open(int(pid)) for pid in parent.stdout.readline().split()]
        try:
            parent.send_signal(signal.SIGKILL)
            assert len(children) == 2
            for child in children:
                assert select.select([child], [], [], 20.0)[0]
        finally:
            for child in children:
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(child, signal.SIGKILL)
                os.close(child)
