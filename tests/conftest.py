"""Fixtures for every test: seeded chance, a manual clock, real flights where there are any."""

import asyncio
import gc
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from types import NoneType
from typing import Any

import hypothesis
import msgspec
import numpy as np
import pytest

hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("repeatable")

USERS_OWN = (
    *("XDG_CONFIG_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_RUNTIME_DIR"),
    *("MAVGATE_SOCKET", "NOTIFY_SOCKET", "RUNTIME_DIRECTORY"),
)
"""Variables that name a user's folders, or mark a process as a service."""

ROOT = Path(__file__).resolve().parent.parent
LONGEST_ID = 80
"""Maximum characters of a value in the name of a case."""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels if their sources have changed, before the workers start."""
    if not hasattr(session.config, "workerinput"):
        subprocess.run([sys.executable, "-m", "tools.build_kernels"], cwd=ROOT, check=True)


def pytest_configure() -> None:
    """Let children begin with the default action of SIGHUP, which `nohup` has pytest ignore."""
    # Collecting makes a million objects that stay: the garbage collector need not look at them.
    gc.disable()
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        # A handler is not inherited by a new program; an ignored signal is.
        signal.signal(signal.SIGHUP, lambda *_: None)


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Name the cases of a test by the values, and numbers by their parameter too."""
    if isinstance(val, bool):
        return argname if val else f"not {argname}"
    if isinstance(val, int | float) and not isinstance(val, Enum):
        return f"{argname} {val}"
    if isinstance(val, str | bytes):
        return repr(val[:LONGEST_ID]) if len(val) > LONGEST_ID else None
    return described(val)


def described(value: object) -> str | None:
    """Return a short text of a value that is the same in each worker, if there is one."""
    if isinstance(value, msgspec.Struct):
        value = {
            field.name: here
            for field in msgspec.structs.fields(value)
            if (here := getattr(value, field.name)) != field.default
        }
    if isinstance(value, tuple | list | dict):
        parts = value.items() if isinstance(value, dict) else value
        texts = [described(part) for part in parts]
        return None if None in texts else " ".join(map(str, texts))[:LONGEST_ID] or "empty"
    if isinstance(value, str | bytes | int | float | Enum | NoneType):
        return str(value)
    # A function, a class, or a message of pymavlink.
    return getattr(value, "__name__", None) or getattr(value, "msgname", None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run first the files with slow tests, so that no worker is left alone with one in the end."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    all_of = Counter(item.path for item in items)
    items.sort(key=lambda item: (-slow[item.path], -all_of[item.path]))


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Give each file to one worker, so that its gateway or its browser is started once."""
    from xdist.scheduler import LoadFileScheduling

    # By the order above, not by the number of tests.
    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


class ManualClock:
    """A gateway clock that moves only when the test says so."""

    def __init__(self) -> None:
        self.now_us = 0

    def __call__(self) -> int:
        return self.now_us

    def advance(self, seconds: float) -> int:
        self.now_us += round(seconds * 1e6)
        return self.now_us


class LoopTime:
    """The time of an event loop: ahead by `ahead_s`, and standing still from `stop` on."""

    def __init__(self, running: Callable[[], float]) -> None:
        self.ahead_s = 0.0
        self._running = running

    def __call__(self) -> float:
        return self._running() + self.ahead_s

    def stop(self) -> None:
        now_s = self._running()
        self._running = lambda: now_s


@pytest.fixture(autouse=True, scope="session")
def _own_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give the tests a home that nobody has used: no settings, recordings or gateways of a user."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HOME", str(home))
        for name in USERS_OWN:
            environment.delenv(name, raising=False)
        yield


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
async def loop_time(monkeypatch: pytest.MonkeyPatch) -> LoopTime:
    loop = asyncio.get_running_loop()
    time = LoopTime(loop.time)
    monkeypatch.setattr(loop, "time", time)
    return time


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of temporary files during a test, which is not made yet."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20_240_611)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real flights: other people's data, so it is never part of the project."""
    folder = Path(os.environ.get("MAVGATE_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip("no real flights here: set MAVGATE_DATA to the folder that holds them")
    return folder
