import os
import signal
from pathlib import Path

import pytest

from gateway.analysis import processes
from gateway.analysis.processes import run_copies

pytestmark = pytest.mark.io


def leave_a_mark(path: Path) -> None:
    path.write_text(str(os.getpid()))


def be_killed(_path: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_the_work_is_done_in_other_processes(tmp_path: Path) -> None:
    marks = [tmp_path / "one", tmp_path / "two"]
    run_copies(leave_a_mark, marks)
    assert all(int(mark.read_text()) != os.getpid() for mark in marks)


def test_a_copy_that_is_killed_is_not_waited_for(tmp_path: Path) -> None:
    run_copies(be_killed, [tmp_path])


def wait_for(path: Path) -> None:
    while not path.exists():
        pass


def test_the_waiting_may_be_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "WAIT_S", 0.01)
    looks: list[int] = []

    def look() -> None:
        looks.append(1)
        if len(looks) == 3:
            (tmp_path / "go").touch()

    run_copies(wait_for, [tmp_path / "go"], look)
    assert len(looks) >= 3
