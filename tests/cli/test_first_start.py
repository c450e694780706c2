"""What runs before everything is compiled, and what helps at the prompt."""

import asyncio
import errno
import logging
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from gateway.cli.app import app
from gateway.cli.support import warm_up
from gateway.cli.support.warm_up import ENTRY_POINTS, SCANNER, make_ready
from gateway.compiled import address_of, array_at, compiled_with, machine_code
from gateway.compiled.entry_point import EntryPoint

pytestmark = pytest.mark.io

START_LIMIT_S = 600.0
"""A busy machine compiles for more than a minute."""


FLOAT = np.dtype(np.float64)


def divide(numbers: int) -> None:
    """Python raises at zero, machine code writes infinity."""
    two = array_at(numbers, (2,), FLOAT)
    two[0] = two[0] / two[1]


def quotient(entry_point: EntryPoint[int], one: float, other: float) -> float:
    numbers = np.array([one, other])
    entry_point(address_of(numbers))
    return float(numbers[0])


@pytest.fixture
def points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, EntryPoint[int]]:
    """Stand for what a gateway needs, with nothing cached."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    found = {
        name: EntryPoint(compiled_with(divide, {}, str(k))) for k, name in enumerate(ENTRY_POINTS)
    }
    monkeypatch.setattr(warm_up, "ENTRY_POINTS", {name: (one,) for name, one in found.items()})
    monkeypatch.setattr(warm_up, "_rehearse", lambda _: None)
    return found


@pytest.fixture
def compiled_names(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names that are compiled, in their order."""
    names: list[str] = []
    monkeypatch.setattr(warm_up, "Compilation", names.extend)
    return names


def test_the_first_start_runs_as_python_until_the_machine_code_comes(
    points: dict[str, EntryPoint[int]],
) -> None:
    compiling = make_ready("eskf")
    assert compiling is not None
    for point in points.values():
        assert quotient(point, 7.0, 2.0) == 3.5
        assert quotient(point, 1.0, 0.0) == 1.0, "what Python refuses is left out"
    machine = []
    while compiling.take_one():
        machine.append([name for name, p in points.items() if quotient(p, 1.0, 0.0) == math.inf])
        for child in multiprocessing.active_children():
            os.kill(child.pid, signal.SIGINT)  # The terminal's: it is for the parent to end.
    assert [len(names) for names in machine] == [1, 2, 3, 4]
    assert machine[0] == [SCANNER]
    assert set(machine[1]) == {SCANNER, "eskf"}
    assert make_ready("eskf") is None, "all of it is cached"


async def test_the_event_loop_takes_the_machine_code(points: dict[str, EntryPoint[int]]) -> None:
    compiling = make_ready("paper")
    assert compiling is not None
    compiling.watch()
    async with asyncio.timeout(START_LIMIT_S):
        while any(quotient(point, 1.0, 0.0) == 1.0 for point in points.values()):
            await asyncio.sleep(0.01)


async def test_the_event_loop_does_not_wait_for_what_comes_slowly(
    points: dict[str, EntryPoint[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    receiver, sender = multiprocessing.Pipe(duplex=False)
    monkeypatch.setattr(warm_up, "begin_copy", lambda *_: receiver)
    compiling = make_ready("paper")
    assert compiling is not None
    messages = [("paper", 0, points["paper"].code())]
    sender.send("the beginning of one")
    loop_goes_on = threading.Event()

    def receive() -> tuple[str, int, machine_code.MachineCode]:
        if not messages or not loop_goes_on.wait(timeout=5.0):
            raise EOFError
        return messages.pop()

    monkeypatch.setattr(receiver, "recv", receive)
    compiling.watch()
    for _ in range(3):
        await asyncio.sleep(0.0)
    loop_goes_on.set()
    async with asyncio.timeout(START_LIMIT_S):
        while not receiver.closed:
            await asyncio.sleep(0.01)
    await asyncio.sleep(0.0)  # What the thread has handed over before comes first.
    assert quotient(points["paper"], 1.0, 0.0) == math.inf


def test_without_a_compiler_it_goes_on_as_python(
    points: dict[str, EntryPoint[int]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(warm_up, "_compile", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    compiling = make_ready("paper")
    assert compiling is not None
    assert not compiling.take_one()
    assert "the compiler has failed" in caplog.text
    assert quotient(points["paper"], 7.0, 2.0) == 3.5


@contextmanager
def no_descriptors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as short:
        none_left = OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        short.setattr(machine_code.tempfile, "NamedTemporaryFile", Mock(side_effect=none_left))
        by_llvm = Mock(side_effect=none_left)
        short.setattr(machine_code, "_load_by_llvm", by_llvm)
        with pytest.raises(OSError, match="Too many"):
            machine_code.load_code(machine_code.MachineCode(b"", b"library"))
        by_llvm.assert_not_called()
        yield


def test_what_cannot_be_loaded_now_goes_on_as_python_and_is_reported_once(
    points: dict[str, EntryPoint[int]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Without an event loop, too, which tries again."""
    compiling = make_ready("eskf")
    assert compiling is not None
    with no_descriptors(monkeypatch):
        while compiling.take_one():
            pass
    assert all(quotient(point, 1.0, 0.0) == 1.0 for point in points.values()), "as Python"
    assert [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING] == [
        "machine code is loaded later: [Errno 24] Too many open files"
    ]


async def test_what_cannot_be_loaded_now_is_loaded_later(
    points: dict[str, EntryPoint[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    later: list[Callable[[], None]] = []
    loop = asyncio.get_running_loop()
    compiling = make_ready("eskf")
    assert compiling is not None
    monkeypatch.setattr(loop, "call_later", lambda _, work: later.append(work))
    with no_descriptors(monkeypatch):
        while compiling.take_one():
            pass
        compiling.watch()
        later.pop()()
    assert all(quotient(point, 1.0, 0.0) == 1.0 for point in points.values()), "as Python"
    later.pop()()
    assert all(quotient(point, 1.0, 0.0) == math.inf for point in points.values())


def test_the_chosen_estimators_are_compiled_first(
    points: dict[str, EntryPoint[int]], compiled_names: list[str]
) -> None:
    make_ready("eskf", "complementary")
    assert compiled_names == [SCANNER, "eskf", "complementary", "paper"]


def test_what_is_cached_is_not_compiled(
    points: dict[str, EntryPoint[int]], compiled_names: list[str]
) -> None:
    for name in ("paper", SCANNER):
        points[name].prepare()
    make_ready("complementary")
    assert compiled_names == ["complementary", "eskf"]


def test_the_gateway_holds_no_machine_code_that_is_not_made_ready() -> None:
    """What it may call while telemetry flows; whole recordings are fused by other commands."""
    tell = (
        "import gc, gateway.cli.live.run;"
        "from gateway.compiled.entry_point import EntryPoint;"
        "points = {p for p in gc.get_objects() if isinstance(p, EntryPoint)};"
        "from gateway.cli.support.warm_up import ENTRY_POINTS;"
        "ready = {p for points in ENTRY_POINTS.values() for p in points};"
        "print(*sorted(p.__name__ for p in points - ready), len(ready))"
    )
    done = subprocess.run([sys.executable, "-c", tell], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["run", "run", "10"]


@pytest.mark.parametrize(
    ("typed", "offered"), [("mavgate doc", "doctor"), ("mavgate check-config --he", "--help")]
)
def test_the_shell_completes_commands_and_options(
    typed: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_MAVGATE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    monkeypatch.setattr(sys, "argv", ["mavgate"])
    with pytest.raises(SystemExit):
        app(prog_name="mavgate")
    assert offered in capsys.readouterr().out.split()
