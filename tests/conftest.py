"""Fixtures for every test: seeded chance, a manual clock, real flights where there are any."""

import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


def pytest_configure(config: pytest.Config) -> None:
    """Drop machine code that is older than the sources.

    Numba looks only at the file of a compiled function, not at those of the functions it calls, so
    a change in one file would be tested with the other's old code.
    """
    if hasattr(config, "workerinput"):
        return
    rooms = [ROOT / "gateway" / room for room in ("estimation", "geometry", "sensing")]
    sources = [*(ROOT / "gateway").glob("*.py"), *(f for room in rooms for f in room.rglob("*.py"))]
    newest = max(file.stat().st_mtime for file in sources)
    for file in (ROOT / "gateway").rglob("__pycache__/*.nb[ic]"):
        if file.stat().st_mtime < newest:
            file.unlink(missing_ok=True)


class ManualClock:
    """A gateway clock that moves only when the test says so."""

    def __init__(self) -> None:
        self.now_us = 0

    def __call__(self) -> int:
        return self.now_us

    def advance(self, seconds: float) -> int:
        self.now_us += round(seconds * 1e6)
        return self.now_us


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


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
