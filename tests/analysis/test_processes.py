"""Forked processes: what they leave alone."""

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
    """Its destructor needs threads that a forked process does not have."""

    def __init__(self) -> None:
        self.itself = self

    def __del__(self) -> None:
        COLLECTED.append("a session of the parent")


def collect(_: int) -> list[str]:
    gc.collect()
    return COLLECTED


@pytest.fixture
def _left_over() -> Iterator[None]:
    """Leave garbage to the collector, which does not come before the test is over."""
    gc.collect()
    gc.disable()
    COLLECTED.clear()
    Session()
    yield
    gc.enable()
    assert collect(0), "the parent collects it"


@pytest.mark.io
@pytest.mark.usefixtures("_left_over")
def test_a_worker_collects_nothing_that_its_parent_left() -> None:
    assert dict(LocalProcesses(1).run(collect, [0])) == {0: []}


@pytest.mark.io
@pytest.mark.usefixtures("_left_over")
def test_a_copy_collects_nothing_that_its_parent_left() -> None:
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
def test_copies_end_with_a_parent_that_is_killed(doing: str) -> None:
    """Whatever they are doing: a compiler sends nothing for half a minute."""
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
