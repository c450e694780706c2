"""Recorders on a manual clock, and a disk that syncs slowly."""

import os
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ManualClock
from tests.kit.faults import SlowDisk
from tests.kit.recorder import MakeBench, RecorderBench


@pytest.fixture
async def make_bench(tmp_path: Path, clock: ManualClock) -> AsyncIterator[MakeBench]:
    """Make recorders in one folder, by their settings."""
    made: list[RecorderBench] = []

    def make(folder: Path = tmp_path / "recordings", **settings: Any) -> RecorderBench:
        made.append(RecorderBench(folder, clock, **settings))
        return made[-1]

    yield make
    for bench in made:
        bench.recorder.close()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowDisk]:
    made = SlowDisk()
    monkeypatch.setattr(os, "fsync", made.sync)
    monkeypatch.setattr(os, "fdatasync", made.sync)
    yield made
    made.may_end.set()
