"""Fixtures for every test: seeded chance, a manual clock, real flights where there are any."""

import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


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
