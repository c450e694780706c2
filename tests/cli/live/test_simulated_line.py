"""The simulated receiver's frames from another process: the same ones, for as long as wanted."""

import multiprocessing
import os
from collections.abc import Iterator
from itertools import count, islice

import pytest

from gateway.cli.live.demo import made_ahead
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame

SETTINGS = SimulatorSettings(corrupt_bytes=0.01)


def numbered() -> Iterator[TimedFrame]:
    for k in count():
        yield TimedFrame(float(k), os.getpid().to_bytes(4))


def test_frames_are_those_of_the_simulator() -> None:
    made = list(islice(made_ahead(simulate(SETTINGS).frames()), 200))
    assert made == list(islice(simulate(SETTINGS).frames(), 200))
    assert any(frame.damaged for frame in made)


def test_another_process_makes_them_and_ends_when_nobody_takes_them() -> None:
    before = set(multiprocessing.active_children())
    line = made_ahead(numbered())
    [child] = set(multiprocessing.active_children()) - before
    made = list(islice(line, 1000))
    assert [frame.time_s for frame in made] == list(range(1000))
    assert {int.from_bytes(frame.data) for frame in made} == {child.pid}
    line.close()
    child.join(60.0)
    assert child.exitcode == 0


def test_the_end_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    assert len(list(made_ahead(islice(numbered(), 40)))) == 40
    assert "the simulated receiver has ended" in caplog.text
