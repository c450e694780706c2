"""Forked processes: what they leave alone."""

import gc
from collections.abc import Iterator

import pytest

from gateway.analysis.processes import copies
from gateway.season.executors import LocalProcesses

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
    with copies(1, lambda: None) as pool:
        assert pool.map(collect, [0]) == [[]]
